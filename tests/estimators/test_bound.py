"""The least bound: certificates that nothing is below it, its structure, its invariances."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import differential_evolution, minimize, minimize_scalar

from robsmooth import (
    InfeasibleDesignError,
    Nonlinearity,
    UncertainSystem,
    Uncertainty,
    augment,
    design_smoother,
    homodyne,
    minimize_bound,
)
from robsmooth.estimators.bound import VANISHING, best_tau, log_bound
from robsmooth.estimators.conditions import multiplier_level
from robsmooth.estimators.equations import DesignProblem
from robsmooth.estimators.smoother import limiting_smoother
from robsmooth.estimators.units import Units
from tests.helpers.loops import two_channels
from tests.helpers.scalar_bound import scalar_bound
from tests.helpers.strategies import feasible_design, plants, random_system, seeds

COSTS = ("filtered", "smoothed")


@pytest.fixture(scope="module")
def example():
    return augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)


@pytest.fixture(scope="module")
def bests(example):
    return {cost: minimize_bound(example, cost) for cost in COSTS}


@pytest.fixture(scope="module")
def best(bests):
    return bests["filtered"]


# --- the example -----------------------------------------------------------------------------


def least_scalar(p, J_21=1.0):
    """The least V of the example for a p, and its tau."""
    found = minimize_scalar(
        lambda u: float(scalar_bound(homodyne.PAPER, p, np.exp(u), J_21)),
        bounds=np.log([5e-7, 1e-4]),
        method="bounded",
        options={"xatol": 1e-10},
    )
    return found.fun, np.exp(found.x)


def test_infimum_of_the_example_is_that_of_its_scalar_form(best):
    bound, tau = least_scalar(0.5)
    assert bound == pytest.approx(0.12167363533, rel=1e-9)
    assert best.bound_infimum == pytest.approx(bound, rel=1e-9)
    assert best.limit.tau == pytest.approx(tau, rel=1e-5)
    assert_allclose(best.limit.multipliers, [1.0, 0.5, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("J_21", [0.01, 0.3, 3.0])
def test_copy_noise_moves_the_infimum_of_the_example_along_its_scalar_form(J_21):
    # the constraint on the copy is J_21^2 q <= 1, and h = 0 up to p = 1/(1 + J_21^2)
    best = minimize_bound(augment(homodyne.PAPER.uncertain_system(), 0.0, 0, J_21=J_21))
    p = 1 / (1 + J_21**2)
    assert best.bound_infimum == pytest.approx(least_scalar(p, J_21)[0], rel=1e-9)
    assert_allclose(best.limit.multipliers, [1.0, p, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    "gamma, noise", [(0.1, 100.0), (0.7, 3.0), (0.7, 10.0), (0.9, 0.1), (0.99, 0.01)]
)
def test_least_bound_is_that_of_a_grid_whatever_the_sector_and_the_noise(gamma, noise):
    # copies trusted (p = 1/2), the measurement ignored (p = 0), or the bound attained (p = 0.98)
    loop = replace(homodyne.PAPER, gamma=gamma, alpha=homodyne.PAPER.alpha / noise**0.5)
    best = minimize_bound(augment(loop.uncertain_system(), 0.0, 0))
    p = np.concatenate([np.geomspace(1e-14, 0.5, 400), 0.5 + np.geomspace(1e-6, 0.5, 500)])
    p, tau = np.meshgrid(p, np.geomspace(1e-9, 1e6, 1500))
    least = scalar_bound(loop, p, tau).min()
    found = best.bound_infimum or best.bound
    assert found == pytest.approx(least, rel=2e-4)


def stabilising(A, Q, S):
    """The Riccati equation once more, by eigenvectors, or None."""
    values, vectors = np.linalg.eig(np.block([[A, -S], [-Q, -A.T]]))
    stable = vectors[:, values.real < 0]
    n = len(A)
    return np.linalg.solve(stable[:n].T, stable[n:].T).real if stable.shape[1] == n else None


def independent_bound(plant, cost, tau, multipliers):
    """V on the constraint's boundary, from the equations of Section III written out again."""
    multipliers = multipliers / np.linalg.eigvalsh(plant.J.T @ plant.M(multipliers) @ plant.J)[-1]
    inverse, N = np.linalg.inv(plant.M(multipliers)), tau * np.tensordot(multipliers, plant.N_i, 1)
    B1, C1, C2, D21 = plant.B1_tilde, plant.C1_tilde, plant.C2_tilde, plant.D21_tilde
    C = plant.C_p0 if cost == "filtered" else plant.C_a
    E = np.linalg.inv(D21 @ inverse @ D21.T)
    R, corner = C.T @ C + C1.T @ N @ C1, C1.T @ N[:, -1:]  # one nonlinearity and its copy
    L = B1 @ inverse @ D21.T
    Q = B1 @ inverse @ B1.T
    Y = stabilising((plant.A_p - L @ E @ C2).T, Q - L @ E @ L.T, C2.T @ E @ C2 - R / tau)
    X = stabilising(plant.A_p, C1.T @ N @ C1 - corner @ corner.T / N[-1, -1], -Q / tau)
    if X is None or Y is None or np.linalg.eigvalsh(Y)[0] < 0:
        return np.inf
    if np.abs(np.linalg.eigvals(Y @ X)).max() >= tau:
        return np.inf
    K = (Y @ C2.T + L) @ E
    Z = X @ np.linalg.inv(np.eye(len(X)) - Y @ X / tau)
    return 0.5 * np.trace(Y @ R + K @ np.linalg.solve(E, K.T) @ Z)


@pytest.mark.parametrize("cost", COSTS)
def test_a_global_search_of_its_own_finds_nothing_below_the_infimum(bests, cost):
    unit = 1e-5  # of time: the search's equations are not scaled
    loop = homodyne.HomodyneParameters(9.14e3 * unit, 4e4 * unit, 1162 * unit**0.5, 1.0, 0.4)
    order = 2 if cost == "smoothed" else 0
    plant = augment(loop.uncertain_system(), 3.1e-6 / unit, order)
    found = differential_evolution(
        lambda z: min(independent_bound(plant, cost, np.exp(z[0]), np.exp([0, *z[1:]])), 1e3),
        np.log([[1e-3, 10], [1e-3, 10], [1e-8, 1], [1e-8, 1]]),
        popsize=12,
        maxiter=60,
        rng=0,
        polish=False,
        tol=0,
    )
    infimum = bests[cost].bound_infimum
    assert infimum < found.fun < infimum * (1 + 1e-3)
    assert np.exp(found.x[0]) * unit == pytest.approx(bests[cost].tau, rel=0.1)


def test_infimum_of_the_smoothed_cost(bests):
    best = bests["smoothed"]
    assert best.bound_infimum == pytest.approx(0.0699406263, rel=1e-8)
    assert best.limit.tau == pytest.approx(7.0230823e-7, rel=1e-4)
    assert_allclose(best.limit.multipliers, [1.0, 0.5, 0.0, 0.0], atol=1e-9)


# --- the design next to the infimum --------------------------------------------------------------


@pytest.mark.parametrize("cost", COSTS)
def test_limit_is_the_design_that_attains_the_infimum(bests, cost):
    best = bests[cost]
    limit = best.limit
    assert limit.bound == best.bound_infimum
    assert limit.bound_infimum is None
    again = limiting_smoother(best.plant, limit.tau, limit.multipliers, cost)
    assert again.bound == limit.bound
    for name in ("A_c", "B_c", "C_c"):
        value = getattr(limit, name)
        atol = 1e-4 * np.abs(value).max()
        assert_allclose(getattr(best, name), value, rtol=0, atol=atol)


@pytest.mark.parametrize("cost", COSTS)
def test_the_best_tau_is_that_of_the_search_for_all(bests, cost):
    limit = bests[cost].limit
    assert_allclose(best_tau(limit.plant, limit.multipliers, cost), limit.tau, rtol=1e-4)


@pytest.mark.parametrize("gamma", [0.05, 0.4, 0.8])
def test_the_best_tau_of_the_example_is_the_root_of_a_quartic(gamma):
    """Without X, V = Y(1 + tau k/kappa)/2, with 1/tau and Y functions of u = kappa/Y - lambda."""
    p = replace(homodyne.PAPER, gamma=gamma)
    k = 0.5 * p.kappa * (2.0 * p.alpha * gamma) ** 2
    a = p.lam**2 + 0.5 * p.kappa * (2.0 * p.alpha) ** 2 * (p.beta**2 - gamma**2)
    u = np.roots([1.0, 0.0, -(2.0 * a + 3.0 * k), -2.0 * k * p.lam, a * (a + k)])
    u = u.real[(u.real > 0.0) & (u.real < np.sqrt(a))].item()
    plant = augment(p.uncertain_system(), 3.1e-6, 2)
    tau = best_tau(plant, (1.0, 0.5, 0.0, 0.0), "filtered")
    assert_allclose(tau, p.kappa / (a - u**2), rtol=1e-6)


def test_the_best_tau_of_multipliers_without_a_design_is_refused_by_the_design(example):
    multipliers = (0.9, 0.1, 0.1, 0.1)
    tau = best_tau(example, multipliers, "smoothed")
    with pytest.raises(InfeasibleDesignError):
        limiting_smoother(example, tau, multipliers, "smoothed")


def test_the_design_beside_the_infimum_is_close_to_it_and_feasible(best, example):
    assert 0 < best.bound / best.bound_infimum - 1 < 1e-4
    l1, l2, l3, l4 = best.multipliers
    assert l1 == pytest.approx(1.0, rel=1e-5)
    assert l2 == pytest.approx(0.5, rel=1e-5)
    assert l3 == l4 == pytest.approx(VANISHING, rel=1e-5)
    again = design_smoother(example, best.tau, best.multipliers)
    assert again.bound == best.bound


def test_bound_falls_towards_the_edge_where_the_multipliers_vanish(example, best):
    bounds = []
    for fraction in (1e-4, 1e-5, 1e-6, 1e-7):
        multipliers = np.array([1.0, 0.5 - fraction, fraction, fraction])
        bounds.append(design_smoother(example, best.tau, multipliers).bound)
    excess = np.array(bounds) - limiting_smoother(example, best.tau, [1.0, 0.5, 0.0, 0.0]).bound
    assert (excess > 0).all()
    assert_allclose(excess[:-1] / excess[1:], 10.0, rtol=0.05)  # linear in the fraction


def test_no_random_design_of_the_example_is_below_the_infimum(example, best):
    rng = np.random.default_rng(0)
    feasible = 0
    for _ in range(600):
        decades = rng.uniform([-1, -1, -3, -3], [0, 0, 1, 1])
        multipliers = np.array([1.0, 0.5, 1e-3, 1e-3]) * 10**decades
        multipliers /= multiplier_level(example, multipliers)
        tau = best.tau * np.exp(rng.normal(0, 0.5))
        try:
            bound = design_smoother(example, tau, multipliers).bound
        except InfeasibleDesignError:
            continue
        feasible += 1
        assert bound > best.bound_infimum
    assert feasible > 100


def test_search_is_reproducible_and_does_not_depend_on_its_starts(example, best):
    again = minimize_bound(example, "filtered")
    assert again.bound == best.bound
    assert_array_equal(again.multipliers, best.multipliers)
    other = minimize_bound(example, "filtered", starts=3)
    assert other.bound_infimum == pytest.approx(best.bound_infimum, rel=1e-10)


def two_channel_bound(tau, l1, l2, c):
    """V of `two_channels` from its two quadratic equations, solved by hand."""
    q, w = tau * (l1 + l2) * c**2, 1 / l1
    R = 1 + q
    X = 1 - q * w / tau
    Y = 1 + w * (l2 - R / tau)
    x, y = q / (1 + np.sqrt(np.maximum(X, 0))), w / (1 + np.sqrt(np.maximum(Y, 0)))
    feasible = (X > 0) & (Y > 0) & (x * y < tau)
    room = np.where(feasible, 1 - x * y / tau, 1.0)
    return np.where(feasible, 0.5 * (y * R + y * y * l2 * x / room), np.inf)


@pytest.mark.parametrize("c", [0.1, 0.45])
def test_an_attained_minimum_has_no_infimum_and_is_that_of_a_grid(c):
    design = minimize_bound(augment(two_channels(c, c), 0.0, 0), starts=2)
    assert design.bound_infimum is None
    log_tau, l1, l2 = np.meshgrid(
        np.linspace(np.log(0.3), np.log(300), 120),
        np.linspace(0.02, 1, 50),
        np.linspace(0.02, 1, 50),
        indexing="ij",
    )
    values = two_channel_bound(np.exp(log_tau), l1, l2, c)
    at = np.unravel_index(values.argmin(), values.shape)
    start = [log_tau[at], l1[at], l2[at]]
    refined = minimize(
        lambda z: float(two_channel_bound(np.exp(z[0]), *np.clip(z[1:], 1e-3, 1), c)),
        start,
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-13, "maxiter": 2000},
    )
    assert design.bound == pytest.approx(refined.fun, rel=1e-6)
    assert two_channel_bound(design.tau, *design.multipliers, c) == pytest.approx(
        design.bound, rel=1e-9
    )


@given(plants(max_g=1, max_order=1), seeds)
@settings(max_examples=4)
def test_no_random_design_is_better_than_the_minimum(plant, seed):
    rng = np.random.default_rng(seed)
    try:
        best = minimize_bound(plant, "filtered", starts=1)
    except InfeasibleDesignError:
        return
    assert multiplier_level(plant, best.multipliers) <= 1 + 1e-9
    least = best.bound_infimum or best.bound
    for _ in range(30):
        other = feasible_design(rng, plant)
        if other is not None:
            assert other.bound >= least * (1 - 1e-9)


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("unit", [1e-5])
def test_bound_is_invariant_to_the_unit_of_time(bests, unit, cost):
    parameters = homodyne.HomodyneParameters(
        lam=9.14e3 * unit, kappa=4e4 * unit, alpha=1162.0 * np.sqrt(unit), beta=1.0, gamma=0.4
    )
    plant = augment(parameters.uncertain_system(), 3.1e-6 / unit, 2)
    other, best = minimize_bound(plant, cost, starts=1), bests[cost]
    assert other.bound_infimum == pytest.approx(best.bound_infimum, rel=1e-10)
    assert other.tau * unit == pytest.approx(best.tau, rel=1e-5)


def in_units(system, x, w, y, zeta):
    """The same system with its states, output, measurement and uncertainty in other units."""
    return UncertainSystem(
        A=system.A / x * np.transpose(x),
        B1=system.B1 / x,
        C0=system.C0 / w * np.transpose(x),
        C2=system.C2 / y * np.transpose(x),
        D21=system.D21 / y,
        uncertainties=[
            Uncertainty(zeta * c.B / x, c.C / zeta * np.transpose(x), zeta * c.D / y)
            for c in system.uncertainties
        ],
        nonlinearities=[
            Nonlinearity(c.B / x, c.C * np.transpose(x), c.D / y, c.lipschitz)
            for c in system.nonlinearities
        ],
    )


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("seed, g, zeta", [(0, 0, 30.0), (5, 1, 1.0)])
def test_bound_is_invariant_to_the_units_of_the_signals(seed, g, zeta, cost):
    # Not to those of the uncertainties (zeta) where J of Assumption 1 is not unique.
    system = random_system(np.random.default_rng(seed), g=g, size=0.05)
    best = minimize_bound(augment(system, 0.5, 1), cost)
    other_system = in_units(system, x=np.array([[1e-6], [1e4]]), w=1e3, y=1e-5, zeta=zeta)
    other = minimize_bound(augment(other_system, 0.5, 1), cost)
    assert best.bound_infimum is None is other.bound_infimum
    assert 1e6 * other.bound == pytest.approx(best.bound, rel=1e-9)


def test_filtered_bound_does_not_depend_on_the_delay_model(best):
    for delay, order in ((0.0, 0), (3.1e-6, 4)):
        plant = augment(homodyne.PAPER.uncertain_system(), delay, order)
        design = design_smoother(plant, best.tau, best.multipliers)
        assert design.bound == pytest.approx(best.bound, rel=1e-9)


def test_infimum_of_the_smoothed_cost_settles_with_the_order_of_the_delay_model(best, example):
    infima = []
    for order in (1, 2, 4):
        plant = augment(example.system, 3.1e-6, order)
        infima.append(minimize_bound(plant, "smoothed", starts=1).bound_infimum)
    assert max(infima) < 0.6 * best.bound_infimum
    changes = np.abs(np.diff(infima))
    assert changes[1] < 0.1 * changes[0]


# --- what is feasible ----------------------------------------------------------------------------


def test_a_wide_sector_with_little_noise_has_designs():
    # In the limit X = 0, and Y exists for a tau large enough whenever gamma < beta: there is a
    # design for each such sector, but at multipliers of less than 1e-4 only.
    wide = replace(homodyne.PAPER, gamma=0.7, alpha=homodyne.PAPER.alpha / 0.1**0.5)
    best = minimize_bound(augment(wide.uncertain_system(), 0.0, 0))
    assert best.bound_infimum == pytest.approx(0.1082874668, rel=1e-8)
    assert best.bound < 1.001 * best.bound_infimum


def test_where_the_measurement_is_worth_nothing_the_least_bound_ignores_it():
    # half the variance of the phase, kappa/(2 lam), as multipliers vanish and tau grows
    best = minimize_bound(augment(homodyne.PAPER.uncertain_system(), 0.0, 0, J_21=30.0))
    assert best.bound == pytest.approx(homodyne.PAPER.kappa / (4 * homodyne.PAPER.lam), rel=1e-3)
    assert best.bound_infimum <= best.bound


def test_multipliers_that_are_zero_at_an_attained_minimum_are_next_to_zero():
    # The copy is of no use to this system: the least bound is that of a filter without one.
    plant = augment(random_system(np.random.default_rng(14), g=1, size=0.03), 0.5, 1)
    best = minimize_bound(plant, "filtered")
    assert best.bound_infimum is None is best.limit
    assert best.multipliers[2] < 1e-3
    without = best.multipliers.copy()
    for fraction in (0.0, 1e-3, 1e-2):  # nor does the bound fall with none or a little of it
        without[2] = fraction
        level = multiplier_level(plant, without)
        bound = design_smoother(plant, best.tau * level, without / level).bound
        assert bound > best.bound * (1 - 1e-6)


def test_a_measurement_too_uncertain_to_use_is_next_to_ignored():
    system = two_channels(0.4, 0.4)
    unusable = Uncertainty([[0.0]], [[5.0]], [[1.0]])
    noisy = replace(system, uncertainties=[system.uncertainties[0], unusable])
    best = minimize_bound(augment(noisy, 0.0, 0))
    assert best.multipliers[0] == pytest.approx(1.0, rel=1e-9)
    assert best.multipliers[1] < 1e-6
    bound = design_smoother(best.plant, best.tau, best.multipliers * [1.0, 1e-4]).bound
    assert best.bound == pytest.approx(bound, rel=1e-6)


def test_what_no_search_finds_is_not_said_to_fail():
    plant = augment(two_channels(5.0, 5.0), 0.0, 0)
    with pytest.raises(InfeasibleDesignError) as caught:
        minimize_bound(plant)
    assert " fails" not in str(caught.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e6, 1e-6, 1.0), (1e-7, 1.0, 1e8)])
def test_a_design_is_found_whatever_the_units_of_the_states(units, capfd):
    # without uncertainty the bound is half the Kalman-Bucy filter's error
    B = np.array([[1.0, 0, 0, 0], [0, 0.3, 0, 0], [0, 0.2, 1.5, 0]])
    D21 = np.array([[0.0, 0, 0, 0.7]])
    system = UncertainSystem(
        A=[[-1.0, 2, 0], [0, -3, 1], [-0.5, 0, -2]],
        B1=B,
        C0=[[0.0, 1, 0]],
        C2=[[1.0, 0, 1]],
        D21=D21,
        uncertainties=[Uncertainty(B, np.zeros((1, 3)), D21)],
    )
    other = in_units(system, x=np.array(units)[:, None], w=1.0, y=1.0, zeta=1.0)
    best = minimize_bound(augment(other, 0.3, 3), "filtered")
    assert best.bound == pytest.approx(0.0226948403613, rel=1e-8)
    assert capfd.readouterr() == ("", "")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("theta", [1e-300, 1e-160, 1e-80, 1e80, 1e160, 1e300])
@pytest.mark.parametrize("cost", COSTS)
def test_points_whose_numbers_overflow_are_refused_in_silence(example, capfd, theta, cost):
    problem = DesignProblem.of(Units.of(example.system).plant(example), cost)
    for scale in (
        np.ones(4),
        np.array([1.0, 1e-100, 1.0, 1e100]),
        np.array([1e-100, 1.0, 1.0, 1.0]),
    ):
        with np.errstate(over="ignore"):
            point = np.minimum(theta * scale, 1e300)
        assert log_bound(problem, point) > -np.inf
    assert capfd.readouterr() == ("", "")


def test_the_default_cost_is_that_of_the_error_asked_for(example):
    assert minimize_bound(example, starts=1).cost == "smoothed"
    assert minimize_bound(augment(example.system, 0.0, 0), starts=1).cost == "filtered"


def test_an_infeasible_problem_is_an_error_that_names_a_condition():
    plant = augment(two_channels(5.0, 5.0), 0.0, 0)
    with pytest.raises(InfeasibleDesignError, match="no design was found; with smaller") as caught:
        minimize_bound(plant)
    assert caught.value.condition == "Assumption 3"
    unstable = replace(two_channels(0.4, 0.4), A=[[1.0]])
    with pytest.raises(InfeasibleDesignError, match="stable"):
        minimize_bound(augment(unstable, 0.0, 0))


def test_a_measurement_without_noise_is_named_before_the_search():
    quiet = UncertainSystem(
        [[-1.0]], [[0.0]], [[1.0]], [[1.0]], [[0.0]], two_channels(0.4, 0.4).uncertainties
    )
    with pytest.raises(InfeasibleDesignError, match=r"^Assumption 2 fails"):
        minimize_bound(augment(quiet, 0.0, 0))


@pytest.mark.parametrize(
    "options, error",
    [
        ({"starts": 0}, ValueError),
        ({"starts": 1.5}, TypeError),
        ({"cost": "both"}, ValueError),
    ],
)
def test_bad_options_are_errors_that_name_them(example, options, error):
    with pytest.raises(error, match=f"^{next(iter(options))} must"):
        minimize_bound(example, **options)


def test_only_an_augmented_system_has_a_bound(example):
    with pytest.raises(TypeError, match=r"got UncertainSystem; augment\(system, delay, order\) ma"):
        minimize_bound(example.system)


def test_random_systems_of_the_strategies_are_mostly_feasible():
    # the property tests leave out what is infeasible: they must not leave out all
    found = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        plant = augment(random_system(rng, n=2, m=1, measurements=1, g=1, size=0.1), 0.5, 1)
        found += feasible_design(rng, plant) is not None
    assert found > 15


def test_search_leaves_the_valley_of_the_filter_that_hardly_listens():
    # With much noise and a wide sector, ignoring the measurement is a local minimum of the bound,
    # about kappa / (4 lam), next to which a start may lie lower than next to the better one.
    loop = homodyne.HomodyneParameters(
        lam=9.14e3, kappa=4e4, alpha=1162.0 / 2.16**0.5, beta=1.0, gamma=0.6
    )
    best = minimize_bound(augment(loop.uncertain_system(), 0.0, 0))
    assert best.bound < 0.3125 < loop.kappa / (4 * loop.lam)
