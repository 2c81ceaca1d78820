"""The estimators to compare with: against python-control, batch least squares and closed forms."""

from dataclasses import replace
from itertools import pairwise

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad_vec
from scipy.linalg import (
    expm,
    solve_continuous_are,
    solve_continuous_lyapunov,
    solve_discrete_lyapunov,
)
from scipy.special import eval_laguerre

from robsmooth import (
    InfeasibleDesignError,
    UncertainSystem,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
    minimize_bound,
)
from robsmooth.estimators.baselines import (
    fixed_lag_smoother,
    kalman_bucy,
    ngcf,
    optimal_fixed_lag_error,
    optimal_two_sided_error,
)
from tests.helpers.strategies import random_system, seeds


def linear_system(A, B1, C2, D21, C0=None):
    C0 = np.eye(len(A)) if C0 is None else C0
    return UncertainSystem(A=A, B1=B1, C0=C0, C2=C2, D21=D21)


def random_linear(seed, n=3, measurements=2, stable=True):
    """A system without channels, its noises correlated, all states to be estimated."""
    rng = np.random.default_rng(seed)
    s = random_system(rng, n=n, m=1, measurements=measurements, g=0)
    A = s.A if stable else s.A + (0.5 - np.linalg.eigvals(s.A).real.max()) * np.eye(n)
    return linear_system(A, s.B1, s.C2, s.D21)


def nominal(design):
    return np.zeros((design.plant.B1_tilde.shape[1], design.plant.C1_tilde.shape[0]))


@given(seeds, st.booleans())
def test_kalman_gain_agrees_with_python_control(seed, stable):
    system = random_linear(seed, stable=stable)
    Q, R = system.B1 @ system.B1.T, system.D21 @ system.D21.T
    # control.lqe does not take correlated noise: remove the correlation from the model first
    S = system.B1 @ system.D21.T
    A = system.A - S @ np.linalg.solve(R, system.C2)
    Q = Q - S @ np.linalg.solve(R, S.T)
    L, P, _ = control.lqe(A, np.eye(3), system.C2, (Q + Q.T) / 2, R)
    expected = L + S @ np.linalg.inv(R)
    kalman = kalman_bucy(system)
    assert_allclose(kalman.B_c, expected, rtol=0, atol=1e-9 * (1 + np.abs(expected).max()))
    assert_allclose(kalman.A_c, system.A - expected @ system.C2, rtol=1e-9, atol=1e-8)
    assert_allclose(optimal_fixed_lag_error(system, 0.0), P, rtol=0, atol=1e-9 * np.trace(P))


@given(seeds)
def test_kalman_gain_agrees_with_scipy_for_correlated_noise(seed):
    system = random_linear(seed)
    R = system.D21 @ system.D21.T
    P = solve_continuous_are(
        system.A.T, system.C2.T, system.B1 @ system.B1.T, R, s=system.B1 @ system.D21.T
    )
    error = error_covariance(kalman_bucy(system), np.zeros((0, 0)), "filtered")
    assert_allclose(error, P, rtol=0, atol=1e-9 * np.trace(P))
    poles = np.linalg.eigvals(system.A - kalman_bucy(system).B_c @ system.C2)
    assert kalman_bucy(system).poles[0].real == pytest.approx(poles.real.max(), rel=1e-9)


@given(seeds, st.floats(0.05, 2.0), st.integers(1, 6))
def test_fixed_lag_smoother_is_the_kalman_filter_of_the_system_with_its_delay_model(
    seed, lag, order
):
    system = random_linear(seed)
    smoother = fixed_lag_smoother(system, lag, order)
    plant = smoother.plant
    A, B, C, D = plant.A_p, plant.B_p1[:, : system.q], plant.C2_tilde, system.D21
    R, S = D @ D.T, B @ D.T
    model = A - S @ np.linalg.solve(R, C)  # without the correlation, which control.lqe has not
    Q = B @ B.T - S @ np.linalg.solve(R, S.T)
    L, P, _ = control.lqe(model, np.eye(len(A)), C, (Q + Q.T) / 2, R)
    expected = L + S @ np.linalg.inv(R)
    assert_allclose(smoother.B_c, expected, rtol=0, atol=1e-9 * (1 + np.abs(expected).max()))
    w = error_covariance(smoother, np.zeros((0, 0)), "filtered")
    assert_allclose(w, plant.C_p0 @ P @ plant.C_p0.T, rtol=0, atol=1e-9 * np.trace(w))


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
@pytest.mark.parametrize("g", [0, 2])
@pytest.mark.parametrize("seed", range(3))
def test_robust_design_tends_to_the_classical_smoother_as_the_uncertainty_vanishes(seed, g, cost):
    # more states than channels, so that none of the noise is taken for the nonlinearities'
    system = random_system(np.random.default_rng(seed), n=5, m=2, measurements=2, g=g)
    certain = replace(
        system,
        uncertainties=[replace(u, C=np.zeros_like(u.C)) for u in system.uncertainties],
        nonlinearities=[replace(c, lipschitz=1e-15) for c in system.nonlinearities],
    )
    plant = augment(certain, 0.4, 3)
    # the uncertainties' noise as it is; nothing known of the nonlinearities but that they are tiny
    multipliers = [1.0] * 2 + [1e-12] * g + [1e12] * g + [1.0 - 1e-12] * g
    robust = design_smoother(plant, 1e11, multipliers, cost)
    classical = fixed_lag_smoother(certain, 0.4, 3)
    size = np.abs(classical.A_c).max()
    assert_allclose(robust.A_c, classical.A_c, rtol=0, atol=1e-9 * size)
    assert_allclose(robust.B_c[:, :2], classical.B_c[:, :2], rtol=0, atol=1e-9 * size)
    for output in ("smoothed", "filtered"):
        pair = [error_covariance(e, nominal(e), output, "real") for e in (robust, classical)]
        assert_allclose(*pair, rtol=0, atol=1e-9 * np.trace(pair[1]))
    filtered = error_covariance(classical, nominal(classical), "filtered")
    if cost == "filtered":  # from above, as the noise that is left to the copies does
        assert -1e-12 < robust.mean_square_bound / np.trace(filtered) - 1.0 < (1e-8 if g else 1e-9)


@given(seeds)
@settings(max_examples=10)
def test_no_other_gain_does_better_than_kalmans(seed):
    rng = np.random.default_rng(seed)
    system = random_linear(seed)
    kalman = kalman_bucy(system)
    best = np.trace(error_covariance(kalman, np.zeros((0, 0)), "filtered"))
    for _ in range(10):
        gain = kalman.B_c + 0.05 * rng.standard_normal(kalman.B_c.shape)
        A_c, noise = system.A - gain @ system.C2, system.B1 - gain @ system.D21
        assert np.linalg.eigvals(A_c).real.max() < 0
        P = solve_continuous_lyapunov(A_c, -noise @ noise.T)
        assert np.trace(P) > best * (1 - 1e-10)


def test_unstable_modes_need_only_be_seen():
    system = linear_system([[2.0]], [[1.0, 0.0]], [[1.0]], [[0.0, 0.5]])
    P = 0.25 * (2 + np.sqrt(4 + 4))  # 2 a P + 1 - P^2/r = 0
    kalman = kalman_bucy(system)
    assert kalman.B_c[0, 0] == pytest.approx(P / 0.25)
    assert kalman.poles[0].real < 0
    unseen = linear_system(np.diag([2.0, -1.0]), np.eye(2, 3), [[0.0, 1.0]], [[0.0, 0.0, 0.5]])
    with pytest.raises(InfeasibleDesignError, match="Kalman-Bucy filter's Riccati equation"):
        kalman_bucy(unseen)


@pytest.mark.parametrize("D21", [[[0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]])
def test_a_measurement_without_noise_is_refused(D21):
    system = linear_system([[-1.0]], [[1.0, 0.0]], np.ones((len(D21), 1)), D21)
    for call in (kalman_bucy, optimal_two_sided_error, lambda s: fixed_lag_smoother(s, 1.0, 2)):
        with pytest.raises(InfeasibleDesignError, match="D21 D21' > 0"):
            call(system)


# --- smoothing ----------------------------------------------------------------------------------


def batch_smoothing_error(system, lag, step):
    """Least squares with all samples of a fine grid: the error of x one lag back.

    y over a step, divided by it, is C2 x + D21 noise/sqrt(step): the prior covariance of the whole
    path, built from the stationary covariance, is conditioned on the samples at once.
    """
    n = system.n
    Phi = expm(system.A * step)
    Q = quad_vec(
        lambda t: expm(system.A * t) @ system.B1 @ system.B1.T @ expm(system.A * t).T, 0, step
    )[0]
    stationary = solve_discrete_lyapunov(Phi, Q)
    decay = -np.linalg.eigvals(system.A).real.max()
    past, future = round(6.0 / decay / step), round(lag / step)
    count = past + future
    powers = [np.eye(n)]
    for _ in range(count):
        powers.append(powers[-1] @ Phi)
    times = np.arange(count + 1)
    C = system.C2
    at = np.array([C @ power @ stationary for power in powers])  # cov(y(t + i), x(t))
    blocks = np.array([value @ C.T for value in at])
    gap = times[:, None] - times[None, :]
    prior = np.where((gap >= 0)[..., None, None], blocks[np.abs(gap)], 0.0)
    prior += np.where((gap < 0)[..., None, None], blocks[np.abs(gap)].swapaxes(-1, -2), 0.0)
    # trapezoidal weights: half a sample at the ends
    weights = np.ones(count + 1)
    weights[[0, -1]] = 0.5
    R = system.D21 @ system.D21.T / step
    total = prior.swapaxes(1, 2).reshape((count + 1) * len(C), -1)
    total += np.kron(np.diag(1 / weights), R)
    cross = np.array(
        [
            powers[abs(i - past)] @ stationary if i >= past else stationary @ powers[past - i].T
            for i in times
        ]
    )
    cross = (C @ cross).reshape(-1, n)
    return stationary - cross.T @ np.linalg.solve(total, cross)


@pytest.mark.parametrize("lag", [0.0, 0.4, 2.0])
def test_optimal_fixed_lag_error_is_that_of_batch_least_squares(lag):
    A = np.array([[-1.0, 1.0], [-1.0, -1.5]])
    system = linear_system(A, [[0.0, 0.0], [1.0, 0.0]], [[1.0, 0.3]], [[0.0, 0.4]])
    coarse, fine = (batch_smoothing_error(system, lag, step) for step in (0.04, 0.02))
    extrapolated = fine + (fine - coarse) / 3  # second order, as the trapezoidal rule
    assert np.abs(fine - coarse).max() < 1e-3 * np.trace(fine)
    assert_allclose(
        optimal_fixed_lag_error(system, lag), extrapolated, rtol=0, atol=1e-4 * np.trace(fine)
    )


@given(seeds, st.floats(0.01, 3.0))
def test_information_of_the_lag_is_its_integral(seed, lag):
    system = random_linear(seed)
    R = system.D21 @ system.D21.T
    P = optimal_fixed_lag_error(system, 0.0)
    A_f = kalman_bucy(system).A_c
    information = quad_vec(
        lambda s: expm(A_f * s).T @ system.C2.T @ np.linalg.solve(R, system.C2) @ expm(A_f * s),
        0.0,
        lag,
        epsrel=1e-9,
    )[0]
    expected = P - P @ information @ P
    assert_allclose(optimal_fixed_lag_error(system, lag), expected, rtol=0, atol=1e-7 * np.trace(P))


@given(seeds)
def test_more_lag_is_never_worse_and_two_sided_is_its_limit(seed):
    system = random_linear(seed)
    two_sided = optimal_two_sided_error(system)
    before = optimal_fixed_lag_error(system, 0.0)
    size = np.trace(before)
    for lag in (0.1, 0.5, 2.0, 8.0):
        error = optimal_fixed_lag_error(system, lag)
        assert np.linalg.eigvalsh(before - error).min() > -1e-8 * size
        before = error
    assert np.linalg.eigvalsh(two_sided).min() > -1e-9 * size
    far = optimal_fixed_lag_error(system, 200.0)
    assert_allclose(two_sided, far, rtol=0, atol=1e-9 * size)
    assert_array_equal(two_sided, optimal_fixed_lag_error(system, np.inf))


def two_sided_by_spectra(system):
    """The non-causal Wiener error: S_x - S_xy S_y^-1 S_yx over all frequencies."""
    n = system.n
    B = np.vstack([system.B1, system.D21])

    def density(theta):
        omega = np.tan(theta)
        to_state = np.linalg.inv(1j * omega * np.eye(n) - system.A)
        x = np.hstack([to_state, np.zeros((n, len(system.D21)))]) @ B
        y = system.C2 @ x + system.D21
        S = x @ x.conj().T - x @ y.conj().T @ np.linalg.solve(y @ y.conj().T, y @ x.conj().T)
        return S.real / np.cos(theta) ** 2

    return quad_vec(density, 0.0, np.pi / 2 * (1 - 1e-10), epsrel=1e-9)[0] / np.pi


@pytest.mark.parametrize("seed", range(4))
def test_two_sided_error_is_the_non_causal_wiener_error(seed):
    system = random_linear(seed)
    expected = two_sided_by_spectra(system)
    assert_allclose(
        optimal_two_sided_error(system), expected, rtol=0, atol=1e-6 * np.trace(expected)
    )


def wiener_error(system, lag, size=2048):
    """The error of x one lag back by spectral factorisation, for a system with one measurement.

    The spectrum of y is factored by its cepstrum, and the optimal estimate is the part of
    S_xy/conj(factor) that the lag lets one know. All on the circle u = (s - a)/(s + a), where
    causal functions are series of powers of u, and those of Laguerre's functions in time.
    """
    n, a = system.n, np.abs(np.linalg.eigvals(system.A)).max()
    angles = 2 * np.pi * (np.arange(size) + 0.5) / size
    u = np.exp(1j * angles)
    s = a * (1 + u) / (1 - u)
    powers = np.fft.fftfreq(size, 1 / size)

    def coefficients(values):
        return np.exp(-1j * powers * angles[0]) * np.fft.fft(values) / size

    x = np.linalg.solve(s[:, None, None] * np.eye(n) - system.A, system.B1 + 0j)
    y = system.C2 @ x + system.D21
    cepstrum = coefficients(np.log((y @ y.conj().swapaxes(1, 2)).real[:, 0, 0])).real
    causal = np.where(powers > 0, cepstrum, 0.0)
    factor = np.exp(cepstrum[0] / 2 + u[:, None] ** np.arange(size // 4) @ causal[: size // 4])
    cross = (x @ y.conj().swapaxes(1, 2))[:, :, 0] / factor.conj()[:, None]
    g = coefficients((cross * ((s + a) / np.sqrt(2 * a))[:, None]).T).real  # (n, size)
    known = g[:, powers >= 0] @ g[:, powers >= 0].T
    terms = np.arange(size // 8)
    later = g[:, -1 - terms]  # of the functions sqrt(2a) e^(-at) L_k(2at) of the time ahead
    if np.isinf(lag):
        known += later @ later.T
    else:
        nodes, weights = np.polynomial.legendre.leggauss(80)
        times, weights = lag * (nodes + 1) / 2, lag * weights / 2
        functions = eval_laguerre(terms[:, None], 2 * a * times) * np.exp(-a * times)
        ahead = later @ functions * np.sqrt(2 * a)
        known += ahead * weights @ ahead.T
    return solve_continuous_lyapunov(system.A, -system.B1 @ system.B1.T) - known


@pytest.mark.parametrize("lag", [0.0, 0.1, 1.0, np.inf])
@pytest.mark.parametrize("seed", range(3))
def test_optimal_error_is_that_of_wieners_spectral_factorisation(seed, lag):
    system = random_linear(seed, measurements=1)
    expected = wiener_error(system, lag)
    found = optimal_fixed_lag_error(system, lag)
    assert_allclose(found, expected, rtol=0, atol=1e-9 * np.trace(expected))


def test_two_sided_error_of_the_example_has_its_closed_form():
    lam, kappa, r = 9.14e3, 4e4, (2 * 1162.0) ** -2
    expected = kappa / (2 * np.sqrt(lam**2 + kappa / r))
    error = optimal_two_sided_error(homodyne.PAPER.uncertain_system())
    assert error[0, 0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("lag", [0.3, 1.5])
def test_fixed_lag_smoother_converges_to_the_optimum_with_its_order(lag):
    rng = np.random.default_rng(4)
    system = random_system(rng, n=2, m=2, measurements=1, g=0)
    floor = optimal_fixed_lag_error(system, lag)
    excess = []
    for order in (0, 1, 2, 4, 8):
        design = fixed_lag_smoother(system, lag, order)
        gap = error_covariance(design, nominal(design)) - floor
        assert np.linalg.eigvalsh(gap).min() > -1e-8 * np.trace(floor)
        excess.append(np.trace(gap))
    # rough signals: the excess falls as a power of the order
    assert excess[-1] < 0.03 * excess[0]
    assert all(after < 0.8 * before for before, after in pairwise(excess))


@pytest.mark.parametrize("delay, order", [(3.1e-6, 2), (3.1e-6, 6), (1e-5, 10), (1e-9, 3)])
def test_filtered_output_of_the_smoother_is_the_kalman_filters(delay, order):
    # Chirarattananon and Anderson: the filter is untouched by the smoother behind it
    system = homodyne.PAPER.uncertain_system()
    kalman, smoother = kalman_bucy(system), fixed_lag_smoother(system, delay, order)
    assert smoother.B_c[0, 0] == pytest.approx(kalman.B_c[0, 0], rel=1e-8)
    assert_allclose(smoother.A_c[0, 1:], 0, atol=1e-6 * abs(kalman.A_c[0, 0]))
    pair = [error_covariance(e, nominal(e), "filtered") for e in (kalman, smoother)]
    assert_allclose(*pair, rtol=1e-8)


def test_no_estimator_beats_the_optimal_errors_nominally():
    system = homodyne.PAPER.uncertain_system()
    delay = 3.1e-6
    filtered, smoothed = (optimal_fixed_lag_error(system, lag)[0, 0] for lag in (0.0, delay))
    robust = minimize_bound(augment(system, delay, 2))
    for design in (fixed_lag_smoother(system, delay, 2), robust):
        P = nominal(design)
        assert error_covariance(design, P, loop="real")[0, 0] > smoothed
        assert error_covariance(design, P, "filtered", loop="real")[0, 0] > filtered - 1e-12
    assert optimal_two_sided_error(system)[0, 0] < smoothed < filtered


# --- robust designs -----------------------------------------------------------------------------


def test_ngcf_is_the_robust_design_without_lag():
    design = ngcf(homodyne.PAPER.uncertain_system())
    assert (design.plant.delay, design.plant.order, design.plant.n) == (0.0, 0, 1)
    assert design.A_c.shape == (1, 1)
    # the smoother's first state is the same filter: a lag does not change the filtered error
    assert design.bound_infimum == pytest.approx(0.121673, abs=2e-6)


@pytest.mark.parametrize(
    "call",
    [
        kalman_bucy,
        ngcf,
        optimal_two_sided_error,
        lambda s: fixed_lag_smoother(s, 1.0, 2),
        lambda s: optimal_fixed_lag_error(s, 1.0),
    ],
)
def test_only_an_uncertain_system_has_an_estimator(call):
    with pytest.raises(TypeError, match="system must be an UncertainSystem"):
        call(np.eye(2))


@pytest.mark.parametrize("lag", [-1.0, np.nan, -np.inf])
def test_a_lag_is_not_negative(lag):
    with pytest.raises(ValueError, match=r"^delay must"):
        optimal_fixed_lag_error(random_linear(0), lag)


@pytest.mark.parametrize("lag", ["1", None, [1.0], np.ones(2)])
def test_a_lag_is_a_number(lag):
    with pytest.raises(TypeError, match=r"^delay must"):
        optimal_fixed_lag_error(random_linear(0), lag)
