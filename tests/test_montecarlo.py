"""The Monte Carlo: its noise, its kernel and its statistics, each against an independent route.

Seeds are fixed, so these tests cannot fail by chance. Had the seeds been free, a correct program
would fail a comparison at `SIGMAS` = 4.5 standard errors once in 150 000 times.
"""

import json
import math
import os
import subprocess
import sys
import types
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import njit
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import (
    expm,
    solve_continuous_are,
    solve_continuous_lyapunov,
    solve_discrete_lyapunov,
)
from scipy.stats import chi2, norm

from robsmooth.errors import UnstableLoopError
from robsmooth.loop import homodyne_loop
from robsmooth.montecarlo import MeanSquare, kernels, monte_carlo, noise, run
from robsmooth.montecarlo.kernels import FILTERED, SLIPPED, SMOOTHED
from robsmooth.montecarlo.noise import LANES
from robsmooth.montecarlo.protocols import Moments, Schedule, time_average, warm_up_time

SIGMAS = 4.5
PARAMETERS = types.SimpleNamespace(lam=9.14e3, kappa=4e4, alpha=1162.0, beta=1.0, gamma=0.4)
QUIET = 1e-4  # noise power at which the loop is linear: sin e differs from e by a relative 1e-6


def quiet(parameters):
    return types.SimpleNamespace(**{**vars(parameters), "kappa": QUIET * parameters.kappa})


def printed_smoother(delay=3.1e-6):
    """The estimator printed in Section IV-B, in the paper's coordinates of the delay model."""
    return types.SimpleNamespace(
        A_c=np.array(
            [[-4.58e5, -0.09, -7.14], [1.93e3, -1.93e6, -1.19e6], [-550.1, 1.0486e6, -0.01]]
        ),
        B_c=np.array([[4.45e5, -190.97], [120.98, -0.052], [545.41, -0.233]]),
        C_c=np.array([[1.02, 4.21e-7, 3.23e-5], [944.68, 3.9e-4, 0.0299]]),
        C_a=np.array([[1.0, -(12 / 3.1e-6) / 2048, 0.0]]),
        plant=types.SimpleNamespace(delay=delay),
    )


def kalman_filter(parameters=PARAMETERS, delay=0.0):
    """The Kalman filter of the linearised loop: one state, no copy of the nonlinearity."""
    intensity = (2 * parameters.alpha * parameters.beta) ** -2
    P = solve_continuous_are([[-parameters.lam]], [[1.0]], [[parameters.kappa]], [[intensity]])
    gain = P / intensity
    return types.SimpleNamespace(
        A_c=-parameters.lam - gain,
        B_c=gain,
        C_c=np.ones((1, 1)),
        C_a=np.ones((1, 1)),
        plant=types.SimpleNamespace(delay=delay),
    )


def changed(estimator, **matrices):
    return types.SimpleNamespace(**{**vars(estimator), **matrices})


def gaussians(seed, first_path, steps):
    """The noise of LANES paths: (steps, 2, LANES)."""
    generator = np.empty(noise.WORDS * LANES, np.uint32)
    noise.seed_lanes(np.uint64(seed), np.uint64(first_path), generator)
    draws = np.empty(steps * noise.DRAWS * LANES, np.float32)
    noise.fill_gaussians(generator, steps, draws)
    return draws.reshape(steps, noise.DRAWS, LANES)


def assert_within(values, expected, standard_error):
    assert np.all(np.abs(np.asarray(values) - expected) <= SIGMAS * standard_error), (
        values,
        expected,
        standard_error,
    )


# --- noise ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def draws():
    """Noise of 128 paths, 5 million numbers: (steps, 2, paths)."""
    return np.concatenate([gaussians(7, b * LANES, 20_000) for b in range(4)], axis=2).astype(float)


def splitmix64(z):
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
    return z ^ (z >> 31)


def test_noise_is_box_muller_of_xoshiro128_plus():
    golden, seed, steps = 0x9E3779B97F4A7C15, 2**64 - 3, 50
    draws = gaussians(seed, 1000, steps)
    for lane in (0, 1, 31):
        z = splitmix64((splitmix64((seed + golden) % 2**64) + (1000 + lane) * golden) % 2**64)
        words = [splitmix64((z + k * golden) % 2**64) for k in (1, 2)]
        s = [part for word in words for part in (word >> 32, word % 2**32)]
        for step in range(steps):
            outputs = []
            for _ in range(2):
                outputs.append((s[0] + s[3]) % 2**32)
                t = (s[1] << 9) % 2**32
                s[2] ^= s[0]
                s[3] ^= s[1]
                s[1] ^= s[2]
                s[0] ^= s[3]
                s[2] ^= t
                s[3] = (s[3] << 11) % 2**32 | s[3] >> 21
            a, b = outputs
            radius = math.sqrt(-2 * math.log(((a >> 1) + 0.5) / 2**31))
            signed = (b << 1) % 2**32
            angle = (signed - 2**32 if signed >= 2**31 else signed) * math.pi / 2**32
            sign = -1 if b >> 31 else 1
            expected = [sign * radius * math.cos(angle), radius * math.sin(angle)]
            assert_allclose(draws[step, :, lane], expected, atol=2e-6)


def test_gaussians_have_the_moments_of_a_normal_distribution(draws):
    for values in (draws[:, 0], draws[:, 1]):
        n = values.size
        assert_within(values.mean(), 0, math.sqrt(1 / n))
        assert_within((values**2).mean(), 1, math.sqrt(2 / n))
        assert_within((values**3).mean(), 0, math.sqrt(15 / n))
        assert_within((values**4).mean(), 3, math.sqrt(96 / n))


def test_gaussians_fill_bins_of_equal_probability_equally(draws):
    bins = 1000
    for values in (draws[:, 0], draws[:, 1]):
        counts = np.histogram(norm.cdf(values), bins, (0, 1))[0]
        statistic = ((counts - values.size / bins) ** 2).sum() / (values.size / bins)
        assert statistic < chi2.isf(2 * norm.sf(SIGMAS), bins - 1)


@pytest.mark.parametrize("threshold", [2, 3, 4, 5])
def test_gaussians_have_the_tails_of_a_normal_distribution(draws, threshold):
    probability = norm.sf(threshold)
    for side in (draws > threshold, draws < -threshold):
        expected = draws.size * probability
        assert_within(side.sum(), expected, math.sqrt(expected * (1 - probability)))


@pytest.mark.parametrize("power", [1, 2])
def test_gaussians_are_uncorrelated_across_draws_steps_and_paths(draws, power):
    values = draws if power == 1 else (draws**2 - 1) / math.sqrt(2)  # squares show dependence too
    steps, _, paths = values.shape
    correlations = [(values[:, 0] * values[:, 1]).mean()]
    for lag in (1, 2, 3, 10, 64):
        correlations += [
            (values[lag:, a] * values[:-lag, b]).mean() for a in (0, 1) for b in (0, 1)
        ]
    assert_within(correlations, 0, 1.01 / math.sqrt(steps * paths))
    for draw in (0, 1):
        between_paths = values[:, draw].T @ values[:, draw] / steps
        between_paths = between_paths[np.triu_indices(paths, 1)]
        # 8128 pairs: the threshold of the largest is that of one pair at 6 standard errors.
        assert np.abs(between_paths).max() < 6 / math.sqrt(steps)
        assert_within(between_paths.mean(), 0, 1 / math.sqrt(steps * len(between_paths)))


def test_noise_differs_between_seeds_and_between_paths():
    streams = [gaussians(seed, path, 4) for seed in (0, 1, 2**64 - 1) for path in (0, 32, 2**40)]
    assert len(np.unique(np.concatenate(streams, axis=2), axis=2).T) == len(streams) * LANES


def test_noise_of_a_path_does_not_depend_on_its_lane():
    assert_array_equal(gaussians(3, 5, 20)[:, :, 0], gaussians(3, 0, 20)[:, :, 5])


@njit
def each(function, x):
    y = np.empty_like(x)
    for i in range(x.size):
        y[i] = function(x[i])
    return y


@njit
def sine_of(x):
    return noise.sine(x)


def test_polynomials_agree_with_numpy():
    u = np.concatenate([np.geomspace(2.0**-32, 1, 20_001), 1 - np.arange(1, 99) * 2.0**-24])
    u = u.astype(np.float32)
    assert_allclose(each(noise.log_unit, u), np.log(u.astype(float)), rtol=3e-7, atol=0)
    assert each(noise.log_unit, np.ones(1, np.float32))[0] == 0

    angle = np.linspace(-np.pi / 2, np.pi / 2, 20_001).astype(np.float32)
    exact = angle.astype(float)
    assert_allclose(each(noise.sin_quarter, angle), np.sin(exact), rtol=0, atol=1e-7)
    assert_allclose(each(noise.cos_quarter, angle), np.cos(exact), rtol=0, atol=1.5e-7)


def test_sine_agrees_with_numpy_over_many_turns():
    x = np.linspace(-40, 40, 100_003)
    assert_allclose(each(sine_of, x), np.sin(x), rtol=0, atol=2e-11)
    narrow = x.astype(np.float32)
    assert_allclose(each(sine_of, narrow), np.sin(narrow.astype(float)), rtol=0, atol=1.5e-6)
    assert np.isnan(each(sine_of, np.array([np.inf, np.nan]))).all()


# --- the kernel -----------------------------------------------------------------------------------


def simulation(estimator, parameters=PARAMETERS, options=None, **arguments):
    """The `Simulation` that `monte_carlo` would carry out."""
    given = {"protocol": "paper", "runs": 64, "duration": 2e-5, "step": 1e-8} | arguments
    given = {"seed": 0, "precision": "mixed"} | given
    return run._plan(homodyne_loop(parameters, estimator, **(options or {})), **given)[0]


def plain_euler(parameters, estimator, draws, step, options):
    """The loop as its equations are written, one NumPy statement each: the squared errors."""
    p, steps = parameters, len(draws)
    delay = round(estimator.plant.delay / step)
    smoothed_oscillator = options.get("oscillator") == "smoothed"
    copies = estimator.C_c.shape[0] == 2 and options.get("copy", True)
    difference = 0.0 if options.get("nonlinearity") == "literal" else 1.0
    strength = math.sqrt(options.get("shot_noise", 1.0))

    def f(e):
        return np.sin(e) - p.beta * e

    phase = np.zeros(draws.shape[2])
    x = np.zeros((estimator.A_c.shape[0], draws.shape[2]))
    phases = []
    for step_index in range(steps + 1):
        phases.append(phase)
        w, w_smoothed = estimator.C_c[0] @ x, estimator.C_a[0] @ x
        u = w_smoothed if smoothed_oscillator else w
        if step_index == steps:
            break
        dW, dV = draws[step_index].astype(float) * math.sqrt(step)
        reference = difference * u
        photocurrent = 2 * p.alpha * np.sin(phase - reference) * step + strength * dW
        dy = (photocurrent + 2 * p.alpha * p.beta * reference * step) / (2 * p.alpha * p.beta)
        dx = estimator.A_c @ x * step + np.outer(estimator.B_c[:, 0], dy)
        if copies:
            nu = estimator.C_c[1] @ x - 2 * p.alpha * p.gamma * reference
            mu = 2 * p.alpha * f(nu / (2 * p.alpha * p.gamma))
            dx += np.outer(estimator.B_c[:, 1], mu) * step
        phase = phase - p.lam * phase * step + math.sqrt(p.kappa) * dV
        x = x + dx
    return np.array(
        [
            (phases[-1] - w) ** 2,
            (phases[-1 - delay] - w_smoothed) ** 2,
            np.abs(phases[-1] - u) > np.pi,
        ]
    )


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"oscillator": "smoothed"},
        {"copy": False},
        {"nonlinearity": "literal"},
        {"nonlinearity": "literal", "copy": False},
        {"shot_noise": 30.0},
        {"oscillator": "smoothed", "shot_noise": 5.0},
    ],
    ids=str,
)
def test_kernel_agrees_with_a_plain_euler_loop_on_the_same_noise(options):
    estimator = printed_smoother()
    given = simulation(estimator, options=options, seed=11)
    expected = plain_euler(PARAMETERS, estimator, gaussians(11, LANES, 2000), 1e-8, options)
    assert_allclose(given.simulate(1, 1)[0], expected, rtol=1e-7, atol=1e-9)


def test_kernel_agrees_with_a_plain_euler_loop_that_loses_lock():
    parameters = types.SimpleNamespace(**{**vars(PARAMETERS), "kappa": 2e6, "beta": 0.8})
    estimator = printed_smoother()
    given = simulation(estimator, parameters, seed=1)
    expected = plain_euler(parameters, estimator, gaussians(1, 0, 2000), 1e-8, {})
    assert 3 < expected[SLIPPED].sum() < LANES - 3
    assert_allclose(given.simulate(0, 1)[0], expected, rtol=1e-6, atol=1e-8)


def test_kernel_agrees_with_a_plain_euler_loop_for_one_state_without_a_copy():
    given = simulation(kalman_filter(), seed=5)
    expected = plain_euler(PARAMETERS, kalman_filter(), gaussians(5, 0, 2000), 1e-8, {})
    assert_allclose(given.simulate(0, 1)[0], expected, rtol=1e-7, atol=1e-9)


def test_time_average_is_the_mean_over_samples_at_the_end_of_shorter_runs():
    estimator = printed_smoother()
    average = simulation(estimator, protocol="ergodic", duration=1e-5)
    schedule = Schedule(start=200, stride=31, lag=10, samples=4)
    average = types.SimpleNamespace(**vars(average))
    average.schedule = schedule
    ends = [
        simulation(estimator, duration=(200 + (10 + sample) * 31) * 1e-8).simulate(0, 1)
        for sample in range(4)
    ]
    result = run.Simulation.simulate(average, 0, 1)
    assert_allclose(result[0, [FILTERED, SMOOTHED]], np.mean(ends, axis=0)[0, :2], rtol=1e-12)


@pytest.mark.parametrize("precision", ["mixed", "single"])
def test_a_path_depends_on_seed_and_index_alone(precision):
    few = simulation(printed_smoother(), precision=precision)
    many = simulation(printed_smoother(), precision=precision, runs=1000)
    assert many.blocks == 32 and many.paths(31) == 1000 - 31 * LANES
    whole = many.simulate(0, many.blocks)
    assert_array_equal(few.simulate(0, 2), whole[:2])
    parts = [many.simulate(0, 5), many.simulate(5, 1), many.simulate(6, 26)]
    assert_array_equal(np.concatenate(parts), whole)
    other = simulation(printed_smoother(), precision=precision, seed=1).simulate(0, 2)
    assert not np.isin(other[:, :2], whole[:, :2]).any()


def same_numbers(result):
    numbers = result.to_dict()
    del numbers["wall_time"]
    return json.dumps(numbers, sort_keys=True)


def test_result_is_the_same_to_the_bit_for_any_threads_and_batches(monkeypatch):
    arguments = {"runs": 333, "duration": 2e-5, "seed": 4}
    expected = same_numbers(monte_carlo(PARAMETERS, printed_smoother(), **arguments))
    for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
        result = monte_carlo(PARAMETERS, printed_smoother(), threads=threads, **arguments)
        assert same_numbers(result) == expected
    monkeypatch.setattr(run, "STEPS_PER_CALL", 1)
    result = monte_carlo(PARAMETERS, printed_smoother(), threads=1, **arguments)
    assert same_numbers(result) == expected


def test_result_is_the_same_to_the_bit_with_more_threads_than_cores():
    script = (
        "from robsmooth.montecarlo import monte_carlo\n"
        "from test_montecarlo import PARAMETERS, printed_smoother, same_numbers\n"
        "r = monte_carlo(PARAMETERS, printed_smoother(), runs=333, duration=2e-5, threads=7)\n"
        "print(same_numbers(r))"
    )
    environment = dict(os.environ, NUMBA_NUM_THREADS="7", PYTHONPATH=str(Path(__file__).parent))
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    here = monte_carlo(PARAMETERS, printed_smoother(), runs=333, duration=2e-5)
    assert done.stdout.strip() == same_numbers(here)


def test_threads_are_set_back_after_an_interruption(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    before = numba.get_num_threads()
    monkeypatch.setattr(run.Simulation, "simulate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        monte_carlo(PARAMETERS, printed_smoother(), threads=1)
    assert numba.get_num_threads() == before


def test_compiled_code_is_kept_for_the_sources_that_it_was_made_from(monkeypatch):
    simulation(printed_smoother()).simulate(0, 1)
    cache = kernels.simulate_blocks._cache._cache_file
    assert cache._load_index()
    monkeypatch.setattr(cache, "_source_stamp", "of noise.py as it was yesterday")
    assert not cache._load_index()


# --- the numbers ----------------------------------------------------------------------------------


def linear_loop(parameters, estimator, shot_noise):
    """Drift and noise covariance rate of (phi, x_hat) for sin e = e, without a copy."""
    n = estimator.A_c.shape[0]
    b = estimator.B_c[:, :1]
    A = np.zeros((1 + n, 1 + n))
    A[0, 0] = -parameters.lam
    A[1:, :1] = b
    A[1:, 1:] = estimator.A_c
    Q = np.zeros_like(A)
    Q[0, 0] = parameters.kappa
    Q[1:, 1:] = b @ b.T * shot_noise / (2 * parameters.alpha * parameters.beta) ** 2
    return A, Q


def linear_mean_squares(P, to_delayed, estimator):
    """The filtered and the smoothed one from the stationary covariance of (phi, x_hat)."""
    filtered = np.concatenate([[1.0], -estimator.C_c[0]])
    smoothed = np.concatenate([[0.0], -estimator.C_a[0]])
    lagged = P[0, 0] + 2 * smoothed @ to_delayed @ P[:, 0] + smoothed @ P @ smoothed
    return filtered @ P @ filtered, lagged


@pytest.mark.parametrize(
    ("estimator", "step"),
    [(kalman_filter(), 5e-8), (kalman_filter(delay=1e-6), 1e-7), (printed_smoother(), 3.1e-8)],
    ids=["filter", "filter with a lag", "printed smoother"],
)
@pytest.mark.parametrize("protocol", ["paper", "ergodic"])
def test_linear_loop_has_the_variances_of_the_lyapunov_equation(estimator, step, protocol):
    parameters = quiet(PARAMETERS)
    estimator = changed(estimator, B_c=estimator.B_c[:, :1], C_c=estimator.C_c[:1])
    A, Q = linear_loop(parameters, estimator, QUIET)
    transition = np.eye(len(A)) + A * step
    P = solve_discrete_lyapunov(transition, Q * step)
    to_delayed = np.linalg.matrix_power(transition, round(estimator.plant.delay / step))
    expected = linear_mean_squares(P, to_delayed, estimator)

    numbers = {"runs": 20_000, "duration": 3e-4} if protocol == "paper" else {"runs": 2000}
    result = monte_carlo(
        parameters, estimator, protocol, step=step, seed=2, shot_noise=QUIET, **numbers
    )
    assert result.slips == 0
    for error, value in zip((result.filtered, result.smoothed), expected, strict=True):
        assert error.standard_error < 0.012 * value
        assert_within(error.mean_square, value, error.standard_error)


def test_euler_bias_is_of_first_order_in_the_step():
    parameters, estimator = quiet(PARAMETERS), kalman_filter()
    A, Q = linear_loop(parameters, estimator, QUIET)
    exact, _ = linear_mean_squares(solve_continuous_lyapunov(A, -Q), np.eye(2), estimator)
    rate = -estimator.A_c[0, 0]
    steps = np.array([0.2, 0.1, 0.05]) / rate
    results = [
        monte_carlo(parameters, estimator, step=step, runs=8000, seed=3, shot_noise=QUIET)
        for step in steps
    ]
    bias = np.array([result.filtered.mean_square for result in results]) / exact - 1
    assert all(result.filtered.standard_error < 0.002 * exact for result in results)
    order = np.polyfit(np.log(steps), np.log(bias), 1)[0]
    assert order == pytest.approx(1, abs=0.15)
    # Of a scalar linear equation with this rate: 1 / (1 - rate step / 2) - 1.
    assert_allclose(bias, rate * steps / 2, rtol=0.2)


def test_single_and_mixed_precision_agree():
    arguments = {"runs": 640, "duration": 2e-4, "step": 1e-8}
    mixed, single = (
        monte_carlo(PARAMETERS, printed_smoother(), precision=precision, **arguments)
        for precision in ("mixed", "single")
    )
    assert mixed.filtered != single.filtered
    for name in ("filtered", "smoothed"):
        assert getattr(single, name).mean_square == pytest.approx(
            getattr(mixed, name).mean_square, rel=2e-5
        )


def test_both_protocols_agree():
    arguments = {"step": 3.1e-8, "seed": 6}
    ends = monte_carlo(PARAMETERS, printed_smoother(), "paper", runs=10_000, **arguments)
    averages = monte_carlo(PARAMETERS, printed_smoother(), **arguments)
    for name in ("filtered", "smoothed"):
        a, b = getattr(ends, name), getattr(averages, name)
        assert_within(a.mean_square, b.mean_square, math.hypot(a.standard_error, b.standard_error))


def test_lost_lock_is_counted():
    assert monte_carlo(PARAMETERS, kalman_filter(), runs=100).slips == 0
    noisy = types.SimpleNamespace(**{**vars(PARAMETERS), "kappa": 4e6})
    result = monte_carlo(noisy, kalman_filter(), runs=100)
    assert 0 < result.slips <= 100
    assert f"{result.slips} of 100 paths lost lock" in repr(result)


def test_literal_nonlinearity_loses_lock():
    arguments = {"runs": 500, "duration": 2e-4, "step": 3.1e-8}
    literal = monte_carlo(
        PARAMETERS, printed_smoother(), "paper", nonlinearity="literal", **arguments
    )
    assert literal.slips > 100
    assert literal.filtered.mean_square > 1


def test_warm_up_ends_when_the_variances_are_stationary():
    loop = homodyne_loop(quiet(PARAMETERS), printed_smoother(), shot_noise=QUIET)
    A, Q = loop.linearised_drift(), loop.noise_covariance()
    P = solve_continuous_lyapunov(A, -Q)
    to_delayed = expm(A * loop.delay)
    row = np.concatenate([[1.0], -loop.filtered])

    def filtered_variance(time):
        decay = expm(A * time)
        return row @ (P - decay @ P @ decay.T) @ row

    warm_up, stationary = warm_up_time(loop), row @ P @ row
    assert 1 - filtered_variance(warm_up) / stationary < 1e-3
    assert 1 - filtered_variance(warm_up / 8) / stationary > 1e-3
    # The lagged error forgets no later: its start is a delay further back, and warm_up has both.
    assert warm_up > loop.delay and np.isfinite(to_delayed).all()


def test_standard_error_is_that_of_the_sample():
    values = np.random.default_rng(0).normal(3, 1, 1000) ** 2
    moments = Moments()
    for part in np.split(values, [32, 64, 65, 700]):
        moments.add(part)
    given = moments.mean_square()
    assert given.mean_square == pytest.approx(values.mean(), rel=1e-14)
    assert given.standard_error == pytest.approx(values.std(ddof=1) / math.sqrt(1000), rel=1e-13)


@pytest.mark.parametrize("delay", [0, 1, 31, 310])
def test_samples_are_spread_over_the_duration(delay):
    schedule = time_average(warm_up=400, steps=1000, delay=delay, longest_stride=40)
    assert schedule.stride <= 40 and schedule.lag * schedule.stride == delay
    first = schedule.start + schedule.lag * schedule.stride
    assert first == 400
    assert 1000 - schedule.stride <= schedule.steps - first <= 1000


def test_published_protocol_is_the_default_of_paper():
    given = simulation(printed_smoother(), runs=None, duration=None, step=None)
    assert given.runs == 50_000
    assert given.schedule.steps == 100_000


def test_default_step_divides_the_delay():
    for delay in (3.1e-6, 1e-6 / 3, 7.77e-6):
        for protocol in ("paper", "ergodic"):
            estimator = printed_smoother(delay)
            result = monte_carlo(PARAMETERS, estimator, protocol, runs=1, duration=2e-5)
            assert delay / result.step == pytest.approx(round(delay / result.step), abs=1e-6)
            assert result.step <= 1e-8 * (1 + 1e-9)


def test_result_does_not_depend_on_the_unit_of_time():
    parameters, estimator = PARAMETERS, printed_smoother()
    arguments = {"runs": 64, "duration": 5e-5}
    seconds = monte_carlo(parameters, estimator, **arguments)
    unit = 2.0**-20
    parameters = types.SimpleNamespace(
        lam=parameters.lam * unit,
        kappa=parameters.kappa * unit,
        alpha=parameters.alpha * math.sqrt(unit),
        beta=1.0,
        gamma=0.4,
    )
    root = math.sqrt(unit)
    estimator = changed(
        estimator,
        A_c=estimator.A_c * unit,
        B_c=estimator.B_c * [unit, root],
        C_c=estimator.C_c * [[1], [root]],
        plant=types.SimpleNamespace(delay=3.1e-6 / unit),
    )
    other = monte_carlo(parameters, estimator, runs=64, duration=5e-5 / unit)
    assert other.smoothed.mean_square == pytest.approx(seconds.smoothed.mean_square, rel=1e-9)


# --- what a user sees -----------------------------------------------------------------------------


def test_result_has_a_json_form():
    result = monte_carlo(PARAMETERS, kalman_filter(), runs=1, duration=1e-5)
    assert math.isnan(result.smoothed.standard_error)
    text = json.dumps(result.to_dict(), allow_nan=False)
    assert json.loads(text)["filtered"] == {
        "mean_square": result.filtered.mean_square,
        "standard_error": None,
    }
    assert json.loads(text)["provenance"]["parameters"]["kappa"] == 4e4


def test_result_describes_itself():
    result = monte_carlo(PARAMETERS, kalman_filter(), runs=40, duration=1e-5, seed=9)
    assert isinstance(result.smoothed, MeanSquare)
    assert result.smoothed == result.filtered  # no lag
    assert result.path_steps == 40 * round((result.warm_up + result.duration) / result.step)
    for part in ("ergodic: 40 runs", "seed 9", "mixed", "no slips"):
        assert part in repr(result)


@pytest.mark.parametrize("name", ["client", "checkpoint"])
def test_what_this_release_lacks_is_refused(name):
    assert monte_carlo(PARAMETERS, kalman_filter(), runs=32, duration=1e-5, **{name: None})
    with pytest.raises(NotImplementedError, match=rf"^{name} must be None"):
        monte_carlo(PARAMETERS, kalman_filter(), **{name: "somewhere"})


def test_progress_bar_changes_nothing(capsys):
    arguments = {"runs": 100, "duration": 1e-5}
    silent = monte_carlo(PARAMETERS, kalman_filter(), **arguments)
    assert capsys.readouterr().err == ""
    shown = monte_carlo(PARAMETERS, kalman_filter(), progress=True, **arguments)
    assert "100/100" in capsys.readouterr().err
    assert same_numbers(shown) == same_numbers(silent)


def test_filtered_row_is_used_where_there_is_one():
    estimator = changed(printed_smoother(), C_f=np.array([[1.0, 0.0, 0.0]]))
    assert_array_equal(homodyne_loop(PARAMETERS, estimator).oscillator, [1, 0, 0])


def test_overflow_names_the_first_path():
    with pytest.raises(RuntimeError, match=r"path 0 overflowed: the step, 1e-05 s, is too long"):
        monte_carlo(PARAMETERS, printed_smoother(0.0), "paper", runs=64, step=1e-5, duration=1e-2)
    values = np.ones((3, LANES))
    values[1, 7] = np.nan
    with pytest.raises(RuntimeError, match="path 103 "):
        run._check_finite(values, 3, homodyne_loop(PARAMETERS, kalman_filter()), 1e-8)


def test_unstable_estimator_is_refused_or_overflows():
    unstable = changed(kalman_filter(), A_c=np.array([[1e6]]))
    with pytest.raises(UnstableLoopError, match="decay rate -1e\\+06 1/s"):
        monte_carlo(PARAMETERS, unstable)
    with pytest.raises(RuntimeError, match="the estimator is unstable"):
        monte_carlo(PARAMETERS, unstable, "paper", runs=1)


def test_step_that_does_not_divide_the_delay_is_told_what_would():
    with pytest.raises(ValueError) as caught:
        monte_carlo(PARAMETERS, printed_smoother(), step=7e-9)
    assert "442.857 steps" in str(caught.value)
    for steps in (442, 443):
        step = 3.1e-6 / steps
        assert f"{step:.12g} ({steps} steps)" in str(caught.value)
        monte_carlo(PARAMETERS, printed_smoother(), step=float(f"{step:.12g}"), runs=1)
    with pytest.raises(ValueError, match=r"3\.1e-06 \(1 steps\)"):
        monte_carlo(PARAMETERS, printed_smoother(), step=1e-5)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"protocol": "Paper"}, ValueError, "protocol must be one of 'ergodic', 'paper'"),
        ({"precision": "double"}, ValueError, "precision must be one of 'mixed', 'single'"),
        ({"oscillator": "w"}, ValueError, "oscillator must be one of"),
        ({"nonlinearity": "sin"}, ValueError, "nonlinearity must be one of"),
        ({"copy": 1}, TypeError, "copy must be True or False, got 1"),
        ({"progress": "yes"}, TypeError, "progress must be True or False"),
        ({"runs": 0}, ValueError, "runs must be an integer of at least 1, got 0"),
        ({"runs": 10.0}, TypeError, "runs must be an integer, got 10.0"),
        ({"runs": True}, TypeError, "runs must be an integer"),
        ({"duration": -1e-3}, ValueError, "duration must be"),
        ({"duration": math.inf}, ValueError, "duration must be finite"),
        ({"duration": "1ms"}, TypeError, "duration must be a real number"),
        ({"duration": 1e-6}, ValueError, r"at least the smoother's delay, 3.1e-06 s, got 1e-06"),
        ({"step": 0.0}, ValueError, "step must be"),
        ({"step": math.nan}, ValueError, "step must be finite"),
        ({"step": 1 + 0j}, TypeError, "step must be a real number"),
        ({"seed": -1}, ValueError, "seed must be an integer of at least 0, got -1"),
        ({"seed": 1.5}, TypeError, "seed must be an integer"),
        ({"seed": 2**64}, ValueError, r"seed must be below 2\*\*64"),
        ({"shot_noise": -1.0}, ValueError, "shot_noise must be"),
        ({"shot_noise": math.nan}, ValueError, "shot_noise must be finite"),
        ({"threads": 0}, ValueError, "threads must be an integer of at least 1"),
        ({"threads": 10_000}, ValueError, "threads must be at most"),
        ({"threads": 1.0}, TypeError, "threads must be an integer"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        monte_carlo(PARAMETERS, printed_smoother(), **arguments)


@pytest.mark.parametrize(
    ("matrices", "error", "message"),
    [
        ({"A_c": np.full((3, 3), np.nan)}, ValueError, "smoother.A_c must be finite"),
        ({"A_c": np.eye(3) * 1j}, ValueError, "smoother.A_c must be real"),
        ({"A_c": np.zeros((3, 2))}, ValueError, "smoother.A_c must be square"),
        ({"B_c": np.zeros((2, 2))}, ValueError, "smoother.B_c must have shape"),
        ({"B_c": np.zeros((3, 1))}, ValueError, "one measurement"),
        ({"B_c": np.zeros((3, 3)), "C_c": np.zeros((3, 3))}, ValueError, "one measurement"),
        ({"C_c": np.zeros(3)}, ValueError, "smoother.C_c must have 2 dimension"),
        ({"C_a": np.zeros((2, 3))}, ValueError, "one output"),
        ({"C_f": np.zeros((2, 3))}, ValueError, "one output"),
        ({"plant": types.SimpleNamespace(delay=-1.0)}, ValueError, "plant.delay must be"),
        ({"plant": None}, TypeError, "smoother must be an estimator"),
    ],
    ids=str,
)
def test_bad_estimators_are_refused(matrices, error, message):
    with pytest.raises(error, match=message):
        monte_carlo(PARAMETERS, changed(printed_smoother(), **matrices))


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("lam", -1.0, ValueError),
        ("kappa", math.inf, ValueError),
        ("alpha", 0.0, ValueError),
        ("beta", "1", TypeError),
        ("gamma", 0.0, ValueError),
    ],
)
def test_bad_parameters_are_refused(name, value, error):
    parameters = types.SimpleNamespace(**{**vars(PARAMETERS), name: value})
    with pytest.raises(error, match=rf"parameters\.{name} must be"):
        monte_carlo(parameters, printed_smoother())
    with pytest.raises(TypeError, match="parameters must be HomodyneParameters"):
        monte_carlo({"lam": 1}, printed_smoother())
