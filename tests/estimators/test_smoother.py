"""The design: its equations as the paper writes them, its limits, invariances and refusals."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import solve_continuous_are

from robsmooth import (
    Estimator,
    InfeasibleDesignError,
    Nonlinearity,
    UncertainSystem,
    Uncertainty,
    augment,
    design_smoother,
    homodyne,
)
from robsmooth._numerics.riccati import solve_riccati
from robsmooth.estimators import baselines
from robsmooth.estimators.smoother import design_equations
from robsmooth.systems.delay import DelayModel
from tests.helpers.strategies import (
    designs,
    feasible_design,
    orthogonal_matrix,
    random_multipliers,
    random_system,
    seeds,
)

COSTS = ("filtered", "smoothed")
PRINTED = (1.13e-6, [0.9727, 0.4831, 0.0015, 0.0014])  # tau and lambda of Section IV-B
FEASIBLE = (1.13e-6, [0.9727, 0.4831, 0.0003, 0.0003])


@pytest.fixture(scope="module")
def example():
    return augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)


def general_design(seed, cost="filtered", order=2, **kinds):
    rng = np.random.default_rng(seed)
    sizes = {"n": 2, "m": 2, "measurements": 2, "g": 2, "size": 0.05, **kinds}
    for _ in range(50):
        design = feasible_design(rng, augment(random_system(rng, **sizes), 0.5, order), cost)
        if design is not None:
            return design
    raise AssertionError("no feasible design found")


class Section3:
    """The equations of Section III coded again, with the corrections that notes on them state."""

    def __init__(self, design):
        plant = design.plant
        self.tau, self.A = design.tau, plant.A_p
        m, g = plant.system.m, plant.system.g
        B1, C1, D12 = plant.B1_tilde, plant.C1_tilde, plant.D12_tilde
        C2, D21 = plant.C2_tilde, plant.D21_tilde
        # Multipliers by their channels, not by the M_i: uncertainties, then pairs (mu, mu-tilde).
        k = plant.system.k
        weights, pair = design.multipliers[:k], design.multipliers[k:].reshape(3, g)
        self.M = self.blocks(weights, plant.input_sizes, pair, np.ones(g))
        constants = [c.lipschitz for c in plant.system.nonlinearities]
        N = self.blocks(weights, plant.output_sizes, pair, np.array(constants))
        Minv = np.linalg.inv(self.M)
        E = D21 @ Minv @ D21.T
        Einv = np.linalg.inv(E)
        C = plant.C_p0 if design.cost == "filtered" else plant.C_a
        # The cost of w_hat, and the weighted constraints, as one quadratic form of (x, u).
        output = np.hstack([C, -np.eye(m), np.zeros((m, g))])
        channels = np.hstack([C1, D12])
        form = output.T @ output + self.tau * channels.T @ N @ channels
        n = plant.n
        self.R, self.Gamma, self.G = form[:n, :n], form[:n, n:], form[n:, n:]
        self.S_Y = C2.T @ Einv @ C2 - self.R / self.tau
        self.A_Y = self.A - B1 @ Minv @ D21.T @ Einv @ C2
        self.Q_Y = B1 @ (Minv - Minv @ D21.T @ Einv @ D21 @ Minv) @ B1.T
        self.W = B1 @ Minv @ B1.T
        self.Q_X = self.R - self.Gamma @ np.linalg.inv(self.G) @ self.Gamma.T
        self.rounding = 1e-13 * np.linalg.norm(self.R)  # the cost cancels in Q_X
        self.gain = lambda Y: (Y @ C2.T + B1 @ Minv @ D21.T) @ Einv
        self.E, self.C2 = E, C2

    @staticmethod
    def blocks(weights, sizes, pair, constants):
        k, g = len(weights), pair.shape[1]
        matrix = np.zeros((sum(sizes),) * 2)
        uncertain = sum(sizes[:k])
        matrix[:uncertain, :uncertain] = np.diag(np.repeat(weights, sizes[:k]))
        for i in range(g):
            at = np.ix_([uncertain + i, uncertain + g + i], [uncertain + i, uncertain + g + i])
            difference, own, copy = pair[:, i]
            matrix[at] = constants[i] ** 2 * np.array(
                [[difference + own, -difference], [-difference, difference + copy]]
            )
        return matrix


def relative(total, *terms):
    size = sum(np.linalg.norm(term) for term in terms)
    return np.linalg.norm(total) / max(size, 1e-12)


@given(st.sampled_from(COSTS).flatmap(lambda cost: designs(cost=cost)))
def test_X_and_Y_satisfy_the_equations_of_assumption_3(design):
    paper = Section3(design)
    X, Y, tau = design.X, design.Y, design.tau
    terms = (paper.A_Y @ Y, Y @ paper.A_Y.T, -Y @ paper.S_Y @ Y, paper.Q_Y)
    assert relative(sum(terms), *terms) < 1e-7
    terms = (X @ paper.A, paper.A.T @ X, paper.Q_X, X @ paper.W @ X / tau)
    assert np.linalg.norm(sum(terms)) < paper.rounding + 1e-7 * sum(map(np.linalg.norm, terms))
    for solution in (X, Y):
        assert np.linalg.eigvalsh(solution).min() >= -1e-9 * np.linalg.norm(solution)
    assert np.linalg.eigvals(paper.A_Y - Y @ paper.S_Y).real.max() < 0
    assert np.linalg.eigvals(paper.A + paper.W @ X / tau).real.max() < 0
    radius = np.abs(np.linalg.eigvals(Y @ X)).max()
    assert design.spectral_radius == pytest.approx(radius, rel=1e-9, abs=1e-15)
    assert radius < tau


@given(st.sampled_from(COSTS).flatmap(lambda cost: designs(cost=cost)))
def test_equations_with_completed_squares_are_those_of_the_paper(design):
    paper = Section3(design)
    equations = design_equations(design.plant, design.tau, design.multipliers, design.cost)
    for found, expected in (
        (equations.equation_Y, (paper.A_Y.T, paper.Q_Y, paper.S_Y)),
        (equations.equation_X(), (paper.A, paper.Q_X, -paper.W / design.tau)),
    ):
        for ours, theirs in zip(found, expected, strict=True):
            # of the terms that cancel in theirs, none is larger than these
            size = max(np.abs(value).max() for value in (theirs, paper.R, paper.W))
            assert_allclose(ours, theirs, rtol=0, atol=1e-12 * size)


@given(st.sampled_from(COSTS).flatmap(lambda cost: designs(cost=cost)))
def test_gains_and_bound_follow_the_papers_formulas(design):
    paper = Section3(design)
    X, Y, tau = design.X, design.Y, design.tau
    B_c = paper.gain(Y)
    shrink = np.linalg.inv(np.eye(len(X)) - Y @ X / tau)
    K = np.linalg.solve(paper.G, paper.Gamma.T)
    A_c = paper.A + Y @ paper.R / tau - B_c @ paper.C2 - Y @ paper.Gamma @ K @ shrink / tau
    bound = 0.5 * np.trace(Y @ paper.R + B_c @ paper.E @ B_c.T @ X @ shrink)
    size = 1 + np.abs(A_c).max()
    assert_allclose(design.B_c, B_c, rtol=0, atol=1e-8 * (1 + np.abs(B_c).max()))
    assert_allclose(design.C_c, -K @ shrink, rtol=0, atol=1e-8 * (1 + np.abs(K @ shrink).max()))
    assert_allclose(design.A_c, A_c, rtol=0, atol=1e-8 * size)
    assert design.bound == pytest.approx(bound, rel=1e-9)
    m = design.plant.system.m
    expected = design.C_c[:m] if design.cost == "filtered" else design.plant.C_p0
    assert_allclose(design.C_f, expected, rtol=0)


def test_printed_gains_follow_with_the_sign_of_the_quadratic_term_flipped(example):
    equations = design_equations(example, *PRINTED)
    X = solve_riccati(*equations.equation_X(quadratic_sign=-1)).X
    Y = solve_riccati(*equations.equation_Y).X
    A_c, B_c, C_c, bound, _ = equations.gains(X, Y)
    # Entries that do not depend on the coordinates of the delay states, to their printed digits
    # and, for the two of the copy, to what the rounding of tau and lambda allows.
    assert A_c[0, 0] == pytest.approx(-4.58e5, rel=2e-3)
    assert B_c[0, 0] == pytest.approx(4.45e5, rel=2e-3)
    assert B_c[0, 1] == pytest.approx(-190.97, rel=2e-4)
    assert C_c[0, 0] == pytest.approx(1.02, abs=0.005)
    assert C_c[1, 0] == pytest.approx(944.68, rel=2e-4)
    assert_allclose(C_c[:, 1:], 0, atol=1e-6 * np.abs(C_c[1, 0]))
    assert bound == pytest.approx(0.130, abs=0.001)  # printed: 0.15
    # Without the term, or with the sign as written, the leading entry of C_c is another.
    coupling = C_c[1, 0] / 929.6
    assert coupling > 1.01


def test_design_at_the_printed_point_is_refused_because_X_does_not_exist(example):
    with pytest.raises(InfeasibleDesignError, match=r"Assumption 3\.2") as caught:
        design_smoother(example, *PRINTED)
    assert caught.value.condition.startswith("Assumption 3.2")
    # The scalar equation behind it: 2 a x + q + w x^2 = 0 has a negative discriminant.
    tau, (l1, l2, l3, l4) = PRINTED
    a, c = 9140.0, 929.6
    q = tau * c**2 * (l2 + l3 - l2**2 / (l2 + l4))
    assert a**2 - q * 4e4 / (l1 * tau) < 0


def test_X_of_the_example_is_the_root_of_its_scalar_equation(example):
    design = design_smoother(example, *FEASIBLE)
    tau, (l1, l2, l3, l4) = FEASIBLE
    a, c = 9140.0, 929.6
    q = tau * c**2 * (l2 + l3 - l2**2 / (l2 + l4))
    w = 4e4 / (l1 * tau)
    root = q / (a + np.sqrt(a * a - q * w))
    assert design.X[0, 0] == pytest.approx(root, rel=1e-9)
    assert_allclose(design.X[1:, :], 0, atol=1e-9 * root)


# --- invariances --------------------------------------------------------------------------------


def in_time_unit(system, unit):
    """The same system with time counted in units of `unit` seconds; y and the xi follow."""
    root = np.sqrt(unit)
    return UncertainSystem(
        A=system.A * unit,
        B1=system.B1 * root,
        C0=system.C0,
        C2=system.C2 * root,
        D21=system.D21,
        uncertainties=[Uncertainty(c.B * root, c.C * root, c.D) for c in system.uncertainties],
        nonlinearities=[
            Nonlinearity(c.B * root, c.C * root, c.D, c.lipschitz) for c in system.nonlinearities
        ],
    )


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e6])
@pytest.mark.parametrize("seed", range(4))
def test_design_does_not_depend_on_the_unit_of_time(seed, unit, cost):
    design = general_design(seed, cost)
    plant = augment(in_time_unit(design.plant.system, unit), 0.5 / unit, 2)
    other = design_smoother(plant, design.tau / unit, design.multipliers, cost)
    assert other.bound == pytest.approx(design.bound, rel=1e-9)
    for s in (0.0, 0.3j, 5j):
        assert_allclose(
            transfer(other, s * unit) * np.sqrt(unit),
            transfer(design, s),
            rtol=0,
            atol=1e-9 * np.abs(transfer(design, 0)).max(),
        )


def transfer(design, s):
    """From the extended measurement to u-tilde and the smoothed estimate, in y's unit per dt."""
    system = design.plant.system
    states = np.linalg.solve(s * np.eye(len(design.A_c)) - design.A_c, design.B_c)
    return (np.vstack([design.C_c[: system.m], design.C_a]) @ states)[:, : system.l]


@pytest.mark.parametrize("seed", range(4))
def test_design_does_not_depend_on_the_coordinates_of_the_state(seed):
    design = general_design(seed)
    system = design.plant.system
    rng = np.random.default_rng(seed)
    T = orthogonal_matrix(rng, 2) @ np.diag([0.1, 20.0])  # x = T z
    inverse = np.linalg.inv(T)
    other_system = UncertainSystem(
        A=inverse @ system.A @ T,
        B1=inverse @ system.B1,
        C0=system.C0 @ T,
        C2=system.C2 @ T,
        D21=system.D21,
        uncertainties=[Uncertainty(inverse @ c.B, c.C @ T, c.D) for c in system.uncertainties],
        nonlinearities=[
            Nonlinearity(inverse @ c.B, c.C @ T, c.D, c.lipschitz) for c in system.nonlinearities
        ],
    )
    other = design_smoother(augment(other_system, 0.5, 2), design.tau, design.multipliers)
    assert other.bound == pytest.approx(design.bound, rel=1e-9)
    for s in (0.0, 1j):
        assert_allclose(
            transfer(other, s),
            transfer(design, s),
            rtol=0,
            atol=1e-8 * np.abs(transfer(design, 0)).max(),
        )


@pytest.mark.parametrize("cost", COSTS)
def test_design_does_not_depend_on_the_coordinates_of_the_delay_model(example, cost):
    # The printed realisation: second-order Pade scaled by powers of two.
    delay = 3.1e-6
    F = np.array([[-6 / delay, -12 / delay**2 / 2**20], [2.0**20, 0.0]])
    model = DelayModel(
        F=F,
        G=np.array([[2048.0], [0.0]]),
        H=np.array([[-12 / delay / 2048, 0.0]]),
        J=np.eye(1),
        delay=delay,
        order=2,
    )
    omega = np.geomspace(1e4, 1e8, 9)
    assert_allclose(model.response(omega), example.delay_model.response(omega), rtol=1e-10)
    printed = design_smoother(replace(example, delay_model=model), *FEASIBLE, cost)
    ours = design_smoother(example, *FEASIBLE, cost)
    assert printed.bound == pytest.approx(ours.bound, rel=1e-9)
    for s in (0.0, 1e5j, 1e6j):
        assert_allclose(
            transfer(printed, s),
            transfer(ours, s),
            rtol=0,
            atol=1e-9 * np.abs(transfer(ours, 0)).max(),
        )


@given(designs(), st.floats(0.01, 1.0))
def test_bound_is_homogeneous_in_multipliers_and_tau(design, scale):
    # V(s lambda, tau/s) = V(lambda, tau)/s, and the estimator stays the same
    other = design_smoother(design.plant, design.tau / scale, scale * design.multipliers)
    assert other.bound == pytest.approx(design.bound / scale, rel=1e-7)
    assert_allclose(other.C_c, design.C_c, rtol=0, atol=1e-6 * (1 + np.abs(design.C_c).max()))


@given(seeds)
@settings(max_examples=10)
def test_order_of_the_uncertainties_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    system = random_system(rng, g=1)
    design = feasible_design(rng, augment(system, 0.5, 1))
    if design is None:
        return
    swapped = replace(system, uncertainties=system.uncertainties[::-1])
    order = [1, 0, 2, 3, 4]
    other = design_smoother(augment(swapped, 0.5, 1), design.tau, design.multipliers[order])
    assert other.bound == pytest.approx(design.bound, rel=1e-9)


# --- limits -------------------------------------------------------------------------------------


def without_uncertainty(system, size=0.0):
    return replace(
        system,
        uncertainties=[Uncertainty(c.B, size * c.C, c.D) for c in system.uncertainties],
        nonlinearities=[replace(c, C=size * c.C) for c in system.nonlinearities],
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("order", [0, 2])
def test_limit_of_no_uncertainty_is_the_classical_fixed_lag_smoother(seed, order):
    # For tau -> infinity and multipliers with M^-1 = J J'. Nonlinearities that nothing excites,
    # but whose fictitious noise enters the state, would remain: g = 0 here.
    rng = np.random.default_rng(seed)
    plant = augment(
        without_uncertainty(random_system(rng, n=3, m=2, measurements=2, g=0)), 0.5, order
    )
    classical = baselines.fixed_lag_smoother(plant.system, 0.5, order)
    differences = []
    for tau in (1e3, 1e5):
        robust = design_smoother(plant, tau, [1.0, 1.0])
        differences.append(np.abs(robust.B_c - classical.B_c).max())
    assert differences[1] < 1.1e-2 * differences[0] + 1e-12  # of order 1/tau
    scale = np.abs(classical.B_c).max()
    assert differences[1] < 1e-3 * scale
    robust = design_smoother(plant, 1e9, [1.0, 1.0])
    assert_allclose(robust.A_c, classical.A_c, rtol=0, atol=1e-6 * np.abs(classical.A_c).max())
    assert_allclose(robust.B_c, classical.B_c, rtol=0, atol=1e-6 * scale)
    assert_allclose(robust.C_f, classical.C_f, rtol=0, atol=1e-6)
    s = plant.system
    kalman = solve_continuous_are(s.A.T, s.C2.T, s.B1 @ s.B1.T, s.D21 @ s.D21.T, s=s.B1 @ s.D21.T)
    error = np.trace(s.C0 @ kalman @ s.C0.T)
    assert robust.bound == pytest.approx(error / 2, rel=1e-6)


def test_limit_of_a_vanishing_nonlinearity_is_the_kalman_filter_of_the_example():
    # gamma -> 0 and, in the same limit, the channel's multipliers large: its noise M^-1 is then
    # that of the measurement alone, lambda_2 + lambda_3 -> 1 with lambda_4 -> infinity excluded by
    # M^-1 >= J J', so lambda_2 -> 0: M = I.
    quiet = homodyne.HomodyneParameters(lam=9.14e3, kappa=4e4, alpha=1162.0, beta=1.0, gamma=1e-9)
    plant = augment(quiet.uncertain_system(), 3.1e-6, 2)
    robust = design_smoother(plant, 1.0, [1.0, 1e-12, 1.0 - 1e-12, 1.0 - 1e-12])
    a, kappa, r = 9.14e3, 4e4, (2 * 1162.0) ** -2
    P = r * (np.sqrt(a * a + kappa / r) - a)
    assert robust.B_c[0, 0] == pytest.approx(P / r, rel=1e-6)
    assert robust.bound == pytest.approx(P / 2, rel=1e-6)
    classical = baselines.fixed_lag_smoother(plant.system, 3.1e-6, 2)
    assert_allclose(
        robust.B_c[:, 0], classical.B_c[:, 0], rtol=0, atol=1e-6 * np.abs(classical.B_c).max()
    )


# --- refusals -----------------------------------------------------------------------------------


def refusal(plant, tau, multipliers, cost="filtered"):
    with pytest.raises(InfeasibleDesignError) as caught:
        design_smoother(plant, tau, multipliers, cost)
    assert str(caught.value).startswith(caught.value.condition)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("zero", [(0,), (1, 2), (1, 3), (2, 3), (0, 1, 2, 3)])
def test_multipliers_that_make_M_singular_are_refused(example, zero):
    multipliers = np.array([0.9, 0.4, 0.01, 0.01])
    multipliers[list(zero)] = 0.0
    assert refusal(example, 1.1e-6, multipliers).condition == "M(lambda) > 0"


def test_one_zero_multiplier_of_a_nonlinearity_leaves_M_positive(example):
    for index in (1, 2, 3):
        multipliers = np.array([0.9, 0.1, 1e-5, 1e-5])
        multipliers[index] = 0.0
        try:
            design_smoother(example, 1e-6, multipliers)
        except InfeasibleDesignError as error:
            assert error.condition.startswith("Assumption 3")


@pytest.mark.parametrize("excess", [1.0 + 1e-6, 2.0])
def test_multipliers_outside_the_constraint_are_refused_with_the_remedy(example, excess):
    edge = np.array([1.0, 0.4995, 0.001, 0.001])  # its largest eigenvalue is 1
    design_smoother(example, 1.1e-6, edge * 0.999 * [1, 1, 0.1, 0.1])
    error = refusal(example, 1.1e-6, excess * edge)
    assert "constraint" in error.condition
    assert f"{excess:.6g}" in error.detail


def test_constraint_of_the_example_is_the_printed_one(example):
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(100):
        l1, l2 = rng.uniform(0, 1.2), rng.uniform(0, 0.7)
        l3, l4 = rng.uniform(0, 0.5, 2)
        first, second = 1 - l2 - l3, 1 - l2 - l4
        inside = l1 <= 1 and first >= 0 and second >= 0 and first * second - l2**2 >= 0
        try:
            design_equations(example, 1e-6, [l1, l2, l3, l4])
        except InfeasibleDesignError as error:
            assert "constraint" in error.condition
            assert not inside
            refused += 1
        else:
            assert inside
    assert 20 < refused < 80


def one_state(A=-1.0, D21=((0.0, 1.0),), C=0.1, **changes):
    parts = dict(
        A=[[A]],
        B1=[[1.0, 0.0]],
        C0=[[1.0]],
        C2=[[1.0]],
        D21=D21,
        uncertainties=[
            Uncertainty([[1.0]], [[C]], [[0.0]]),
            Uncertainty([[0.0]], [[C]], [[1.0]]),
        ],
    )
    return UncertainSystem(**{**parts, **changes})


def test_a_measurement_without_noise_is_refused_by_assumption_2():
    error = refusal(augment(one_state(D21=[[0.0, 0.0]]), 0.0, 0), 1.0, [1.0, 1.0])
    assert error.condition == "Assumption 2"
    assert "measurement 0" in error.detail


def test_measurements_with_the_same_noise_are_refused_by_assumption_2():
    system = one_state(
        C2=[[1.0], [2.0]],
        D21=[[0.0, 1.0], [0.0, 1e-6]],
        uncertainties=[
            Uncertainty([[1.0]], [[0.1]], [[0.0], [0.0]]),
            Uncertainty([[0.0]], [[0.1]], [[1.0], [1e-6]]),
        ],
    )
    error = refusal(augment(system, 0.0, 0), 1.0, [1.0, 1.0])
    assert error.condition == "Assumption 2"
    assert "combination" in error.detail


def test_a_small_noise_is_not_taken_for_none():
    # Assumption 2 is judged free of units: 1e-9 of anything is a noise.
    system = one_state(
        D21=[[0.0, 1e-9]],
        C2=[[1e-9]],
        uncertainties=[
            Uncertainty([[1.0]], [[0.1]], [[0.0]]),
            Uncertainty([[0.0]], [[0.1]], [[1e-9]]),
        ],
    )
    plain = design_smoother(augment(one_state(), 0.0, 0), 10.0, [1.0, 1.0])
    small = design_smoother(augment(system, 0.0, 0), 10.0, [1.0, 1.0])
    assert small.bound == pytest.approx(plain.bound, rel=1e-9)


@pytest.mark.parametrize("A", [0.0, 1e-3, 1.0])
def test_an_unstable_system_is_refused_by_assumption_3_2(A):
    error = refusal(augment(one_state(A=A), 0.0, 0), 10.0, [1.0, 1.0])
    assert error.condition.startswith("Assumption 3.2")
    assert "stable" in error.detail


def scalar_margins(a, c, tau, l1, l2):
    """Discriminants of the two scalar equations of `one_state`, then rho(YX) - tau."""
    # Y: -2 a y + 1/l1 - s y^2 = 0, s = l2 - (1 + tau (l1 + l2) c^2)/tau;  X: x with q and w
    s = l2 - 1 / tau - (l1 + l2) * c**2
    q, w = tau * (l1 + l2) * c**2, 1 / (l1 * tau)
    Y = a * a + s / l1
    X = a * a - q * w
    if Y <= 0 or X <= 0:
        return Y, X, None
    y = (1 / l1) / (a + np.sqrt(Y))
    x = q / (a + np.sqrt(X))
    return Y, X, y * x - tau


@pytest.mark.parametrize("cost", COSTS)
def test_each_part_of_assumption_3_is_named_where_its_scalar_condition_fails(cost):
    seen = set()
    for c in (0.1, 0.5, 0.65, 0.7, 0.9):
        plant = augment(one_state(C=c), 0.0, 0)
        for tau in (0.1, 0.5, 0.55, 0.8, 1.5, 5.0):
            Y, X, radius = scalar_margins(1.0, c, tau, 1.0, 1.0)
            if min(abs(Y), abs(X)) < 1e-6:
                continue
            if Y < 0:
                wanted = "Assumption 3.1"
            elif X < 0:
                wanted = "Assumption 3.2"
            elif radius > 0:
                wanted = "Assumption 3.3"
            else:
                wanted = None
            seen.add(wanted)
            if wanted is None:
                design_smoother(plant, tau, [1.0, 1.0], cost)
            else:
                condition = refusal(plant, tau, [1.0, 1.0], cost).condition
                assert condition.startswith(wanted), (c, tau, wanted)
    assert seen == {None, "Assumption 3.1", "Assumption 3.2"}


def test_a_spectral_radius_above_tau_is_refused_by_assumption_3_3():
    # Rare among random systems: both equations have their solutions, which do not fit together.
    rng = np.random.default_rng(1357)
    n, measurements, g = rng.integers([1, 1, 0], [4, 3, 2])
    system = random_system(rng, n, 1, measurements, g, size=10 ** rng.uniform(-2, 0.3))
    plant = augment(system, 1.0, int(rng.integers(0, 2)))
    multipliers = random_multipliers(rng, plant)
    tau = 0.2848035868435802
    equations = design_equations(plant, tau, multipliers, "smoothed")
    X = solve_riccati(*equations.equation_X()).X
    Y = solve_riccati(*equations.equation_Y).X
    assert min(np.linalg.eigvalsh(X).min(), np.linalg.eigvalsh(Y).min()) > -1e-9
    radius = np.abs(np.linalg.eigvals(Y @ X)).max()
    assert radius > tau
    error = refusal(plant, tau, multipliers, "smoothed")
    assert error.condition == "Assumption 3.3"
    assert f"{radius:.4g}" in error.detail


@pytest.mark.parametrize("multipliers", [[], [1.0, 0.4, 0.01], [1.0, 0.4, 0.01, 0.01, 0.01]])
def test_a_wrong_number_of_multipliers_is_an_error(example, multipliers):
    with pytest.raises(ValueError, match=r"multipliers must have k \+ 3g = 1 \+ 3\*1 = 4 entries"):
        design_smoother(example, 1e-6, multipliers)


@pytest.mark.parametrize(
    "value, error", [(-1e-9, ValueError), (np.nan, ValueError), ("1", TypeError)]
)
def test_bad_multipliers_are_an_error(example, value, error):
    with pytest.raises(error, match=r"^multipliers must"):
        design_smoother(example, 1e-6, [1.0, 0.4, 0.01, value])


@pytest.mark.parametrize("tau", [0.0, -1e-6, np.nan, np.inf])
def test_tau_is_positive_and_finite(example, tau):
    with pytest.raises(ValueError, match=r"^tau must"):
        design_smoother(example, tau, [1.0, 0.4, 0.01, 0.01])


@pytest.mark.parametrize("cost", ["", "Filtered", None, 3])
def test_an_unknown_cost_is_an_error(example, cost):
    with pytest.raises(ValueError, match=r"^cost must be one of 'filtered', 'smoothed'"):
        design_smoother(example, *FEASIBLE, cost)


def test_only_an_augmented_system_has_a_design(example):
    with pytest.raises(TypeError, match="plant must be an AugmentedSystem"):
        design_smoother(example.system, *FEASIBLE)


def test_the_refusal_survives_pickling(example):
    error = refusal(example, *PRINTED)
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy)) == (InfeasibleDesignError, str(error))
    assert (copy.condition, copy.detail) == (error.condition, error.detail)


def test_a_design_survives_pickling_and_shows_what_it_is(example):
    design = design_smoother(example, *FEASIBLE)
    copy = pickle.loads(pickle.dumps(design))
    assert_allclose(copy.A_c, design.A_c, rtol=0)
    for part in ("bound=", "cost='filtered'", "tau=1.13e-06", "delay=3.1e-06"):
        assert part in repr(copy)
    assert np.all(np.diff(design.poles.real) <= 0)
    assert_allclose(np.sort_complex(design.poles), np.sort_complex(np.linalg.eigvals(design.A_c)))


MATRICES = ("A_c", "B_c", "C_c", "C_a", "C_f")


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda M: np.nan * M, ValueError, r"{} must be finite, got nan at index \(0, 0\)"),
        (lambda M: M * (1 + 1j), ValueError, "{} must be real"),
        (lambda M: np.hstack([M, M]), ValueError, r"{} must have shape \("),
        (lambda M: M[0], ValueError, r"{} must have 2 dimension"),
        (lambda M: M.astype(str), TypeError, "{} must be an array of numbers"),
    ],
)
def test_an_estimator_with_wrong_matrices_is_refused(example, name, change, error, words):
    matrices = {each: getattr(baselines.kalman_bucy(example.system), each) for each in MATRICES}
    plant = augment(example.system, 0.0, 0)
    with pytest.raises(error, match=words.format(name)):
        Estimator(plant=plant, **matrices | {name: change(matrices[name])})
    with pytest.raises(TypeError, match="plant must be an AugmentedSystem, got UncertainSystem"):
        Estimator(plant=example.system, **matrices)


def test_an_estimator_takes_lists_and_keeps_matrices_of_its_own(example):
    kalman = baselines.kalman_bucy(example.system)
    given = {name: getattr(kalman, name).copy() for name in MATRICES}
    estimator = Estimator(plant=kalman.plant, **given)
    as_lists = {name: value.tolist() for name, value in given.items()}
    for value in given.values():
        value += 1.0
    for name in MATRICES:
        for made in (estimator, Estimator(plant=kalman.plant, **as_lists)):
            assert np.array_equal(getattr(made, name), getattr(kalman, name))
            assert not getattr(made, name).flags.writeable
