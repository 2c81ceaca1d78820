"""How long a step may be: what is taken in silence, what with a warning, and what is refused.

Where a bias is compared with the documented one, the errors without sampling are the exact ones.
"""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robsmooth as rs
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.montecarlo import run
from robsmooth.homodyne.montecarlo.euler import longest_stable_step
from robsmooth.homodyne.montecarlo.protocols import (
    PROTOCOLS,
    SILENT_EULER,
    SILENT_SPLITTING,
)
from robsmooth.paper import published
from tests.helpers.loops import SIGMAS

PAPER = rs.homodyne.PAPER
SYSTEM = PAPER.uncertain_system()
FILTER = rs.baselines.kalman_bucy(SYSTEM, copies=True)
RESPONSE = homodyne_loop(PAPER, FILTER).response_time()

each_protocol = pytest.mark.parametrize(
    ("protocol", "silent"), [("paper", SILENT_EULER), ("ergodic", SILENT_SPLITTING)]
)


def small(protocol, estimator=FILTER, **arguments):
    """A short run."""
    return rs.monte_carlo(PAPER, estimator, protocol, runs=64, duration=1e-4, **arguments)


def growth(loop, step):
    """By how much the Euler-Maruyama scheme multiplies what it damps least, or not at all."""
    return np.abs(np.linalg.eigvals(np.eye(len(loop.drift)) + step * loop.linearised_drift())).max()


def swinging(function, lipschitz=1.0):
    """A resonance with a restoring force that is a function of the angle."""
    return rs.UncertainSystem(
        A=[[0.0, 1.0], [-1.0, -0.5]],
        B1=[[0.0, 0.0], [1.0, 0.0]],
        C0=[[1.0, 0.0]],
        C2=[[1.0, 0.0]],
        D21=[[0.0, 0.3]],
        uncertainties=[rs.Uncertainty([[0.0], [1.0]], [[0.1, 0.0]], [[0.0]])],
        nonlinearities=[
            rs.Nonlinearity([[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], lipschitz, function=function)
        ],
    )


# --- the optical loop -----------------------------------------------------------------------------


@each_protocol
def test_a_longer_step_than_is_silent_warns_where_it_was_given(protocol, silent):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small(protocol, step=silent * RESPONSE)
    step = 1.01 * silent * RESPONSE
    with pytest.warns(rs.LongStepWarning) as warned:
        small(protocol, step=step)
    (warning,) = warned
    assert warning.filename == __file__
    message = str(warning.message)
    for part in (f"step, {step:.4g} s", f"response time, {RESPONSE:.4g} s", f"above {silent:g} "):
        assert part in message
    fine = float(re.search(r"; (\S+) s is fine$", message)[1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        small(protocol, step=fine)


def test_a_step_of_five_response_times_is_not_taken_in_silence():
    with pytest.warns(rs.LongStepWarning, match=r"1e-05 s, is 4\.6 times .* 2\.173e-06 s"):
        result = rs.monte_carlo(PAPER, FILTER, runs=256, duration=0.05, step=1e-5)
    exact = rs.stationary_errors(PAPER, FILTER).filtered
    assert result.filtered.mean_square / exact - 1 == pytest.approx(0.027, abs=0.001)
    assert result.filtered.mean_square - exact > 100 * result.filtered.standard_error


@pytest.mark.parametrize(("step", "slips"), [(5e-4, 2000), (1e-3, 3000)])
def test_a_step_of_hundreds_of_response_times_loses_lock_and_says_so(step, slips):
    """The noise of such a step once overflowed: 1.8e-193 rad^2 without a word, or a LinAlgError."""
    with pytest.warns(rs.LongStepWarning), pytest.warns(rs.LossOfLockWarning):
        result = rs.monte_carlo(PAPER, FILTER, runs=256, duration=0.05, step=step)
    assert result.slips > slips
    assert result.filtered.mean_square > 100.0
    if step == 5e-4:
        assert result.filtered.mean_square == pytest.approx(459, rel=0.01)


def test_a_step_with_which_the_euler_scheme_means_nothing_is_refused_before_any_work(monkeypatch):
    monkeypatch.setattr(PROTOCOLS["paper"], "simulate", None)
    message = r"below 4\.302e-06 s, .* time 2\.173e-06 s, got 1e-05 s; 1e-08 s is fine$"
    with pytest.raises(ValueError, match=f"^step must be {message}"):
        rs.monte_carlo(PAPER, FILTER, "paper", runs=256, duration=0.05, step=1e-5)


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_euler_scheme_is_refused_from_where_it_is_unstable(order):
    estimator = rs.baselines.fixed_lag_smoother(SYSTEM, 3.1e-6, order, copies=True)
    loop = homodyne_loop(PAPER, estimator)
    longest = longest_stable_step(loop)
    assert growth(loop, 0.999 * longest) < 1.0 < growth(loop, 1.001 * longest)
    steps = 1 + int(3.1e-6 / longest)
    with pytest.warns(rs.LongStepWarning):
        run.plan(loop, "paper", step=3.1e-6 / steps)
    if order in (0, 2, 4):  # a kernel is compiled for each
        with pytest.warns(rs.LongStepWarning):
            small("paper", estimator, step=3.1e-6 / steps)
    if steps > 1:
        with pytest.raises(ValueError, match="unstable in this loop"):
            small("paper", estimator, step=3.1e-6 / (steps - 1))


def test_an_undamped_mode_and_an_unstable_one_set_no_limit_to_the_step():
    still = replace(
        homodyne_loop(PAPER, FILTER),
        drift=np.zeros((2, 2)),
        gains=np.zeros((2, 2)),
    )
    assert longest_stable_step(still) == still.response_time() == np.inf
    assert longest_stable_step(replace(still, drift=np.diag([0.0, 1.0]))) == np.inf
    assert run.plan(still, "paper").step == 1e-8


@settings(max_examples=60)
@given(
    st.floats(-3, 3),
    st.floats(-2, 1),
    st.floats(-9, -3),
    st.sampled_from([0, 2, 6]),  # orders: a pilot is compiled for each
    st.sampled_from(sorted(PROTOCOLS)),
)
def test_the_default_step_never_warns_and_is_never_refused(speed, noise, lag, order, protocol):
    """Loops that are slower and faster than the paper's, quieter and noisier, with any lag."""
    parameters = replace(
        PAPER,
        lam=PAPER.lam * 10.0**speed,
        kappa=PAPER.kappa * 10.0 ** (speed + noise),
        alpha=PAPER.alpha * 10.0 ** (speed / 2),
    )
    delay = 10.0**lag if order else 0.0
    system = parameters.uncertain_system()
    estimator = rs.baselines.fixed_lag_smoother(system, delay, order, copies=True)
    loop = homodyne_loop(parameters, estimator)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation = run.plan(loop, protocol, duration=max(1e-4, 2 * delay))
    if protocol == "paper":
        assert growth(loop, simulation.step) < 1.0


# --- the documented biases ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Kalman-Bucy", "smoother, as printed"])
def test_bias_of_the_longest_silent_step_of_ergodic_is_below_a_ten_thousandth(name):
    design = published.designs()[name]
    response = homodyne_loop(PAPER, design).response_time()
    delay = design.plant.delay
    step = SILENT_SPLITTING * response
    step = delay / np.ceil(delay / step) if delay else step
    result = rs.monte_carlo(PAPER, design, runs=40_000, seed=5, step=step)
    exact = rs.stationary_errors(PAPER, design)
    for output in ("filtered", "smoothed"):
        error, value = getattr(result, output), getattr(exact, output)
        assert error.standard_error < 2e-5 * value
        assert abs(error.mean_square - value) < 1e-4 * value


def test_bias_of_the_longest_silent_step_of_paper_is_half_the_step():
    result = rs.monte_carlo(
        PAPER, FILTER, "paper", runs=300_000, duration=3e-5, seed=1, step=SILENT_EULER * RESPONSE
    )
    exact = rs.stationary_errors(PAPER, FILTER).filtered
    error = result.filtered
    assert error.standard_error < 0.003 * exact
    assert abs(error.mean_square - (1 + SILENT_EULER / 2) * exact) < SIGMAS * error.standard_error


@pytest.mark.parametrize(("fraction", "low", "high"), [(0.2, 0.82, 0.95), (0.25, 0.76, 0.92)])
def test_slip_rate_of_ergodic_is_as_much_too_low_as_is_documented(fraction, low, high):
    noisy = replace(PAPER, kappa=10 * PAPER.kappa)
    estimator = rs.baselines.kalman_bucy(noisy.uncertain_system(), copies=True)
    response = homodyne_loop(noisy, estimator).response_time()
    rates = []
    for step in (0.05 * response, fraction * response):
        with pytest.warns(rs.LossOfLockWarning):
            result = rs.monte_carlo(noisy, estimator, runs=16_384, duration=2.5e-4, step=step)
        assert result.slips > 700
        rates.append(result.slip_rate)
    assert low < rates[1] / rates[0] < high


# --- any system -----------------------------------------------------------------------------------


@pytest.mark.parametrize("simulate", [rs.simulate, rs.sample_paths])
def test_a_long_step_in_any_nonlinear_loop_warns(simulate):
    estimator = rs.baselines.kalman_bucy(swinging(lambda v: np.tanh(v) - v), copies=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        default = simulate(estimator, runs=2, duration=10.0).step
        simulate(estimator, runs=2, duration=10.0, step=1.24 * default)
    with pytest.warns(rs.LongStepWarning) as warned:
        simulate(estimator, runs=2, duration=10.0, step=1.26 * default)
    (warning,) = warned
    assert warning.filename == __file__
    message = str(warning.message)
    for part in (
        f"step, {1.26 * default:.4g} s, is 0.252 times",
        f"response time, {5 * default:.4g} s",
        f"{default:.8g} s is fine",
    ):
        assert part in message


def test_any_step_of_a_loop_without_functions_is_taken_in_silence():
    system = replace(swinging(np.tanh), nonlinearities=())
    estimator = rs.baselines.kalman_bucy(system)
    assert rs.simulate(estimator, runs=2, step=5.0, uncertainties=[0.5]).step == 5.0
