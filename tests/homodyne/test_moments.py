"""Stationary errors without sampling, against routes that share nothing with them but the loop."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.linalg import block_diag, expm
from scipy.sparse.linalg import expm_multiply
from scipy.special import ive

from robsmooth import UnstableLoopError, error_covariance, statistical_linearisation
from robsmooth.estimators.baselines import fixed_lag_smoother, kalman_bucy
from robsmooth.homodyne import PAPER, HomodyneParameters, moments
from robsmooth.homodyne.loop import OSCILLATORS, homodyne_loop
from robsmooth.homodyne.moments import StationaryErrors, stationary_errors
from robsmooth.homodyne.montecarlo import monte_carlo
from robsmooth.paper import published
from tests.helpers.loops import for_the_loop
from tests.helpers.printed import printed_estimator
from tests.helpers.strategies import orthogonal_matrix, seeds, stable_matrix

GAIN = 4.5e5  # 1/s, about that of the example's filters
DELAY = published.DELAY
SIGMAS = 4.5
DESIGNS = {"smoother": "smoother, as printed", "NGCF": "NGCF", "Kalman-Bucy": "Kalman-Bucy"}


def designed(name):
    return published.designs()[DESIGNS[name]]


def estimator(A_c, B_c, C_c, C_a, delay=DELAY):
    return for_the_loop(delay, *(np.array(M, float, ndmin=2) for M in (A_c, B_c, C_c, C_a)))


def one_state(pole, gain=GAIN, smoothed=1.0):
    return estimator(pole, gain, 1.0, smoothed)


def classical_with_copy():
    """An estimator whose copy has the filtered estimate for its argument."""
    return fixed_lag_smoother(PAPER.uncertain_system(), 3.1e-6, order=2, copies=True)


def in_coordinates(design, T, delay=None):
    """The same estimator with the state T x_hat."""
    inverse = np.linalg.inv(T)
    return estimator(
        T @ design.A_c @ inverse,
        T @ design.B_c,
        design.C_c @ inverse,
        design.C_a @ inverse,
        design.plant.delay if delay is None else delay,
    )


def at_degree(parameters, design, degree, **options):
    """What `stationary_errors` finds with the polynomials of a degree."""
    problem = moments.whitened(homodyne_loop(parameters, design, **options))
    degrees = range(max(2, degree - 4), degree + 1, 2)
    return moments._result(problem, [moments._errors(problem, N) for N in degrees], degree)


def errors(*arguments, **options):
    result = (at_degree if len(arguments) == 3 else stationary_errors)(*arguments, **options)
    return np.array([result.smoothed, result.filtered])


def truncation(result):
    return np.array([result.smoothed_truncation, result.filtered_truncation])


def linear_errors(loop, sine_slope, copy_slope):
    """The smoothed and filtered errors of the linear loop."""
    A = loop.linearised_drift(sine_slope, copy_slope)
    P = loop.covariance(sine_slope, copy_slope)
    smoothed, filtered = np.array([0.0, *loop.readout[1]]), np.array([1.0, *-loop.readout[0]])
    cross = smoothed @ expm(A * loop.delay) @ P[:, 0]
    return np.array(
        [P[0, 0] - 2 * cross + smoothed @ P @ smoothed, filtered @ P @ filtered],
    )


# --- exact solutions ------------------------------------------------------------------------------


def scalar_diffusion(parameters, shot_noise):
    """Half the noise power of the error of a filter with gain `GAIN`, rad^2/s."""
    measured = (GAIN / (2 * parameters.alpha * parameters.beta)) ** 2 * shot_noise
    return (parameters.kappa + measured) / 2


def variance_of_density(potential, diffusion):
    """Variance under exp(-potential / diffusion) on the turn about zero."""

    def moment(power):
        return quad(
            lambda e: e**power * np.exp(-potential(e) / diffusion),
            -np.pi,
            np.pi,
            epsabs=0.0,
            epsrel=1e-12,
            limit=200,
        )[0]

    return moment(2) / moment(0)


@pytest.mark.parametrize(("noise", "tolerance"), [(0.1, 1e-12), (0.3, 1e-10), (1.0, 5e-8)])
def test_error_of_a_scalar_loop_has_its_density(noise, tolerance):
    # With the pole at -lam - K the error is a diffusion by itself: de = -(lam e + K sin e) dt + dN.
    parameters = replace(PAPER, kappa=noise * PAPER.kappa)
    exact = variance_of_density(
        lambda e: GAIN * (1 - np.cos(e)) + parameters.lam * e**2 / 2,
        scalar_diffusion(parameters, noise),
    )
    found = stationary_errors(parameters, one_state(-PAPER.lam - GAIN), shot_noise=noise)
    assert found.filtered == pytest.approx(exact, rel=tolerance)
    # Where the tails leave the lobe, the digits after those do not mean anything.
    lock = 10 * np.exp(-2 * GAIN / scalar_diffusion(parameters, noise))
    assert abs(found.filtered - exact) <= 2 * found.filtered_truncation + lock


@pytest.mark.parametrize("gain", [0.6, 0.7, 0.8, 1.0, 1.2])
def test_stated_error_covers_the_true_one_far_from_the_papers_noise(gain):
    """The filter for each gain of the detector; at 0.6 the law gives 0.149912608 rad^2."""
    parameters = PAPER.with_gain(gain)
    filter_ = kalman_bucy(parameters.uncertain_system())
    for noise in (0.3, 0.6, 1.0, 1.3, 1.5, 1.7):
        loop = homodyne_loop(parameters, filter_, shot_noise=noise)
        rate, diffusion = loop.gains[1, 0], (loop.noise[0, 0] ** 2 + loop.noise[1, 1] ** 2) / 2
        exact = variance_of_density(
            lambda e, rate=rate: rate * (1 - np.cos(e)) + parameters.lam * e**2 / 2, diffusion
        )
        found = stationary_errors(parameters, filter_, shot_noise=noise)
        assert abs(found.filtered - exact) <= found.filtered_truncation
        assert found.filtered_truncation < 1e-3 * exact
        if (gain, noise) == (0.6, 1.0):
            assert exact == pytest.approx(0.1499126080, rel=2e-9)


@pytest.mark.parametrize("lam", [100.0, 1e-1])
def test_error_of_a_loop_for_a_wandering_phase_is_von_mises(lam):
    # Without the phase's decay, the law of the error is Tikhonov's, exp(cos(e) K/D), whose variance
    # is pi^2/3 + 4 sum (-1)^k I_k(K/D)/(k^2 I_0(K/D)); the decay corrects it by about lam/K.
    noise = 0.2
    parameters = replace(PAPER, kappa=noise * PAPER.kappa, lam=lam)
    concentration = GAIN / scalar_diffusion(parameters, noise)
    k = np.arange(1, 200)
    terms = (-1.0) ** k / k**2 * ive(k, concentration) / ive(0, concentration)
    found = stationary_errors(parameters, one_state(-lam - GAIN), shot_noise=noise)
    assert found.filtered == pytest.approx(
        np.pi**2 / 3 + 4 * terms.sum(), rel=2 * lam / GAIN + 1e-9
    )


def test_estimate_of_a_still_phase_has_its_density():
    # With next to no process noise the phase is zero and the estimate a scalar diffusion.
    still = replace(PAPER, kappa=1e-25)
    pole, noise = -3.0 * GAIN, 0.5
    loop = homodyne_loop(still, one_state(pole), shot_noise=noise)
    growth = loop.drift[1, 1]
    exact = variance_of_density(
        lambda x: GAIN * (1 - np.cos(x)) - growth * x**2 / 2, loop.noise[1, 1] ** 2 / 2
    )
    found = stationary_errors(still, one_state(pole), shot_noise=noise)
    assert_allclose([found.smoothed, found.filtered], exact, rtol=1e-10)


@pytest.mark.parametrize("variance", [0.3, 1.0])
def test_literal_nonlinearity_without_copy_is_a_filter_of_the_sine(variance):
    # x_hat is b sin(phi) through a pole a, and the sine has the correlation
    # E sin(phi_0) sin(phi_t) = e^-V sinh(V e^(-lam |t|)).
    a, lam = 0.5 * GAIN, PAPER.lam
    parameters = replace(PAPER, kappa=2 * lam * variance)
    design = one_state(-a, smoothed=0.7)
    loop = homodyne_loop(parameters, design, oscillator="none")
    b, w = loop.gains[1, 0], loop.noise[1, 1]

    def integral(function, start, stop):
        return quad(function, start, stop, epsabs=0.0, epsrel=1e-12, limit=200)[0]

    def sine_correlation(t):
        return np.exp(-variance) * np.sinh(variance * np.exp(-lam * t))

    square = w**2 / (2 * a) + b**2 / a * integral(
        lambda t: np.exp(-a * t) * sine_correlation(t), 0.0, 60 / a
    )
    slope = b * variance * np.exp(-variance / 2)
    now = slope / (a + lam)
    later = slope * (
        integral(lambda t: np.exp(-a * t - lam * (DELAY - t)), 0.0, DELAY)
        + np.exp(-a * DELAY) / (a + lam)
    )
    exact = [variance - 2 * 0.7 * later + 0.49 * square, variance - 2 * now + square]
    found = stationary_errors(parameters, design, oscillator="none", copy=False)
    assert_allclose([found.smoothed, found.filtered], exact, rtol=2e-8)


# --- the Fokker-Planck equation of two variables -------------------------------------------------


def periodic_derivative(size, length):
    """Derivative of trigonometric interpolation at equidistant points, an odd number of them."""
    difference = np.arange(size)[:, None] - np.arange(size)
    off_diagonal = 0.5 * (-1.0) ** difference / np.sin(np.pi * (difference + np.eye(size)) / size)
    return 2 * np.pi / length * (1 - np.eye(size)) * off_diagonal


def fokker_planck_errors(loop, points=37, width=7.0):
    """Errors of a one-state estimator from the density of (e, phi) on a periodic box.

    Fourier collocation, forward in time: neither the polynomials nor the adjoint of the module's.
    It agrees with them to 1e-7 here, and to 3e-10 with 49 points and a width of 8 deviations.
    """
    P = loop.covariance(*loop.equivalent_slopes())
    row = loop.arguments[0]
    boxes = 2 * width * np.sqrt([row @ P @ row, P[0, 0]])
    grid = np.arange(points) / points - 0.5 * (1 - 1 / points)
    e, phi = (g.ravel() for g in np.meshgrid(grid * boxes[0], grid * boxes[1], indexing="ij"))
    r = -row[1]
    x = (phi - e) / r

    phase_drift = loop.drift[0, 0] * phi
    estimate_drift = (
        loop.drift[1, 1] * x
        + loop.gains[1, 0] * np.sin(e)
        + loop.gains[1, 1] * np.sin(loop.arguments[1, 1] * x)
    )
    phase_noise = loop.noise[0, 0] ** 2
    error_noise = phase_noise + (r * loop.noise[1, 1]) ** 2
    De = np.kron(periodic_derivative(points, boxes[0]), np.eye(points))
    Dphi = np.kron(np.eye(points), periodic_derivative(points, boxes[1]))
    current_e = (phase_drift - r * estimate_drift) * np.eye(len(e))
    current_e -= error_noise / 2 * De + phase_noise * Dphi
    current_phi = phase_drift * np.eye(len(e)) - phase_noise / 2 * Dphi
    flow = -De @ current_e - Dphi @ current_phi

    system, right = flow / GAIN, np.zeros(len(e))
    centre = len(e) // 2
    system[centre], right[centre] = 1.0, 1.0
    density = np.linalg.solve(system, right)
    later = expm_multiply(flow * loop.delay, phi * density)
    smoothed = loop.readout[1, 0] * x
    return [
        density @ (phi**2 + smoothed**2) - 2 * smoothed @ later,
        density @ (phi - loop.readout[0, 0] * x) ** 2,
    ]


@pytest.mark.parametrize(
    ("pole", "copy", "smoothed", "options"),
    [
        pytest.param(-1.3 * GAIN, None, 0.8, {}, id="wrong pole"),
        pytest.param(-GAIN, (0.3, 1.7), 0.8, {}, id="copy"),
        pytest.param(-GAIN, (0.3, 1.7), 0.8, {"copy": False}, id="copy off"),
        pytest.param(-GAIN, (-0.2, 0.4), 0.9, {"oscillator": "smoothed"}, id="oscillator"),
        pytest.param(-GAIN, None, 0.8, {"shot_noise": 0.0}, id="no shot noise"),
    ],
)
def test_errors_agree_with_the_fokker_planck_equation(pole, copy, smoothed, options):
    parameters = replace(PAPER, kappa=0.5 * PAPER.kappa, lam=0.1 * GAIN)
    design = one_state(pole, smoothed=smoothed)
    if copy is not None:
        gain, argument = copy
        scale = 2 * PAPER.alpha
        C_c = [[1.0], [scale * PAPER.gamma * argument]]
        design = estimator(pole, [[GAIN, gain * GAIN / scale]], C_c, smoothed)
    options = {"shot_noise": 0.4, **options}
    loop = homodyne_loop(parameters, design, **options)
    found = stationary_errors(parameters, design, **options)
    assert_allclose([found.smoothed, found.filtered], fokker_planck_errors(loop), rtol=5e-7)


# --- limits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DESIGNS)
def test_errors_of_a_quiet_loop_are_the_linear_ones(name):
    quiet = 1e-10
    parameters = replace(PAPER, kappa=quiet * PAPER.kappa)
    loop = homodyne_loop(parameters, designed(name), shot_noise=quiet)
    found = errors(parameters, designed(name), shot_noise=quiet)
    assert_allclose(found, linear_errors(loop, 1.0, 1.0), rtol=1e-10)
    tangent = designed(name).plant.structured_delta((), [(1.0 - PAPER.beta) / PAPER.gamma])
    covariances = [
        error_covariance(designed(name), tangent, output, loop="real", allow_inadmissible=True)
        for output in ("smoothed", "filtered")
    ]
    assert_allclose(found, quiet * np.ravel(covariances), rtol=1e-9)


@pytest.mark.parametrize("name", DESIGNS)
def test_statistical_linearisation_is_right_to_a_relative_second_order(name):
    predicted = statistical_linearisation(PAPER, designed(name))
    found = stationary_errors(PAPER, designed(name))
    for output in ("smoothed", "filtered"):
        correction = getattr(found, output) / getattr(predicted, output) - 1
        assert 0 < correction < 0.5 * predicted.filtered**2


def test_correction_of_statistical_linearisation_is_of_third_order_in_the_noise():
    def correction(noise):
        parameters = replace(PAPER, kappa=noise * PAPER.kappa)
        design = published.recomputed_estimator()
        loop = homodyne_loop(parameters, design, shot_noise=noise)
        linear = linear_errors(loop, *loop.equivalent_slopes())
        return errors(parameters, design, shot_noise=noise) - linear

    orders = [np.log2(correction(s) / correction(s / 2)) for s in (0.1, 0.025)]
    assert_allclose(orders[0], 3.0, atol=0.15)
    assert_allclose(orders[1], 3.0, atol=0.04)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"copy": False},
        {"oscillator": "smoothed"},
        {"oscillator": "copy"},
        {"shot_noise": 0.3},
    ],
    ids=str,
)
def test_errors_agree_with_a_simulation(options):
    design, step = published.recomputed_estimator(), 1e-8
    simulated = monte_carlo(PAPER, design, runs=2048, step=step, seed=11, **options)
    found = stationary_errors(PAPER, design, **options)
    # The scheme's bias, relative: half a step times the rate of the filter, and next to nothing.
    for output, bias in (("filtered", 0.0023), ("smoothed", 0.0003)):
        sample, exact = getattr(simulated, output), getattr(found, output)
        error = abs(sample.mean_square - exact)
        assert error < SIGMAS * sample.standard_error + 1.5 * bias * exact
    assert simulated.slips == 0


# --- convergence ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "noise", "highest"),
    [
        ("NGCF", 0.1, 16),
        ("NGCF", 1.0, 16),
        ("NGCF", 2.0, 12),
        ("smoother", 0.3, 12),
        ("smoother", 1.0, 12),
    ],
)
def test_truncation_error_is_within_its_estimate(name, noise, highest):
    parameters = replace(PAPER, kappa=noise * PAPER.kappa)
    results = [
        at_degree(parameters, designed(name), degree, shot_noise=noise)
        for degree in range(4, highest + 1, 2)
    ]
    best = results[-1]
    for result in results[:-1]:
        for output in ("smoothed", "filtered"):
            error = abs(getattr(result, output) - getattr(best, output))
            estimates = [getattr(r, f"{output}_truncation") for r in (result, best)]
            assert error <= sum(estimates)


def test_default_degree_meets_its_tolerance_and_is_the_least_that_does():
    design = published.recomputed_estimator()
    result = stationary_errors(PAPER, design, shot_noise=0.3)
    assert (truncation(result) <= 1e-8 * np.array([result.smoothed, result.filtered])).all()
    assert result == at_degree(PAPER, design, result.degree, shot_noise=0.3)
    lower = at_degree(PAPER, design, result.degree - 2, shot_noise=0.3)
    assert (truncation(lower) > 1e-8 * np.array([lower.smoothed, lower.filtered])).any()


def test_large_estimators_get_a_lower_degree_and_say_how_good_it_is():
    # Nine states: the filter, and eight first-order lags of its estimate in a row.
    filter_ = published.designs()["Kalman-Bucy"]
    chain = np.eye(8, k=-1) - np.eye(8)
    A = block_diag(filter_.A_c, 8 / DELAY * chain)
    A[1, 0] = 8 / DELAY
    C_c = np.c_[filter_.C_c, np.zeros((2, 8))]
    design = estimator(A, np.r_[filter_.B_c, np.zeros((8, 2))], C_c, np.eye(9)[8:])
    large = stationary_errors(PAPER, design)
    small = stationary_errors(PAPER, filter_)
    assert (large.degree, small.degree) == (4, 14)
    assert 1e-6 < abs(large.filtered - small.filtered) < large.filtered_truncation < 2e-3


def test_repr_tells_values_truncation_and_degree():
    result = StationaryErrors(0.05, 0.09, 1e-9, 2e-9, 12)
    assert repr(result) == (
        "StationaryErrors(smoothed 0.05 +- 1e-09 rad^2, filtered 0.09 +- 2e-09 rad^2; degree 12)"
    )


# --- invariances ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("seconds", [1e-6, 3e4])
def test_unit_of_time_does_not_matter(name, seconds):
    design = designed(name)
    root = np.sqrt(seconds)
    parameters = replace(
        PAPER,
        lam=PAPER.lam * seconds,
        kappa=PAPER.kappa * seconds,
        alpha=PAPER.alpha * root,
    )
    rescaled = estimator(
        design.A_c * seconds,
        design.B_c * [seconds, root],
        design.C_c * [[1.0], [root]],
        design.C_a,
        design.plant.delay / seconds,
    )
    assert_allclose(errors(parameters, rescaled, 8), errors(PAPER, design, 8), rtol=1e-11)


@pytest.mark.parametrize("scales", [(1.0, 1.0, 1.0), (1e-6, 1.0, 1e6), (1e9, 1e-9, 1.0)])
def test_coordinates_of_the_state_do_not_matter(scales):
    design = printed_estimator()  # whose copy's argument is not zero
    rng = np.random.default_rng(3)
    T = np.diag(scales) @ rng.standard_normal((3, 3))
    assert_allclose(
        errors(PAPER, in_coordinates(design, T), 8), errors(PAPER, design, 8), rtol=1e-8
    )


@pytest.mark.parametrize("rotated", [False, True])
def test_redundant_and_idle_states_do_not_matter(rotated):
    # Every state twice, and the estimate the mean of both; and one that nothing drives.
    design = printed_estimator()
    A = block_diag(design.A_c, design.A_c, -1.0)
    B = np.vstack([design.B_c, design.B_c, np.zeros((1, 2))])
    half = np.c_[design.C_c / 2, design.C_c / 2, np.ones((2, 1))]
    C_a = np.c_[np.zeros_like(design.C_a), design.C_a, 5.0]
    redundant = estimator(A, B, half, C_a, DELAY)
    if rotated:
        redundant = in_coordinates(redundant, orthogonal_matrix(np.random.default_rng(4), 7))
    assert_allclose(errors(PAPER, redundant, 4), errors(PAPER, design, 4), rtol=1e-9)


@pytest.mark.parametrize("kappa", [1e-3, 1e-12])
def test_direction_that_hardly_moves_is_as_good_as_still(kappa):
    design = published.recomputed_estimator()
    still, moving = replace(PAPER, kappa=1e-25), replace(PAPER, kappa=kappa)
    assert_allclose(errors(moving, design, 6), errors(still, design, 6), rtol=1e-4 * kappa + 1e-9)


def test_without_lag_and_with_one_readout_smoothed_is_filtered():
    design = published.recomputed_estimator()
    prompt = in_coordinates(design, np.eye(3), delay=0.0)
    prompt = replace(prompt, C_a=design.C_f)
    for oscillator in ("filtered", "smoothed"):
        result = stationary_errors(PAPER, prompt, oscillator=oscillator)
        assert result.smoothed == pytest.approx(result.filtered, rel=1e-12)


def test_an_oscillator_at_the_copy_s_argument_leaves_the_copy_nothing_to_do():
    design, kept = printed_estimator(), classical_with_copy()
    steered = errors(PAPER, design, oscillator="copy")
    # The same loop without a copy, of an estimator whose filtered estimate is the copy's argument.
    alone = replace(design, C_f=design.C_c[1:] / (2 * PAPER.alpha * PAPER.gamma))
    without = stationary_errors(PAPER, alone, copy=False)
    assert steered[0] == pytest.approx(without.smoothed, rel=1e-9)
    assert steered[0] != pytest.approx(errors(PAPER, design)[0], rel=1e-6)
    # Where the copy's argument is the filtered estimate, both oscillators are one.
    assert_allclose(errors(PAPER, kept, oscillator="copy"), errors(PAPER, kept), rtol=1e-9)


def test_after_a_very_long_lag_the_estimate_knows_nothing():
    design = published.recomputed_estimator()
    long, longer = (in_coordinates(design, np.eye(3), delay) for delay in (6e-3, 1.0))
    forgotten = errors(PAPER, longer, 6)
    prior = PAPER.kappa / (2 * PAPER.lam)
    assert forgotten[0] > prior
    assert_allclose(errors(PAPER, long, 6), forgotten, rtol=1e-10)


def test_copy_that_is_off_is_no_copy():
    design = printed_estimator()
    without = estimator(design.A_c, design.B_c[:, :1], design.C_c[:1], design.C_a)
    assert_allclose(
        errors(PAPER, design, 6, copy=False), errors(PAPER, without, 6), rtol=1e-12, atol=0.0
    )
    assert abs(errors(PAPER, design, 6)[0] / errors(PAPER, without, 6)[0] - 1) > 1e-9


@pytest.mark.parametrize("lam", [10.0, 1e3, PAPER.lam])
def test_estimator_without_a_copy_is_in_lock_however_far_the_phase_wanders(lam):
    parameters = replace(PAPER, lam=lam)
    system = parameters.uncertain_system()
    without, at_the_reference = (
        errors(parameters, fixed_lag_smoother(system, DELAY, 2, copies=copies), 6)
        for copies in (False, True)
    )
    assert_allclose(without, at_the_reference, rtol=1e-9)


def random_loop(rng, n):
    """Parameters and an estimator of order one, with noise that keeps the loop in lock."""
    parameters = HomodyneParameters(
        lam=rng.uniform(0.1, 1.0),
        kappa=rng.uniform(0.01, 0.1),
        alpha=rng.uniform(2.0, 4.0),
        beta=rng.uniform(0.8, 1.2),
        gamma=rng.uniform(0.2, 0.6),
    )
    design = estimator(
        stable_matrix(rng, n),
        rng.standard_normal((n, 2)) * [1.0, 0.3],
        rng.standard_normal((2, n)),
        rng.standard_normal((1, n)),
        rng.exponential(),
    )
    return parameters, design


def errors_or_reject(*arguments, **options):
    try:
        return at_degree(*arguments, **options)
    except (UnstableLoopError, ArithmeticError):
        assume(False)


options_of_the_loop = st.fixed_dictionaries(
    {
        "oscillator": st.sampled_from(OSCILLATORS),
        "copy": st.booleans(),
        "shot_noise": st.floats(0.0, 1.0),
    }
).filter(lambda options: options["copy"] or options["oscillator"] != "copy")


@given(seed=seeds, n=st.integers(1, 3), options=options_of_the_loop)
def test_unit_of_time_and_coordinates_do_not_matter_for_random_loops(seed, n, options):
    rng = np.random.default_rng(seed)
    parameters, design = random_loop(rng, n)
    expected = errors_or_reject(parameters, design, 6, **options)
    seconds = 10.0 ** rng.uniform(-6, 6)
    root = np.sqrt(seconds)
    T = np.diag(10.0 ** rng.uniform(-4, 4, n)) @ orthogonal_matrix(rng, n)
    design = in_coordinates(design, T, design.plant.delay / seconds)
    changed = replace(
        design,
        A_c=design.A_c * seconds,
        B_c=design.B_c * [seconds, root],
        C_c=design.C_c * [[1.0], [root]],
    )
    units = {"lam": seconds, "kappa": seconds, "alpha": root}
    parameters = replace(parameters, **{k: getattr(parameters, k) * u for k, u in units.items()})
    found = at_degree(parameters, changed, 6, **options)
    values = np.array([expected.smoothed, expected.filtered])
    assert_allclose([found.smoothed, found.filtered], values, rtol=1e-7)


@given(seed=seeds, n=st.integers(1, 3), options=options_of_the_loop)
def test_truncation_error_of_random_loops_is_within_its_estimate(seed, n, options):
    parameters, design = random_loop(np.random.default_rng(seed), n)
    low = errors_or_reject(parameters, design, 6, **options)
    high = errors_or_reject(parameters, design, 10, **options)
    for output in ("smoothed", "filtered"):
        error = abs(getattr(low, output) - getattr(high, output))
        assert error <= getattr(low, f"{output}_truncation") + getattr(high, f"{output}_truncation")


# --- no result ------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [7.0, 12.0])
def test_loop_that_slips_is_an_error(noise):
    with pytest.raises(ArithmeticError, match=r"so noisy that it slips.* use monte_carlo instead"):
        stationary_errors(PAPER, published.designs()["NGCF"], shot_noise=noise)


@pytest.mark.parametrize("noise", [17.75, 30.0, 1000.0])
def test_loop_out_of_lock_is_unstable(noise):
    with pytest.raises(UnstableLoopError, match="the loop is not in lock"):
        stationary_errors(PAPER, published.designs()["NGCF"], shot_noise=noise)


def test_unstable_estimator_is_named():
    with pytest.raises(UnstableLoopError, match=r"slowest mode has the decay rate -1e\+06 1/s"):
        stationary_errors(PAPER, one_state(1e6, gain=1.0, smoothed=1.0))


def test_a_phase_that_does_not_decay_has_the_errors_of_one_that_hardly_does():
    system = replace(PAPER, lam=0.0).uncertain_system()
    design = fixed_lag_smoother(system, 0.0, 0, copies=True)
    none, little = (stationary_errors(replace(PAPER, lam=lam), design) for lam in (0.0, 1.0))
    assert none.filtered == pytest.approx(little.filtered, rel=1e-5)
    assert stationary_errors(replace(PAPER, lam=1e-11), design).filtered == none.filtered


def test_too_many_states_are_an_error():
    design = estimator(-np.eye(17), np.ones((17, 1)), np.ones((1, 17)), np.ones((1, 17)))
    with pytest.raises(
        ValueError, match=r"the 17 states of smoother make .* unknowns at the least degree"
    ):
        stationary_errors(PAPER, design)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"oscillator": "wrong"}, ValueError, "oscillator must be one of"),
        ({"oscillator": "copy", "copy": False}, ValueError, "where no copy runs, got 'copy'"),
        ({"copy": 1}, TypeError, "copy must be True or False"),
        ({"shot_noise": -1.0}, ValueError, "shot_noise must be finite"),
    ],
)
def test_bad_options_are_errors(options, error, message):
    with pytest.raises(error, match=message):
        stationary_errors(PAPER, published.designs()["NGCF"], **options)
