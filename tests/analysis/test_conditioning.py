"""Answers far from order one: certified, the same in all units, or refused in a sentence.

Systems of up to 100 states, delay models up to order 12, time in units from nanoseconds to years,
noise over twelve decades, and states in units that lie as far apart.
"""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from robsmooth import (
    InfeasibleDesignError,
    UncertainSystem,
    Uncertainty,
    UnstableLoopError,
    augment,
    delta_sweep,
    design_smoother,
    error_covariance,
)
from robsmooth._numerics.riccati import solve_riccati
from robsmooth.analysis.covariance import closed_loop
from robsmooth.estimators.baselines import (
    fixed_lag_smoother,
    kalman_bucy,
    optimal_fixed_lag_error,
    optimal_two_sided_error,
)
from robsmooth.estimators.smoother import design_equations
from robsmooth.systems.delay import pade_delay
from tests.helpers.rational import exact_covariance
from tests.helpers.strategies import orthogonal_matrix, random_multipliers, random_system, seeds

REFUSALS = (InfeasibleDesignError, UnstableLoopError, ArithmeticError)
NS_TO_YEARS = st.floats(-9.0, 7.5)  # decimal exponents of the unit of time, s
TWELVE_DECADES = st.floats(-6.0, 6.0)


def in_units(system, time=1.0, states=1.0, signal=1.0):
    """The same system with time, each state and w measured in other units.

    The inputs and outputs of the channels get a unit in which their constraints stay as they are.
    """
    x, root = np.broadcast_to(states, system.n), np.sqrt(time)

    def channel(c, *more):
        return type(c)(c.B * root / x[:, None], c.C * root * x, c.D, *more)

    return UncertainSystem(
        A=system.A * time * x / x[:, None],
        B1=system.B1 * root / x[:, None],
        C0=system.C0 * x * signal,
        C2=system.C2 * root * x,
        D21=system.D21,
        uncertainties=[channel(c) for c in system.uncertainties],
        nonlinearities=[channel(c, c.lipschitz) for c in system.nonlinearities],
    )


def noisier(system, factor):
    """Multiply the process noise: the intensity of the first channel and of W there."""
    first, *others = system.uncertainties
    scale = np.sqrt(factor)
    return UncertainSystem(
        system.A,
        system.B1 * scale,
        system.C0,
        system.C2,
        system.D21,
        [Uncertainty(first.B * scale, first.C, first.D), *others],
        system.nonlinearities,
    )


def nominal(estimator):
    return np.zeros((estimator.plant.B1_tilde.shape[1], estimator.plant.C1_tilde.shape[0]))


def relative(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


@st.composite
def problems(draw, max_n, max_order, max_g=0):
    """A system in order-one units, the units to bring it to, a lag and an order."""
    rng = np.random.default_rng(draw(seeds))
    sizes = {name: draw(st.integers(1, 3), label=name) for name in ("m", "measurements")}
    n, g = draw(st.integers(1, max_n), label="n"), draw(st.integers(0, max_g), label="g")
    system = random_system(rng, n=n, g=g, **sizes, size=10.0 ** rng.uniform(-6, -2) / n)
    units = {
        "time": 10.0 ** draw(NS_TO_YEARS, label="time"),
        "states": 10.0 ** rng.uniform(-6, 6, n),
        "signal": 10.0 ** draw(TWELVE_DECADES, label="signal"),
    }
    lag = 10.0 ** draw(st.floats(-9, 2), label="lag")
    return rng, system, units, lag, draw(st.integers(0, max_order), label="order")


# --- estimators of the nominal system ------------------------------------------------------------


@given(problems(max_n=3, max_order=1), TWELVE_DECADES)
def test_error_of_a_smoother_is_that_of_exact_arithmetic(problem, kappa):
    _, system, units, lag, order = problem
    system = in_units(noisier(system, 10.0**kappa), **units)
    smoother = fixed_lag_smoother(system, lag / units["time"], min(order, 3 - system.n))
    A, B = closed_loop(smoother, nominal(smoother))
    # of the same floats: the differences of matrices are rounded here as they are there
    n = smoother.plant.n
    T = np.kron([[1.0, 0.0], [1.0, -1.0]], np.eye(n))
    P = exact_covariance(T @ A @ T, T @ B @ B.T @ T.T)[n:, n:]
    C = smoother.plant.C_p0
    found = error_covariance(smoother, nominal(smoother), "filtered")
    size = np.abs(C) @ np.sqrt(np.diag(P))  # what the terms of C P C' are of the size of
    assert np.abs((found - C @ P @ C.T) / np.outer(size, size)).max() < 1e-11
    assert np.linalg.eigvalsh(found / np.outer(size, size)).min() > -1e-14


@given(problems(max_n=6, max_order=12), TWELVE_DECADES)
def test_nominal_errors_are_the_same_in_all_units(problem, kappa):
    _, system, units, lag, order = problem
    system = noisier(system, 10.0**kappa)
    other = in_units(system, **units)
    for error in (
        lambda s, unit: optimal_fixed_lag_error(s, lag / unit),
        lambda s, unit: optimal_two_sided_error(s),
        lambda s, unit: nominal_error(fixed_lag_smoother(s, lag / unit, order), "smoothed"),
        lambda s, unit: nominal_error(fixed_lag_smoother(s, lag / unit, order), "filtered"),
        lambda s, unit: nominal_error(kalman_bucy(s), "filtered"),
    ):
        here, there = error(system, 1.0), error(other, units["time"]) / units["signal"] ** 2
        assert relative(there, here) < 1e-8
        assert np.diag(here).min() >= 0.0


def nominal_error(estimator, output):
    return error_covariance(estimator, nominal(estimator), output)


@pytest.mark.parametrize("decades", [0, 2, 4, 6])
def test_a_better_filter_has_an_error_with_as_many_digits(decades):
    # one state: 2 a P + P^2/r = kappa; P falls far below the state's variance, kappa/2a
    kappa, r = 10.0**decades, 10.0**-decades
    system = UncertainSystem(
        [[-1.0]], [[np.sqrt(kappa), 0.0]], [[1.0]], [[1.0]], [[0.0, np.sqrt(r)]]
    )
    P = kappa / (1.0 + np.sqrt(1.0 + kappa / r))
    error = nominal_error(kalman_bucy(system), "filtered")[0, 0]
    assert error == pytest.approx(P, rel=1e-13)
    assert optimal_two_sided_error(system)[0, 0] == pytest.approx(
        kappa / (2.0 * np.sqrt(1.0 + kappa / r)), rel=1e-9
    )


@pytest.mark.parametrize("lag", [1e-12, 1e-9, 1e-6])
@pytest.mark.parametrize("order", [3, 12])
def test_a_lag_that_is_next_to_nothing_changes_next_to_nothing(lag, order):
    system = random_system(np.random.default_rng(3), n=4, m=2, measurements=1, g=0)
    here = nominal_error(fixed_lag_smoother(system, lag, order), "smoothed")
    filtered = nominal_error(kalman_bucy(system), "filtered")
    assert relative(here, filtered) < 20 * lag + 1e-12
    plant = augment(system, lag, order)
    bounds = [
        design_smoother(p, 1e3, np.ones(2), "smoothed").bound
        for p in (plant, augment(system, 0, 0))
    ]
    assert bounds[0] == pytest.approx(bounds[1], rel=20 * lag + 1e-9)


@pytest.mark.parametrize("A", [2.0, 0.5])
def test_an_error_of_zero_is_not_negative(A):
    # without process noise an unstable state is known exactly in the end: two-sided smoothing
    # leaves nothing
    system = UncertainSystem([[A]], [[0.0]], [[1.0]], [[1.0]], [[1.0]])
    filtered = optimal_fixed_lag_error(system, 0.0)[0, 0]
    assert filtered == pytest.approx(2.0 * A, rel=1e-12)
    assert 0.0 <= optimal_two_sided_error(system)[0, 0] < 1e-14 * filtered
    assert optimal_fixed_lag_error(system, 1.0)[0, 0] == pytest.approx(
        filtered * np.exp(-2.0 * A), rel=1e-12
    )


# --- robust designs ------------------------------------------------------------------------------


def feasible(rng, plant, cost):
    """Multipliers, and the tau at which a design in order-one units is found."""
    multipliers = random_multipliers(rng, plant)
    for tau in np.geomspace(1.0, 1e6, 7):
        try:
            design_smoother(plant, tau, multipliers, cost)
        except InfeasibleDesignError:
            continue
        return multipliers, 3.0 * tau
    assume(False)


def certify(design):
    """Check both Riccati equations in extended precision, and what the theory wants of a design."""
    equations = design_equations(design.plant, design.tau, design.multipliers, design.cost)
    for X, equation in ((design.X, equations.equation_X()), (design.Y, equations.equation_Y)):
        A, Q, S, X = (value.astype(np.longdouble) for value in (*equation, X))
        residual = A.T @ X + X @ A + Q - X @ S @ X
        size_A, size_Q, size_S, size = (np.sqrt((value**2).sum()) for value in (A, Q, S, X))
        terms = 2 * size_A * size + size_Q + size_S * size**2
        assert np.sqrt((residual**2).sum()) <= 1e-13 * terms
        assert np.linalg.eigvalsh(X.astype(float)).min() >= -1e-12 * size
    assert design.spectral_radius < design.tau
    assert design.poles.real.max() < 0.0
    assert design.bound > 0.0


@given(problems(max_n=6, max_order=12, max_g=2), st.sampled_from(["filtered", "smoothed"]))
def test_designs_are_certified_and_the_same_in_all_units(problem, cost):
    rng, system, units, lag, order = problem
    plant = augment(system, lag, order)
    multipliers, tau = feasible(rng, plant, cost)
    here = design_smoother(plant, tau, multipliers, cost)
    certify(here)
    assert max(c.error for c in here.certificates.values()) < 1e-9
    other = augment(in_units(system, **units), lag / units["time"], order)
    square = units["signal"] ** 2
    there = design_smoother(other, tau * square / units["time"], multipliers, cost)
    assert there.bound / square == pytest.approx(here.bound, rel=1e-9)
    assert there.spectral_radius / there.tau == pytest.approx(here.spectral_radius / tau, abs=1e-9)
    zero = plant.structured_delta((), [0.0] * system.g)
    assert relative(error_covariance(there, zero) / square, error_covariance(here, zero)) < 1e-9
    if system.g:
        slopes = [0.0, 0.5 * min(c.lipschitz for c in system.nonlinearities)]
        assert relative(delta_sweep(there, slopes) / square, delta_sweep(here, slopes)) < 1e-9


@pytest.mark.parametrize("n, order, g", [(100, 12, 2), (60, 4, 0)])
def test_a_hundred_states_are_designed_for_and_certified(n, order, g):
    rng = np.random.default_rng(n)
    system = random_system(rng, n=n, m=3, measurements=3, g=g, size=1e-6)
    plant = augment(system, 0.3, order)
    multipliers = random_multipliers(rng, plant)
    design = design_smoother(plant, 1e3, multipliers)
    certify(design)
    other = augment(in_units(system, 1e-6, 10.0 ** rng.uniform(-6, 6, n)), 0.3e6, order)
    there = design_smoother(other, 1e9, multipliers)
    assert there.bound == pytest.approx(design.bound, rel=1e-9)
    robust = error_covariance(design, nominal(design), loop="real")
    classical = nominal_error(fixed_lag_smoother(system, 0.3, order), "smoothed")
    optimal = optimal_fixed_lag_error(other.system, 0.3e6)
    for better, worse in ((optimal, classical), (classical, robust)):
        assert np.linalg.eigvalsh(worse - better).min() > -1e-9 * np.trace(worse)


@given(seeds, st.integers(1, 4))
def test_time_constants_decades_apart_do_not_blur_what_is_feasible(seed, n):
    """A nonnegative X exists if and only if the uncertain loop's gain is below one."""
    rng = np.random.default_rng(seed)
    rates = 10.0 ** rng.uniform(-5, 5, n)
    T = orthogonal_matrix(rng, n)
    A = (0.3 * T - np.eye(n)) * rates[:, None]
    plain = random_system(rng, n=n, g=1, size=10.0 ** rng.uniform(-5, -2))
    system = UncertainSystem(
        A, plain.B1, plain.C0, plain.C2, plain.D21, plain.uncertainties, plain.nonlinearities
    )
    plant = augment(system, 0.0, 0)
    equations = design_equations(plant, 1.0, random_multipliers(rng, plant))
    roots = []
    for square in (equations.Q_X, equations.worst_noise):
        weights, directions = np.linalg.eigh(square)
        roots.append(directions * np.sqrt(np.maximum(weights, 0.0)))
    omega = np.concatenate([[0.0], np.geomspace(1e-8, 1e8, 2001)])
    to_state = np.linalg.solve(1j * omega[:, None, None] * np.eye(n) - A, roots[1])
    gain = np.linalg.norm(roots[0].T @ to_state, 2, axis=(1, 2)).max()
    assume(abs(gain - 1.0) > 1e-2)  # the grid is not all frequencies
    if gain < 1.0:
        assert solve_riccati(*equations.equation_X()).error < 1e-6
    else:
        with pytest.raises(ArithmeticError):
            solve_riccati(*equations.equation_X())


# --- anything at all -----------------------------------------------------------------------------


@given(seeds, st.sampled_from([8, 60]))
@settings(max_examples=40)
def test_there_is_an_answer_that_is_not_negative_or_a_refusal(seed, decades):
    rng = np.random.default_rng(seed)

    def magnitude(*shape):
        return 10.0 ** rng.uniform(-decades / 2, decades / 2, shape)

    n, g = rng.integers(1, 5), rng.integers(0, 3)
    system = random_system(rng, n=n, m=2, measurements=2, g=g, size=1e-4)
    system = in_units(noisier(system, magnitude()), magnitude(), magnitude(n), magnitude())
    lag, order = magnitude(), rng.integers(0, 13)

    def attempt(compute):
        try:
            return compute()
        except REFUSALS as refusal:
            assert len(str(refusal)) > 20
            return None

    plant = augment(system, lag, order)
    estimators = [
        attempt(lambda: fixed_lag_smoother(system, lag, order)),
        attempt(lambda: design_smoother(plant, magnitude(), random_multipliers(rng, plant))),
    ]
    errors = [attempt(lambda: optimal_fixed_lag_error(system, lag))]
    for estimator in filter(None, estimators):
        for output in ("smoothed", "filtered"):
            errors.append(attempt(lambda: nominal_error(estimator, output)))  # noqa: B023
    for error in errors:
        if error is not None:
            assert np.isfinite(error).all()
            assert np.diag(error).min() >= 0.0


@pytest.mark.parametrize("order", [11, 12])
@pytest.mark.parametrize("delay", [1e-9, 3e7])
def test_delay_models_of_high_order_delay(order, delay):
    omega = np.array([0.0, 0.5, 1.0, 0.5 * order])
    response = pade_delay(delay, order).response(omega / delay)[:, 0, 0]
    assert_allclose(response, np.exp(-1j * omega), rtol=0, atol=1e-9)


def test_augmented_matrices_scale_with_the_unit_of_time():
    system = random_system(np.random.default_rng(0), n=3, g=1)
    here = augment(system, 0.5, 12)
    there = augment(in_units(system, time=2.0**-30), 0.5 * 2.0**30, 12)
    assert_allclose(there.A_p * 2.0**30, here.A_p, rtol=1e-15)
    assert_allclose(augment(system, 0.5, 12).J, augment(there.system, 1.0, 2).J, rtol=0, atol=1e-12)
