"""The Monte Carlo: the published protocol's kernel, its trust, and what a user sees.

The kernel is compared with the loop's equations as they are written, on the same noise.
"""

import hashlib
import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

from robsmooth._numerics import vectors
from robsmooth._support.errors import LongStepWarning, UnstableLoopError
from robsmooth.estimators.baselines import fixed_lag_smoother, kalman_bucy
from robsmooth.homodyne import PAPER
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.montecarlo import (
    LossOfLockWarning,
    MeanSquare,
    euler,
    monte_carlo,
    run,
    splitting,
)
from robsmooth.homodyne.montecarlo.euler import CHUNK, SLIPS
from robsmooth.homodyne.montecarlo.protocols import PaperSimulation
from robsmooth.simulation import groups, noise
from robsmooth.simulation.noise import BLOCK
from tests.helpers.loops import (
    PARAMETERS,
    QUIET,
    assert_within,
    blocks_of,
    for_the_loop,
    gaussians,
    kalman_filter,
    printed_smoother,
    quiet,
    same_numbers,
    threads_of_kernels,
    with_parameters,
)

# --- the kernel -----------------------------------------------------------------------------------


def simulation(estimator, parameters=PARAMETERS, options=None, **arguments):
    """The `Simulation` that `monte_carlo` would carry out."""
    given = {"protocol": "paper", "runs": 64, "duration": 2e-5, "step": 1e-8} | arguments
    return run.plan(homodyne_loop(parameters, estimator, **(options or {})), **given)


def plain_euler(parameters, estimator, draws, step, options):
    """The loop as its equations are written, one NumPy statement each: the squared errors."""
    p, steps = parameters, len(draws)
    delay = round(estimator.plant.delay / step)
    first = steps - delay
    looks = {*range(CHUNK, first, CHUNK), first, *range(first + CHUNK, steps, CHUNK), steps}
    oscillator, scale = options.get("oscillator", "filtered"), 2 * p.alpha * p.gamma
    copies = estimator.C_c.shape[0] == 2 and options.get("copy", True)
    difference = 0.0 if options.get("oscillator") == "none" else 1.0
    strength = math.sqrt(options.get("shot_noise", 1.0))

    def f(e):
        return np.sin(e) - p.beta * e

    phase = np.zeros(draws.shape[2])
    x = np.zeros((estimator.A_c.shape[0], draws.shape[2]))
    phases = []
    turns, slips = np.zeros_like(phase), np.zeros_like(phase)
    for step_index in range(steps + 1):
        phases.append(phase)
        w, w_smoothed = estimator.C_c[0] @ x, estimator.C_a[0] @ x
        copied = estimator.C_c[-1] @ x / scale
        u = {"filtered": w, "none": w, "smoothed": w_smoothed, "copy": copied}[oscillator]
        if step_index in looks:
            away = phase - u - 2 * np.pi * turns
            turns += np.sign(away) * (np.abs(away) > 1.5 * np.pi)
            slips += np.abs(away) > 1.5 * np.pi
        if step_index == steps:
            break
        dW, dV = draws[step_index].astype(float) * math.sqrt(step)
        reference = difference * u
        photocurrent = 2 * p.alpha * np.sin(phase - reference) * step + strength * dW
        dy = (photocurrent + 2 * p.alpha * p.beta * reference * step) / (2 * p.alpha * p.beta)
        dx = estimator.A_c @ x * step + np.outer(estimator.B_c[:, 0], dy)
        if copies:
            nu = estimator.C_c[1] @ x - scale * reference
            mu = 2 * p.alpha * f(nu / scale)
            dx += np.outer(estimator.B_c[:, 1], mu) * step
        phase = phase - p.lam * phase * step + math.sqrt(p.kappa) * dV
        x = x + dx
    return np.array([(phases[-1] - w) ** 2, (phases[-1 - delay] - w_smoothed) ** 2, slips])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"oscillator": "smoothed"},
        {"oscillator": "copy"},
        {"copy": False},
        {"oscillator": "none"},
        {"oscillator": "none", "copy": False},
        {"shot_noise": 30.0},
        {"oscillator": "smoothed", "shot_noise": 5.0},
    ],
    ids=str,
)
def test_kernel_agrees_with_a_plain_euler_loop_on_the_same_noise(options):
    estimator = printed_smoother()
    given = simulation(estimator, options=options, seed=11)
    expected = plain_euler(PARAMETERS, estimator, gaussians(11, BLOCK, 2000), 1e-8, options)
    assert_allclose(given.simulate(1, 1)[0], expected, rtol=1e-7, atol=1e-9)


def test_an_oscillator_at_the_copy_is_one_at_the_estimate_that_the_copy_is_of():
    design = fixed_lag_smoother(PAPER.uncertain_system(), 3.1e-6, order=2, copies=True)
    how = {"protocol": "paper", "runs": 64, "duration": 2e-5, "step": 1e-8, "seed": 3}
    names = ("filtered", "smoothed", "copy")
    by_name = {o: monte_carlo(PARAMETERS, design, oscillator=o, **how) for o in names}
    for output in ("filtered", "smoothed"):
        filtered, smoothed, copied = (getattr(by_name[o], output).mean_square for o in names)
        assert copied == pytest.approx(filtered, rel=1e-6)
        assert smoothed != pytest.approx(filtered, rel=1e-3)


@pytest.mark.parametrize("without", [{"copy": False}, {}], ids=["copy is off", "no copy"])
def test_an_oscillator_at_the_copy_needs_one(without):
    design = printed_smoother() if without else kalman_filter()
    with pytest.raises(ValueError, match=r"oscillator must be .* where no copy runs, got 'copy'"):
        monte_carlo(PARAMETERS, design, runs=1, oscillator="copy", **without)


def test_kernel_agrees_with_a_plain_euler_loop_that_loses_lock():
    parameters = with_parameters(kappa=2e6, beta=0.8)
    estimator = printed_smoother()
    given = simulation(estimator, parameters, seed=1)
    expected = plain_euler(parameters, estimator, gaussians(1, 0, 2000), 1e-8, {})
    assert expected[SLIPS].sum() > 10
    assert_allclose(given.simulate(0, 1)[0], expected, rtol=1e-6, atol=1e-8)


def test_kernel_agrees_with_a_plain_euler_loop_for_one_state_without_a_copy():
    given = simulation(kalman_filter(), seed=5)
    expected = plain_euler(PARAMETERS, kalman_filter(), gaussians(5, 0, 2000), 1e-8, {})
    assert_allclose(given.simulate(0, 1)[0], expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("protocol", ["paper", "ergodic"])
@pytest.mark.parametrize("precision", ["mixed", "single"])
def test_a_path_depends_on_seed_and_index_alone(protocol, precision):
    how = {"protocol": protocol, "precision": precision, "step": 3.1e-8}
    few = simulation(printed_smoother(), **how)
    many = simulation(printed_smoother(), **how, runs=1000)
    assert blocks_of(many) == 16  # of which the last is not whole
    whole = many.simulate(0, blocks_of(many))
    assert_array_equal(few.simulate(0, 2), whole[:2])
    parts = [many.simulate(0, 5), many.simulate(5, 1), many.simulate(6, 10)]
    assert_array_equal(np.concatenate(parts), whole)
    other = simulation(printed_smoother(), **how, seed=1).simulate(0, 2)
    assert not np.isin(other[:, :2], whole[:, :2]).any()


@pytest.mark.parametrize("protocol", ["paper", "ergodic"])
@pytest.mark.parametrize("group", [1, 2, 64])
def test_result_is_the_same_to_the_bit_for_any_threads(monkeypatch, protocol, group):
    monkeypatch.setattr(groups, "BLOCKS_OF_A_GROUP", group)
    arguments = {"protocol": protocol, "runs": 1333, "duration": 2e-5, "seed": 4}
    expected = same_numbers(monte_carlo(PARAMETERS, printed_smoother(), **arguments))
    for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
        with threads_of_kernels(threads):
            result = monte_carlo(PARAMETERS, printed_smoother(), **arguments)
        assert same_numbers(result) == expected


def test_result_is_the_same_to_the_bit_with_more_threads_than_cores():
    script = (
        "from robsmooth.homodyne.montecarlo import monte_carlo\n"
        "from tests.homodyne.test_montecarlo import PARAMETERS, printed_smoother, same_numbers\n"
        "r = monte_carlo(PARAMETERS, printed_smoother(), runs=1333, duration=2e-5)\n"
        "print(same_numbers(r))"
    )
    environment = dict(
        os.environ, NUMBA_NUM_THREADS="7", PYTHONPATH=str(Path(__file__).resolve().parents[2])
    )
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    here = monte_carlo(PARAMETERS, printed_smoother(), runs=1333, duration=2e-5)
    assert done.stdout.strip() == same_numbers(here)


@pytest.mark.parametrize("kernel", [euler.simulate_blocks, splitting.simulate_blocks])
def test_compiled_code_is_kept_for_the_sources_that_it_was_made_from(kernel):
    for protocol in ("paper", "ergodic"):
        simulation(printed_smoother(), protocol=protocol).simulate(0, 1)
    sources = hashlib.sha256(
        b"".join(Path(module.__file__).read_bytes() for module in (noise, vectors))
    ).hexdigest()
    assert kernel.signatures
    for signature in kernel.signatures:  # of what is kept on disk, too
        assert signature[-1] == numba.types.Omitted(sources)


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


def signed(loop):
    A, Q = loop
    return A, -Q


def linear_mean_squares(P, to_delayed, estimator):
    """The filtered and the smoothed one from the stationary covariance of (phi, x_hat)."""
    filtered = np.concatenate([[1.0], -estimator.C_c[0]])
    smoothed = np.concatenate([[0.0], -estimator.C_a[0]])
    lagged = P[0, 0] + 2 * smoothed @ to_delayed @ P[:, 0] + smoothed @ P @ smoothed
    return filtered @ P @ filtered, lagged


@pytest.mark.parametrize(
    ("estimator", "step"),
    [(kalman_filter(), 5e-8), (kalman_filter(delay=1e-6), 5e-8), (printed_smoother(), 3.1e-8)],
    ids=["filter", "filter with a lag", "printed smoother"],
)
def test_linear_loop_has_the_variances_of_the_lyapunov_equation(estimator, step):
    parameters = quiet(PARAMETERS)
    without = estimator.A_c, estimator.B_c[:, :1].copy(), estimator.C_c[:1], estimator.C_a
    estimator = for_the_loop(estimator.plant.delay, *without)
    A, Q = linear_loop(parameters, estimator, QUIET)
    transition = np.eye(len(A)) + A * step
    P = solve_discrete_lyapunov(transition, Q * step)
    to_delayed = np.linalg.matrix_power(transition, round(estimator.plant.delay / step))
    expected = linear_mean_squares(P, to_delayed, estimator)
    result = monte_carlo(
        parameters,
        estimator,
        "paper",
        runs=20_000,
        duration=3e-4,
        step=step,
        seed=2,
        shot_noise=QUIET,
    )
    assert result.slips == 0
    for error, value in zip((result.filtered, result.smoothed), expected, strict=True):
        assert error.standard_error < 0.012 * value
        assert_within(error.mean_square, value, error.standard_error)


def test_euler_bias_is_of_first_order_in_the_step():
    estimator = kalman_filter()
    rate = -estimator.A_c[0, 0]
    steps = np.array([0.2, 0.1, 0.05]) / rate
    results = []
    for step in steps:
        with pytest.warns(LongStepWarning):
            result = monte_carlo(
                quiet(PARAMETERS),
                estimator,
                "paper",
                runs=200_000,
                duration=30 / rate,
                step=step,
                seed=3,
                shot_noise=QUIET,
            )
        results.append(result)
    exact, _ = linear_mean_squares(
        solve_continuous_lyapunov(*signed(linear_loop(quiet(PARAMETERS), estimator, QUIET))),
        np.eye(2),
        estimator,
    )
    bias = np.array([result.filtered.mean_square for result in results]) / exact - 1
    assert all(result.filtered.standard_error < 0.004 * exact for result in results)
    # Of a scalar linear equation with this rate: 1 / (1 - rate step / 2) - 1.
    expected = 1 / (1 - rate * steps / 2) - 1
    assert_within(bias, expected, max(r.filtered.standard_error for r in results) / exact)


@pytest.mark.parametrize("protocol", ["paper", "ergodic"])
def test_single_and_mixed_precision_agree(protocol):
    arguments = {"runs": 640, "duration": 2e-4, "step": 1e-8}
    mixed, single = (
        monte_carlo(PARAMETERS, printed_smoother(), protocol, precision=precision, **arguments)
        for precision in ("mixed", "single")
    )
    assert mixed.filtered != single.filtered
    for name in ("filtered", "smoothed"):
        assert getattr(single, name).mean_square == pytest.approx(
            getattr(mixed, name).mean_square, rel=2e-5
        )


def test_literal_nonlinearity_loses_lock():
    arguments = {"runs": 500, "duration": 2e-4, "step": 3.1e-8}
    with pytest.warns(LossOfLockWarning, match="cycle slips in"):
        literal = monte_carlo(
            PARAMETERS, printed_smoother(), "paper", oscillator="none", **arguments
        )
    assert literal.slipped_paths > 100
    assert literal.filtered.mean_square > 1


def test_published_protocol_is_the_default_of_paper():
    given = simulation(printed_smoother(), runs=None, duration=None, step=None)
    assert given.runs == 50_000
    assert given.steps == 100_000


def test_default_step_divides_the_delay():
    for delay in (3.1e-6, 1e-6 / 3, 7.77e-6):
        for protocol in ("paper", "ergodic"):
            estimator = printed_smoother(delay)
            result = monte_carlo(PARAMETERS, estimator, protocol, runs=1, duration=2e-5)
            assert delay / result.step == pytest.approx(round(delay / result.step), abs=1e-6)
            assert result.step <= (1e-8 if protocol == "paper" else 4.5e-7) * (1 + 1e-9)


def test_result_does_not_depend_on_the_unit_of_time():
    parameters, estimator = PARAMETERS, printed_smoother()
    arguments = {"runs": 64, "duration": 5e-5}
    seconds = monte_carlo(parameters, estimator, **arguments)
    unit = 2.0**-20
    parameters = with_parameters(
        lam=parameters.lam * unit,
        kappa=parameters.kappa * unit,
        alpha=parameters.alpha * math.sqrt(unit),
    )
    root = math.sqrt(unit)
    estimator = for_the_loop(
        3.1e-6 / unit,
        estimator.A_c * unit,
        estimator.B_c * [unit, root],
        estimator.C_c * [[1], [root]],
        estimator.C_a,
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
        "variance_reduction": 1.0,
    }
    assert json.loads(text)["provenance"]["parameters"]["kappa"] == 4e4


def test_result_describes_itself():
    result = monte_carlo(PARAMETERS, kalman_filter(), runs=40, duration=1e-5, seed=9)
    assert isinstance(result.smoothed, MeanSquare)
    assert result.smoothed == result.filtered  # no lag
    assert result.path_steps == 40 * round((result.warm_up + result.duration) / result.step)
    for part in ("ergodic: 40 runs", "seed 9", "mixed", "no slips"):
        assert part in repr(result)


def test_progress_bar_changes_nothing(terminal):
    arguments = {"runs": 100, "duration": 1e-5}
    silent = monte_carlo(PARAMETERS, kalman_filter(), **arguments)
    assert terminal.readouterr().err == ""
    shown = monte_carlo(PARAMETERS, kalman_filter(), progress=True, **arguments)
    assert "100%" in terminal.readouterr().err
    assert same_numbers(shown) == same_numbers(silent)


def test_the_filtered_read_out_steers_the_oscillator():
    estimator = replace(printed_smoother(), C_f=np.array([[1.0, 0.0, 0.0]]))
    assert_array_equal(homodyne_loop(PARAMETERS, estimator).readout[2], [1, 0, 0])


def test_overflow_names_the_first_path():
    unstable = replace(printed_smoother(0.0), A_c=1e6 * np.eye(3))
    with pytest.raises(RuntimeError) as caught:
        monte_carlo(PARAMETERS, unstable, "paper", runs=64, step=2e-8, duration=1e-3)
    for part in ("path 0 of seed 0 overflowed", "kappa=40000", "alpha=1162", "step, 2e-08 s"):
        assert part in str(caught.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_path_that_is_not_a_number_is_named_with_its_parameters(monkeypatch, bad):
    whole = PaperSimulation.simulate

    def spoilt(self, first, count, *report):
        results = whole(self, first, count)
        results[2, 1, 7] = bad
        return results

    monkeypatch.setattr(PaperSimulation, "simulate", spoilt)
    with pytest.raises(RuntimeError, match=f"path {2 * BLOCK + 7} of seed 5 overflowed, with lam="):
        monte_carlo(PARAMETERS, kalman_filter(), "paper", runs=500, duration=1e-6, seed=5)


def test_unstable_estimator_is_refused_or_overflows():
    unstable = replace(kalman_filter(), A_c=np.array([[1e6]]))
    with pytest.raises(UnstableLoopError, match="decay rate"):
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
        ({"copy": 1}, TypeError, "copy must be True or False, got 1"),
        ({"progress": "yes"}, TypeError, "progress must be True or False"),
        ({"runs": 0}, ValueError, "runs must be an integer of at least 1, got 0"),
        ({"runs": 10.0}, TypeError, "runs must be an integer, got 10.0"),
        ({"runs": True}, TypeError, "runs must be an integer"),
        ({"duration": -1e-3}, ValueError, "duration must be"),
        ({"duration": math.inf}, ValueError, "duration must be finite"),
        ({"duration": "1ms"}, TypeError, "duration must be a real number"),
        ({"duration": 1e-6}, ValueError, r"at least the smoother's delay, 3.1e-06 s, got 1e-06"),
        ({"duration": 1e-6, "step": 3.1e-7}, ValueError, "at least the smoother's delay"),
        (
            {"duration": 1e-6, "step": 3.1e-8, "protocol": "paper"},
            ValueError,
            "at least the smoother's delay",
        ),
        ({"step": 0.0}, ValueError, "step must be"),
        ({"step": math.nan}, ValueError, "step must be finite"),
        ({"step": 1 + 0j}, TypeError, "step must be a real number"),
        ({"seed": -1}, ValueError, "seed must be an integer of at least 0, got -1"),
        ({"seed": 1.5}, TypeError, "seed must be an integer"),
        ({"seed": 2**64}, ValueError, r"seed must be at most 18446744073709551615"),
        ({"shot_noise": -1.0}, ValueError, "shot_noise must be"),
        ({"shot_noise": math.nan}, ValueError, "shot_noise must be finite"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        monte_carlo(PARAMETERS, printed_smoother(), **arguments)


def test_bad_estimators_and_parameters_are_refused():
    system = PAPER.uncertain_system()
    two_outputs = kalman_bucy(replace(system, C0=[[1.0], [2.0]]))
    two_copies = kalman_bucy(replace(system, nonlinearities=2 * system.nonlinearities))
    for smoother, error, message in [
        (two_outputs, ValueError, "one output, one measurement and at most .* got m=2, l=1 and g"),
        (two_copies, ValueError, "at most one nonlinearity, got m=1, l=1 and g=2"),
        (None, TypeError, "smoother must be an Estimator, got NoneType"),
    ]:
        with pytest.raises(error, match=message):
            monte_carlo(PARAMETERS, smoother)
    with pytest.raises(TypeError, match="parameters must be a HomodyneParameters, got dict"):
        monte_carlo(vars(PARAMETERS), printed_smoother())
