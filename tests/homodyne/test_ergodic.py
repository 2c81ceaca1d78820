"""The ergodic protocol: its scheme, its control variate, its intervals, and loss of lock.

The kernel is compared with the scheme as the equations have it, on the same noise; what it computes
with routes of their own: the stationary moments without sampling, quadrature, statistical
linearisation, and the published protocol.
"""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import cumulative_simpson, quad_vec, simpson
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.stats import binom, norm

from robsmooth import homodyne, statistical_linearisation
from robsmooth._support.errors import LongStepWarning
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.moments import stationary_errors
from robsmooth.homodyne.montecarlo import LossOfLockWarning, monte_carlo, run
from robsmooth.homodyne.montecarlo.euler import CHUNK
from robsmooth.homodyne.montecarlo.protocols import PILOT_BLOCK
from robsmooth.homodyne.montecarlo.splitting import coefficients_of, control_slopes
from robsmooth.paper import published
from robsmooth.simulation.noise import BLOCK, SLIP, TURN
from tests.helpers.loops import (
    PARAMETERS,
    SIGMAS,
    assert_within,
    blocks_of,
    gaussians,
    kalman_filter,
    printed_smoother,
    with_parameters,
)

DELAY = 3.1e-6


def simulation(estimator, parameters=PARAMETERS, options=None, **arguments):
    """The simulation that `monte_carlo` would carry out."""
    return run.plan(homodyne_loop(parameters, estimator, **(options or {})), "ergodic", **arguments)


# --- the scheme -----------------------------------------------------------------------------------


def control_of(coefficients):
    """The transition of a step, the root of its noise, and that of the stationary covariance."""
    rows = len(coefficients.control)
    return *np.split(coefficients.control, [rows], axis=1), coefficients.start


def integrated_noise(drift, Q, step):
    return quad_vec(lambda s: expm(drift * s) @ Q @ expm(drift * s).T, 0, step, epsrel=1e-10)[0]


@pytest.mark.parametrize("estimator", [kalman_filter(), printed_smoother()], ids=["1", "3"])
@pytest.mark.parametrize("step", [1e-8, 3.875e-7, 3.1e-6])
def test_linear_part_of_a_step_is_exact(estimator, step):
    loop = homodyne_loop(PARAMETERS, estimator)
    slopes = control_slopes(loop)
    drift, B = loop.linearised_drift(*slopes), loop.noise
    transition, root, start = control_of(coefficients_of(loop, step, slopes))
    assert_allclose(transition, expm(drift * step), rtol=1e-10, atol=1e-12)
    expected = integrated_noise(drift, B @ B.T, step)
    size = np.sqrt(np.diag(expected))
    assert_allclose(
        root @ root.T / np.outer(size, size), expected / np.outer(size, size), atol=1e-8
    )
    P = start @ start.T  # stationary: a step does not change it
    assert_allclose(transition @ P @ transition.T + root @ root.T, P, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("estimator", [kalman_filter(), printed_smoother()], ids=["1", "3"])
@pytest.mark.parametrize("step", [1e-5, 5e-4, 1e-3, 1.0])
def test_noise_of_a_long_step_leaves_the_stationary_covariance(estimator, step):
    loop = homodyne_loop(PARAMETERS, estimator)
    drift, B = loop.linearised_drift(), loop.noise
    transition, root, _ = control_of(coefficients_of(loop, step, (1.0, 1.0)))
    P = solve_continuous_lyapunov(drift, -B @ B.T)
    size = np.sqrt(np.diag(P))
    expected = P - expm(drift * step) @ P @ expm(drift * step).T
    assert_allclose(
        root @ root.T / np.outer(size, size), expected / np.outer(size, size), atol=1e-9
    )
    assert_allclose(transition, expm(drift * step), rtol=1e-9, atol=1e-12)


def plain_splitting(loop, given, draws):
    """The scheme as its equations are written: the outputs of BLOCK paths."""
    h, (warm_up, delay, _) = given.step, given.schedule
    slopes = np.array(control_slopes(loop))
    transition, root, start = control_of(given.coefficients)
    m = root.shape[1]
    draws = draws.reshape(-1, m, BLOCK).astype(float)
    gains, rows = loop.gains[1:], loop.arguments
    jacobian_rows = rows[:, 1:]  # of the arguments by x-hat

    drift = loop.linearised_drift(*slopes)
    push = (
        -slopes[0] * np.linalg.solve(drift, (transition - np.eye(len(drift)))[:, 1:]) @ gains[:, 0]
    )

    def kick(phase, x, part, turns):
        v = rows @ np.vstack([phase, x])
        F = gains @ (np.sin(v) - slopes[:, None] * (v - np.vstack([turns, 0 * turns])))
        DF_F = gains @ ((np.cos(v) - slopes[:, None]) * (jacobian_rows @ F))
        return x + part * h * F + 0.5 * (part * h) ** 2 * DF_F

    y = start @ draws[0][: len(loop.drift)]
    x = y[1:].copy()
    outputs = np.zeros((6, BLOCK))
    turns, nearest = np.zeros((2, BLOCK))
    phases = []
    for step in range(given.steps + 1):
        phase = y[0]
        before, nearest = nearest, TURN * np.rint(rows[0] @ np.vstack([phase, x]) / TURN)
        between = (before + nearest) / 2
        phases.append(phase)
        if step >= warm_up:
            delayed, now = phases[step - delay], kick(phase, x, 0.5, between)
            control = phase - loop.readout[0] @ y[1:]
            outputs[0] += (phase - loop.readout[0] @ now) ** 2
            outputs[1] += (delayed - loop.readout[1] @ now) ** 2
            outputs[2] += control**2
            outputs[3] += (delayed - loop.readout[1] @ y[1:]) ** 2
            outputs[4] += control**4
            away = phase - loop.readout[2] @ now - turns
            slipped = np.sign(away) * (np.abs(away) > SLIP)
            turns += TURN * slipped
            outputs[5] += np.abs(slipped)
        kicked = kick(phase, x, 1.0, between)
        noise = root @ draws[1 + step]
        x = transition[1:, :1] * phase + transition[1:, 1:] @ kicked + noise[1:]
        x = x + np.outer(push[1:], nearest)
        y = transition @ y + noise
    outputs[:5] /= given.steps - warm_up + 1
    return outputs


@pytest.mark.parametrize(
    ("estimator", "options"),
    [
        (kalman_filter(), {}),
        (printed_smoother(), {}),
        (printed_smoother(), {"oscillator": "smoothed"}),
        (printed_smoother(), {"copy": False}),
        (printed_smoother(), {"oscillator": "none", "shot_noise": 20.0}),
    ],
    ids=["one state", "as it is", "smoothed oscillator", "no copy", "literal"],
)
def test_kernel_agrees_with_the_scheme_as_it_is_written(estimator, options):
    given = simulation(estimator, options=options, duration=6e-6, step=1.55e-7, seed=3)
    loop = homodyne_loop(PARAMETERS, estimator, **options)
    (m,) = given.compiled_for
    draws = gaussians(3, BLOCK, (2 + given.steps) * m // 2)
    expected = plain_splitting(loop, given, draws)
    assert_allclose(given.simulate(1, 1)[0], expected, rtol=1e-7, atol=1e-12)
    if options.get("oscillator") == "none":
        assert expected[5].sum() > 3


@pytest.mark.parametrize("estimator", [kalman_filter(), printed_smoother()], ids=["1", "3"])
def test_control_has_the_moments_that_it_is_said_to_have(estimator):
    given = simulation(estimator, runs=20_000, duration=1e-5, seed=1)
    values = given.simulate(0, blocks_of(given)).transpose(1, 0, 2).reshape(6, -1)
    for row, mean in zip(values[2:5], given.control, strict=True):
        assert_within(row.mean(), mean, row.std() / math.sqrt(row.size))


def test_scheme_is_of_second_order_in_the_step():
    exact = stationary_errors(PARAMETERS, printed_smoother())
    steps = DELAY / np.array([1, 2, 3])
    with pytest.warns(LongStepWarning) as warned:
        results = [
            monte_carlo(PARAMETERS, printed_smoother(), step=step, runs=20_000, seed=1)
            for step in steps
        ]
    assert len(warned) == len(steps)
    for name in ("filtered", "smoothed"):
        errors = [getattr(result, name) for result in results]
        bias = np.array([e.mean_square for e in errors]) - getattr(exact, name)
        constant = np.median(bias / steps**2)
        assert constant > 0
        slack = [SIGMAS * e.standard_error for e in errors] + 0.1 * constant * steps**2
        assert np.all(np.abs(bias - constant * steps**2) < slack)


@pytest.mark.parametrize("name", ["smoother, as printed", "NGCF"])
def test_bias_at_the_default_step_is_below_a_ten_thousandth(name):
    design = published.designs()[name]
    result = monte_carlo(PARAMETERS, design, runs=40_000, seed=5)
    exact = stationary_errors(PARAMETERS, design)
    for output in ("filtered", "smoothed"):
        error, value = getattr(result, output), getattr(exact, output)
        assert error.standard_error < 2e-5 * value
        assert abs(error.mean_square - value) < 1e-4 * value - 2 * error.standard_error


# --- the estimate ---------------------------------------------------------------------------------


def test_default_run_is_good_to_a_ten_thousandth_or_two():
    result = monte_carlo(PARAMETERS, printed_smoother())
    for error in (result.filtered, result.smoothed):
        assert error.standard_error < 2e-4 * error.mean_square
        assert error.variance_reduction > 300
    assert result.path_steps < 2e6


@pytest.mark.parametrize(
    "arguments", [{"runs": 1024, "duration": 2e-5}, {"runs": 256, "duration": 2e-4}], ids=str
)
@pytest.mark.parametrize("estimator", [printed_smoother(), kalman_filter()], ids=["3", "1"])
def test_intervals_cover_the_truth_as_often_as_they_say(estimator, arguments):
    exact = stationary_errors(PARAMETERS, estimator)
    step = DELAY / 12  # so that the scheme's bias is well below the standard error
    seeds = 300
    inside = {"filtered": 0, "smoothed": 0}
    for seed in range(seeds):
        result = monte_carlo(PARAMETERS, estimator, step=step, seed=seed, **arguments)
        for name in inside:
            found = getattr(result, name)
            low, high = norm.interval(0.95, found.mean_square, found.standard_error)
            inside[name] += low <= getattr(exact, name) <= high
    # A false alarm in 1000 for each of the eight numbers.
    low, high = binom.interval(0.999, seeds, 0.95)
    assert all(low <= count <= high for count in inside.values()), inside


def test_pilot_shares_no_path_with_a_run_and_changes_no_mean():
    given = simulation(printed_smoother(), runs=2**40)
    assert blocks_of(given) < PILOT_BLOCK
    for weights in (np.zeros((2, 3)), np.eye(2, 3)):
        given = simulation(printed_smoother(), runs=20_000, duration=1e-5)
        other = replace(given, weights=weights)
        outputs = other.simulate(0, blocks_of(other)).transpose(1, 0, 2).reshape(6, -1)
        plain, controlled = other.reduce(outputs[:5]).reshape(2, 2, -1)
        difference = controlled - plain
        error = difference.std(axis=1) / math.sqrt(difference.shape[1])
        assert_within(difference.mean(axis=1), 0, error + 1e-12)


def test_pilot_that_slips_spoils_no_estimate():
    parameters = with_parameters(kappa=2.5e5)
    slipped = 0
    for seed in range(60):
        given = simulation(kalman_filter(), parameters, runs=BLOCK, seed=seed)
        slipped += given.simulate(PILOT_BLOCK, 1)[0, -1].any()
        assert np.all(np.abs(given.weights) < 2)
    assert slipped > 3
    hopeless = simulation(kalman_filter(), with_parameters(kappa=4e6), runs=BLOCK)
    assert not hopeless.weights.any()


def test_published_protocol_agrees():
    ends = monte_carlo(PARAMETERS, printed_smoother(), "paper", runs=20_000, duration=1e-4)
    averages = monte_carlo(PARAMETERS, printed_smoother())
    for name, euler_bias in (("filtered", 0.0023), ("smoothed", -0.0003)):
        a, b = getattr(ends, name), getattr(averages, name)
        assert_within(a.mean_square, (1 + euler_bias) * b.mean_square, a.standard_error)


@pytest.mark.parametrize("name", ["smoother, as printed", "smoother, corrected", "NGCF"])
def test_statistical_linearisation_agrees_to_half_a_percent(name):
    design = published.designs()[name]
    predicted = statistical_linearisation(homodyne.PAPER, design)
    simulated = monte_carlo(homodyne.PAPER, design)
    for output in ("filtered", "smoothed"):
        assert getattr(simulated, output).mean_square == pytest.approx(
            getattr(predicted, output), rel=5e-3
        )


def test_result_does_not_depend_on_the_length_of_the_warm_up_or_of_the_paths():
    short = monte_carlo(PARAMETERS, printed_smoother(), runs=20_000, duration=1e-5, seed=1)
    long = monte_carlo(PARAMETERS, printed_smoother(), runs=512, duration=4e-3, seed=2)
    for name in ("filtered", "smoothed"):
        a, b = getattr(short, name), getattr(long, name)
        assert_within(a.mean_square, b.mean_square, math.hypot(a.standard_error, b.standard_error))


# --- loss of lock ---------------------------------------------------------------------------------


def slip_rate(strength, diffusion, interval):
    """Cycle slips a second of de = -K sin(e) dt + sqrt(2 D) dW, as they are counted.

    A slip is counted when the error is `SLIP` away, and seen some way beyond, for it is looked at
    now and then (Broadie, Glasserman and Kou's shift of a barrier, 1997); then the error is a turn
    less from the new point of lock. The mean time from there until it is as far away again is that
    of a diffusion in the potential -K cos e.
    """
    barrier = SLIP + 0.5826 * math.sqrt(2 * diffusion * interval)
    x = np.linspace(0, barrier, 20_001)
    potential = -strength / diffusion * np.cos(x)
    below = cumulative_simpson(np.exp(-potential), x=x, initial=0)
    after = x >= TURN - barrier
    return diffusion / simpson((np.exp(potential) * below)[after], x=x[after])


@pytest.mark.parametrize("protocol", ["ergodic", "paper"])
@pytest.mark.parametrize("ratio", [0.6, 0.9])
def test_slips_come_at_the_rate_of_a_first_order_loop(protocol, ratio):
    K = 4e5
    estimator = replace(kalman_filter(), A_c=np.array([[-K]]), B_c=np.array([[K]]))
    noise = (K / (2 * PARAMETERS.alpha)) ** 2
    diffusion = ratio * K
    # Next to no mean reversion: the error is then a diffusion of its own.
    parameters = with_parameters(lam=1e-5 * K, kappa=2 * diffusion - noise)
    step, looks = {"ergodic": (0.05 / K, 1), "paper": (0.005 / K, CHUNK)}[protocol]
    with pytest.warns(LossOfLockWarning):
        result = monte_carlo(
            parameters, estimator, protocol, runs=512, duration=800 / K, step=step, seed=1
        )
    assert result.slips > 1000
    time = result.slips / result.slip_rate
    expected = slip_rate(K, diffusion, looks * step) * time
    assert abs(result.slips - expected) < SIGMAS * math.sqrt(expected) + 0.02 * expected


def test_slip_is_reported_and_kept_apart():
    quiet = monte_carlo(PARAMETERS, kalman_filter(), runs=256)
    assert (quiet.slips, quiet.slipped_paths, quiet.slip_rate) == (0, 0, 0.0)
    assert quiet.filtered_in_lock.mean_square == pytest.approx(quiet.filtered.mean_square, rel=0.05)
    with pytest.warns(LossOfLockWarning, match="lost lock: .* slips in .* of 512 paths"):
        noisy = monte_carlo(with_parameters(kappa=6e5), kalman_filter(), runs=512)
    assert 0 < noisy.slipped_paths < 512
    assert noisy.slips >= noisy.slipped_paths
    # An error of whole turns is in the mean over all paths, but not in that of those in lock.
    assert noisy.filtered.mean_square > 2 * noisy.filtered_in_lock.mean_square
    assert f"{noisy.slips} slips in {noisy.slipped_paths} of 512 paths" in repr(noisy)


def test_growing_noise_shows_as_slips_and_never_as_a_small_error():
    slips, all_paths, in_lock = [], [], []
    for kappa in (4e4, 4e5, 8e5, 1.6e6):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LossOfLockWarning)
            result = monte_carlo(with_parameters(kappa=kappa), kalman_filter(), runs=512)
        slips.append(result.slip_rate)
        all_paths.append(result.filtered.mean_square)
        in_lock.append(result.filtered_in_lock.mean_square)
    assert slips[0] == 0 and slips == sorted(slips) and slips[-1] > 1e3
    assert all_paths == sorted(all_paths)
    # A path that kept its lock is within three quarters of a turn of it, and so is its mean square.
    assert all(value < SLIP**2 for value in in_lock if not math.isnan(value))
