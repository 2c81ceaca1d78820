"""The estimator in discrete time: against solvers of its equation, in any pieces, with gaps."""

import copy
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numba
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.signal import cont2discrete

import robsmooth as rs
from robsmooth import (
    Nonlinearity,
    UncertainSystem,
    augment,
    error_covariance,
    homodyne,
    statistical_linearisation,
)
from robsmooth.estimators import baselines
from robsmooth.estimators.discrete import DiscreteSmoother
from tests.helpers.strategies import feasible_design, random_system, seeds

# samples of any length, beside any delay
pytestmark = pytest.mark.filterwarnings("ignore::robsmooth.LongStepWarning")

SIGMAS = 4.5  # a correct program is further off once in 150 000 times, were the seeds free


@numba.njit
def bend(v):
    return math.tanh(v)


@numba.njit
def sine(v):
    return math.sin(v)


@numba.vectorize
def arctangent(v):
    return math.atan(v)


@numba.njit
def of_arrays(v):
    result = np.empty_like(v)
    for i in range(len(v)):
        result[i] = math.sin(v[i])
    return result


def with_functions(system, functions):
    nonlinearities = [
        replace(c, function=f) for c, f in zip(system.nonlinearities, functions, strict=True)
    ]
    return replace(system, nonlinearities=nonlinearities)


def design(functions=(bend, sine)):
    """A smoother that runs copies of strong nonlinearities, with a lag."""
    g = len(functions)
    system = random_system(np.random.default_rng(3), n=2, m=2, measurements=2, g=g, size=0.4)
    return baselines.fixed_lag_smoother(with_functions(system, functions), 0.5, 2, copies=True)


def held(estimator, dt, functions=None):
    """The estimator's own equations, with the delay model, in steps of dt."""
    return estimator.discretize(dt, functions, delay="model")


def linear(estimator):
    """The estimator without its copies."""
    system, B_c, C_c = estimator.plant.system, estimator.B_c.copy(), estimator.C_c.copy()
    B_c[:, system.l :], C_c[system.m :] = 0.0, 0.0
    return replace(estimator, B_c=B_c, C_c=C_c)


def right_hand_side(estimator, y, reference):
    """The estimator's equation as the paper has it, missing measurements predicted."""
    system, m = estimator.plant.system, estimator.plant.system.m

    def rate(_, x):
        nu = estimator.C_c[m:] @ x - reference
        mu = np.array(
            [np.tanh(nu[0]), np.sin(nu[1])] if len(nu) else []  # the functions of `design`
        )
        expected = system.C2 @ x[: system.n] + sum(
            c.D[:, 0] * v for c, v in zip(system.nonlinearities, mu, strict=True)
        )
        seen = np.where(np.isnan(y), expected, y)
        return estimator.A_c @ x + estimator.B_c @ np.concatenate([seen, mu])

    return rate


def solved(estimator, dt, y, reference=None):
    """The states at the ends of the intervals by an adaptive solver."""
    reference = np.zeros((len(y), estimator.plant.system.g)) if reference is None else reference
    states, x = [], np.zeros(len(estimator.A_c))
    for row, shift in zip(y, reference, strict=True):
        x = solve_ivp(right_hand_side(estimator, row, shift), (0, dt), x, rtol=1e-12, atol=1e-13).y[
            :, -1
        ]
        states.append(x)
    return np.array(states)


def record(rows, columns=2, gaps=0.0, seed=0):
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((rows, columns))
    y[rng.random((rows, columns)) < gaps] = np.nan
    return y


# --- the linear part -----------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::robsmooth.LongStepWarning")
@given(st.sampled_from([(1, 1, 1, 0), (2, 2, 1, 2), (3, 1, 2, 3)]), seeds, st.floats(-3, 2))
def test_the_linear_part_is_held_exactly(sizes, seed, exponent):
    n, m, measurements, order = sizes
    system = random_system(np.random.default_rng(seed), n, m, measurements, g=0)
    estimator = baselines.fixed_lag_smoother(system, 0.5, order)
    dt = 10**exponent / np.abs(estimator.poles).max()
    outputs = np.vstack([estimator.C_a, estimator.C_f])
    Phi, Gamma, *_ = cont2discrete(
        (estimator.A_c, estimator.B_c, outputs, np.zeros((2 * m, measurements))), dt
    )
    y = record(20, measurements, seed=seed)
    expected, x = [], np.zeros(len(Phi))
    for row in y:
        x = Phi @ x + Gamma @ row
        expected.append(outputs @ x)
    expected = np.array(expected)
    size = np.abs(expected).max()
    discrete = held(estimator, dt)
    assert_allclose(discrete.run(y), expected[:, :m], rtol=0, atol=1e-10 * size)
    discrete.reset()
    found = discrete.run(y, output="filtered")
    assert_allclose(found, expected[:, m:], rtol=0, atol=1e-10 * size)


@pytest.mark.parametrize("ratio", [1e-9, 1e-3, 1.0, 30.0, 1e6])
def test_any_length_of_a_sample_is_exact(ratio):
    system = UncertainSystem(A=[[-2.0]], B1=[[1.0, 0]], C0=[[1]], C2=[[1]], D21=[[0, 0.1]])
    estimator = baselines.kalman_bucy(system)
    rate, gain = -estimator.A_c[0, 0], estimator.B_c[0, 0]
    discrete = held(estimator, ratio / rate)
    discrete.reset([3.0])
    expected = 3.0 * math.exp(-ratio) - math.expm1(-ratio) * gain / rate * 5.0
    assert_allclose(discrete.step([5.0]), [expected], rtol=1e-14)


@pytest.mark.parametrize("pattern", [[], [0], [1], [0, 1]])
def test_a_sample_may_be_cut_in_two(pattern):
    estimator = linear(design())
    y = record(5)
    y[:, pattern] = np.nan
    whole = held(estimator, 0.3).run(y)
    halves = held(estimator, 0.15).run(np.repeat(y, 2, axis=0))
    assert_allclose(halves[1::2], whole, rtol=0, atol=1e-13)
    uneven = held(estimator, 0.1).run(np.repeat(y, 2, axis=0), intervals=[0.03, 0.27] * 5)
    assert_allclose(uneven[1::2], whole, rtol=0, atol=1e-13)


def test_stiff_estimators_are_exact():
    # time constants of 1 and 1e-6, and samples of 0.1
    system = UncertainSystem(
        A=np.diag([-1.0, -1e6]),
        B1=np.diag([1.0, 1e3, 0])[:2],
        C0=np.eye(2),
        C2=[[1.0, 1.0]],
        D21=[[0, 0, 1.0]],
    )
    estimator = baselines.kalman_bucy(system)
    found = held(estimator, 0.1).run(np.ones((2000, 1)))[-1]
    assert_allclose(found, -np.linalg.solve(estimator.A_c, estimator.B_c[:, 0]), rtol=1e-9)


@pytest.mark.parametrize("unit", [1e-9, 3e7])
def test_nothing_depends_on_the_unit_of_time(unit):
    """The same estimator with its rates told in another unit."""
    estimator = design()
    delay = estimator.plant.delay_model
    plant = replace(estimator.plant, delay_model=delay._replace(delay=unit * delay.delay))
    scaled = replace(estimator, plant=plant, A_c=estimator.A_c / unit, B_c=estimator.B_c / unit)
    y, dt = record(200, gaps=0.1), 0.2
    one, other = held(estimator, dt), held(scaled, unit * dt)
    assert_allclose(other.run(y), one.run(y), rtol=1e-9)
    assert_allclose(other.times(200) / unit, one.times(200), rtol=1e-12, atol=1e-12)


def test_nothing_depends_on_the_units_of_the_state():
    estimator = design()
    scale = np.geomspace(1e-9, 1e9, len(estimator.A_c))
    scaled = replace(
        estimator,
        A_c=scale[:, None] * estimator.A_c / scale,
        B_c=scale[:, None] * estimator.B_c,
        C_c=estimator.C_c / scale,
        C_a=estimator.C_a / scale,
        C_f=estimator.C_f / scale,
    )
    y = record(100)
    assert_allclose(held(scaled, 0.2).run(y), held(estimator, 0.2).run(y), rtol=1e-9)


# --- the copies ----------------------------------------------------------------------------------


@pytest.mark.parametrize("gaps", [0.0, 0.4])
def test_copies_converge_with_the_second_order(gaps):
    estimator = design()
    rows, span = 12, 0.4
    y, reference = record(rows, gaps=gaps), 0.5 * record(rows, seed=1)
    expected = solved(estimator, span, y, reference) @ estimator.C_f.T
    errors = []
    for pieces in (4, 8, 16, 32):
        found = held(estimator, span / pieces).run(
            np.repeat(y, pieces, axis=0),
            reference=np.repeat(reference, pieces, axis=0),
            output="filtered",
        )[pieces - 1 :: pieces]
        errors.append(np.abs(found - expected).max())
    orders = np.diff(np.log2(errors))
    assert_allclose(orders, -2.0, atol=0.15)
    assert errors[-1] < 1e-4 * np.abs(expected).max()


def test_the_copies_are_not_negligible_here():
    estimator = design()
    y = 3.0 * record(50)
    with_copies, without = (
        held(estimator, 0.2).run(y),
        held(linear(estimator), 0.2).run(y),
    )
    assert np.abs(with_copies - without).max() > 0.05 * np.abs(without).max()


def test_an_equilibrium_is_kept():
    estimator = design()
    y = np.array([[0.7, -0.4]])
    discrete = held(estimator, 0.05)
    discrete.run(np.repeat(y, 4000, axis=0))
    rest = discrete.state
    assert_allclose(right_hand_side(estimator, y[0], 0.0)(0, rest), 0.0, atol=1e-12)
    long = held(estimator, 10.0)
    long.reset(rest)
    long.step(y[0])
    assert_allclose(long.state, rest, atol=1e-12)


def test_long_samples_are_stable():
    tried = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        system = with_functions(random_system(rng, m=2, measurements=2, g=2), (bend, sine))
        estimator = feasible_design(rng, augment(system, 0.5, 2))
        if estimator is None:
            continue
        for ratio in (1.0, 10.0, 1e3):
            discrete = held(estimator, ratio / np.abs(estimator.poles).min())
            discrete.reset(np.full(len(estimator.A_c), 5.0))
            rows = discrete.run(np.full((400, 2), 2.0))
            assert_allclose(rows[-1], rows[-2], rtol=1e-9, atol=1e-12)
            tried += 1
    assert tried >= 12


KINDS = {
    "plain": (np.vectorize(math.tanh), np.vectorize(math.sin)),
    "of arrays": (np.tanh, of_arrays),
    "mixed": (bend, np.vectorize(math.sin)),
}


@pytest.mark.filterwarnings("ignore:numba cannot compile")
@pytest.mark.parametrize("functions", KINDS.values(), ids=KINDS)
def test_functions_that_are_not_compiled_give_the_same(functions):
    estimator = design()
    compiled, other = held(estimator, 0.2), held(estimator, 0.2, functions=functions)
    assert compiled.compiled and not other.compiled
    y, reference = record(100, gaps=0.2), record(100, seed=1)
    found = other.run(y, reference=reference)
    assert_allclose(found, compiled.run(y, reference=reference), rtol=0, atol=1e-12)


def test_compiled_functions_of_arrays_and_numbers_are_fast():
    functions = (arctangent, sine)
    discrete = held(design(), 0.2, functions=functions)
    assert discrete.compiled
    plain = held(design(), 0.2, functions=(np.arctan, np.sin))
    y = record(50)
    assert_allclose(discrete.run(y), plain.run(y), rtol=0, atol=1e-12)


def test_some_functions_may_be_given():
    estimator = design()
    given_one = held(estimator, 0.2, functions=(None, np.sin))
    y = record(20)
    assert_allclose(given_one.run(y), held(estimator, 0.2).run(y), rtol=0, atol=1e-13)


def test_plain_functions_are_compiled():
    functions = (lambda v: np.tanh(v), np.sin)
    discrete = held(design(), 0.2, functions=functions)
    assert discrete.compiled
    y, reference = record(100, gaps=0.2), record(100, seed=1)
    expected = held(design(), 0.2).run(y, reference=reference)
    assert_allclose(discrete.run(y, reference=reference), expected, rtol=0, atol=1e-12)
    loop = baselines.kalman_bucy(homodyne.PAPER.uncertain_system(), copies=True)
    assert loop.discretize(1e-8).compiled


def test_a_function_that_is_not_compiled_is_told_once_and_its_errors_are_raised():
    def stubborn(v):
        if np.abs(v).max() > 3.0:
            raise OverflowError("too far")
        return np.array([math.sin(each) for each in v])

    with pytest.warns(RuntimeWarning, match="cannot compile the function .*stubborn") as given:
        discrete = held(design(), 0.2, functions=(None, stubborn))
        held(design(), 0.2, functions=(None, stubborn))
    assert len(given) == 1 and not discrete.compiled
    y = record(50)
    assert_allclose(discrete.run(y), held(design(), 0.2).run(y), rtol=0, atol=1e-12)
    before = discrete.state
    with pytest.raises(OverflowError, match="too far"):
        discrete.run(1e3 * y)
    assert_array_equal(discrete.state, before)
    assert np.isfinite(discrete.run(y)).all()


def test_a_compiled_function_that_fails_is_not_taken_for_a_number():
    @numba.njit
    def limited(v):
        if v > 3.0:
            raise ValueError("too far")
        return math.sin(v)

    discrete = held(design(), 0.2, functions=(None, limited))
    with pytest.raises(ArithmeticError, match="left the range"):
        discrete.run(1e3 * record(50))


def test_a_function_of_which_numba_makes_another_is_called_as_it_is():
    calls = []

    def counting(v):
        calls.append(v)
        return np.sin(v)

    with pytest.warns(RuntimeWarning, match="cannot compile the function"):
        discrete = held(design(), 0.2, functions=(None, counting))
    assert not discrete.compiled and len(calls) > 0


def test_a_copy_without_effect_needs_no_function():
    system = homodyne.PAPER.uncertain_system()
    (channel,) = system.nonlinearities
    system = replace(system, nonlinearities=[replace(channel, function=None)])
    discrete = held(baselines.kalman_bucy(system), 1e-7)
    y = record(10, 1)
    found = discrete.run(y, reference=np.ones((10, 1)))  # of no use to it
    assert_array_equal(found, held(baselines.kalman_bucy(system), 1e-7).run(y))


def test_the_homodyne_copy_acts_on_the_difference_to_the_oscillator():
    """As `robsmooth.homodyne.loop` has it: psi of nu less 2 alpha gamma times its phase."""
    p = homodyne.PAPER
    estimator = baselines.kalman_bucy(p.uncertain_system(), copies=True)
    dt, scale = 1e-9, 2 * p.alpha * p.gamma
    phase, oscillator = 0.8, 0.3
    discrete = held(estimator, dt)
    discrete.reset([phase])
    y = math.sin(phase - oscillator) / p.beta + oscillator
    discrete.step([y], reference=[scale * oscillator])
    # what a filter at the true phase expects is what is measured: only the decay is left
    assert_allclose(discrete.state - phase, [-p.lam * dt * phase], rtol=1e-3)


# --- missing measurements ------------------------------------------------------------------------


def test_without_measurements_the_kalman_filter_is_the_plant():
    system = random_system(np.random.default_rng(3), n=3, measurements=2)
    estimator = baselines.fixed_lag_smoother(system, 0.5, 2)
    discrete = held(estimator, 0.1)
    discrete.run(record(50))
    state = discrete.state
    discrete.run(np.full((7, 2), np.nan))
    assert_allclose(discrete.state, expm(0.7 * estimator.plant.A_p) @ state, atol=1e-12)


def test_a_missing_channel_is_as_one_that_was_never_there():
    """Of two measurements with independent noise, the filter of both weighs each by itself."""
    estimator = linear(design())
    system = estimator.plant.system
    discrete = held(estimator, 0.1)
    y = record(100)
    y[:, 1] = np.nan
    A = estimator.A_c + np.outer(estimator.B_c[:, 1], estimator.plant.C2_tilde[1])
    Phi, Gamma, *_ = cont2discrete(
        (A, estimator.B_c[:, :1], estimator.C_a, np.zeros((system.m, 1))), 0.1
    )
    x = np.zeros(len(Phi))
    for row in y:
        x = Phi @ x + Gamma @ row[:1]
    assert_allclose(discrete.run(y)[-1], estimator.C_a @ x, atol=1e-12)


@given(seeds, st.integers(0, 2), st.sampled_from(["filtered", "smoothed"]))
def test_a_long_gap_ends_at_the_prior(seed, g, cost):
    rng = np.random.default_rng(seed)
    plant = augment(random_system(rng, g=g), 0.5, 1)
    estimator = feasible_design(rng, plant, cost)
    assume(estimator is not None)
    estimator = linear(estimator)
    drift = estimator.A_c + estimator.B_c[:, :1] @ estimator.plant.C2_tilde[:1]
    slowest = -np.linalg.eigvals(drift).real.max()
    assert slowest > 0
    discrete = held(estimator, 1.0 / slowest)
    before = discrete.run(record(20, 1, seed=seed))
    after = discrete.run(np.full((200, 1), np.nan))
    assert np.abs(after[-1]).max() <= 1e-12 * max(np.abs(before).max(), np.abs(after).max())


def test_gaps_cost_no_more_than_their_patterns():
    discrete = held(design(), 0.2)
    discrete.run(record(500, gaps=0.5))
    assert len(discrete._engine._kept) == 4  # all subsets of two channels


# --- pieces --------------------------------------------------------------------------------------


@pytest.mark.parametrize("functions", [(bend, sine), (np.tanh, np.sin), ()])
@given(cuts=st.lists(st.integers(0, 40), max_size=6), gaps=st.sampled_from([0.0, 0.3]))
def test_pieces_give_the_same_to_the_last_bit(functions, cuts, gaps):
    estimator = ESTIMATORS[functions]
    y, g = record(40, gaps=gaps), estimator.plant.system.g
    reference = record(40, g, seed=1)
    whole = held(estimator, 0.2).run(y, reference=reference)
    discrete = held(estimator, 0.2)
    edges = [0, *sorted(cuts), 40]
    pieces = [discrete.run(y[a:b], reference=reference[a:b]) for a, b in pairwise(edges)]
    assert_array_equal(np.concatenate(pieces), whole)
    discrete.reset()
    steps = [discrete.step(row, reference=r) for row, r in zip(y, reference, strict=True)]
    assert_array_equal(steps, whole)


ESTIMATORS = {f: design(functions=f) for f in ((bend, sine), (np.tanh, np.sin), ())}


def test_large_estimators_in_pieces():
    """Where the compiler does not unroll its loops."""
    system = random_system(np.random.default_rng(0), n=40, m=3, measurements=3, g=0, size=0.0)
    estimator = baselines.fixed_lag_smoother(system, 0.5, 4)
    y = record(60, 3, gaps=0.1)
    whole = held(estimator, 0.1).run(y)
    discrete = held(estimator, 0.1)
    assert_array_equal([discrete.step(row) for row in y], whole)
    expected = solved_linearly(estimator, 0.1, y)
    assert_allclose(whole, expected, atol=1e-9 * np.abs(expected).max())


def solved_linearly(estimator, dt, y):
    """Smoothed estimates, each sample by the exponential of its own equation."""
    n, gain = len(estimator.A_c), estimator.B_c[:, : y.shape[1]]
    x, rows = np.zeros(n), []
    for row in y:
        missing = np.isnan(row)
        A = estimator.A_c + gain[:, missing] @ estimator.plant.C2_tilde[: len(row)][missing]
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = A, gain @ np.where(missing, 0.0, row)
        x = (expm(block * dt) @ np.append(x, 1.0))[:n]
        rows.append(estimator.C_a @ x)
    return np.array(rows)


def test_a_record_of_no_rows():
    discrete = held(design(), 0.2)
    assert discrete.run(np.empty((0, 2))).shape == (0, 2)
    assert discrete.times(0).shape == (0,)
    assert discrete.samples == 0


@pytest.mark.parametrize("kind", ["int", "float32", "Fortran", "read-only", "strided", "list"])
def test_records_of_any_kind(kind):
    y = np.round(10 * record(30))
    given_ = {
        "int": y.astype(np.int16),
        "float32": y.astype(np.float32),
        "Fortran": np.asfortranarray(y),
        "read-only": np.broadcast_to(y, y.shape),
        "strided": np.repeat(y, 2, axis=0)[::2],
        "list": y.tolist(),
    }[kind]
    estimator = design()
    found = held(estimator, 0.2).run(given_)
    assert_array_equal(found, held(estimator, 0.2).run(y))


# --- time ----------------------------------------------------------------------------------------


def test_rows_belong_to_the_times_that_are_told():
    """A signal that is measured well is found at the times told, and not a sample beside them."""
    system = UncertainSystem(A=[[-1.0]], B1=[[1.0, 0]], C0=[[1]], C2=[[1]], D21=[[0, 1e-3]])
    dt, lag, omega = 1e-3, 0.02, 20.0
    discrete = held(baselines.fixed_lag_smoother(system, lag, 6), dt)
    ends = dt * np.arange(2001)
    means = -np.diff(np.cos(omega * ends)) / (omega * dt)  # of sin(omega t) over each interval
    found = discrete.run(means[:, None])[1000:, 0]
    times = discrete.times(1000)
    error, early, late = (
        np.abs(found - np.sin(omega * (times + shift))).max() for shift in (0.0, -dt, dt)
    )
    assert error < 0.1 * min(early, late)
    assert_allclose(discrete.times(2000)[[0, -1]], [dt - lag, 2000 * dt - lag])
    assert_allclose(discrete.times(1, "filtered"), [2000 * dt])


def test_the_state_is_what_the_last_row_was_read_from():
    estimator = design()
    discrete = held(estimator, 0.2)
    last = discrete.run(record(9))[-1]
    assert discrete.samples == 9
    assert_allclose(discrete.smoothed, last, rtol=1e-12)
    assert_allclose(discrete.filtered, estimator.C_f @ discrete.state, rtol=1e-12)
    again = held(estimator, 0.2)
    again.reset(discrete.state)
    assert_array_equal(again.run(record(5)), discrete.run(record(5)))
    discrete.reset()
    assert discrete.samples == 0 and not discrete.state.any()


@pytest.mark.filterwarnings("ignore:numba cannot compile")
def test_it_tells_what_it_is():
    discrete = held(design(), 0.2)
    discrete.step([1.0, 2.0])
    assert repr(discrete) == (
        "DiscreteSmoother(dt=0.2 s, delay=0.5 s, delay model, 6 states, 2 measurements, "
        "2 outputs, 2 copies, compiled, 1 samples taken)"
    )
    assert "not compiled" in repr(held(design(), 0.2, functions=KINDS["plain"]))


# --- the errors of the estimate ------------------------------------------------------------------


def sampled_loop(estimator, dt):
    """The plant with W, sampled: transition, and covariance of state and mean of dy/dt.

    In the coordinates (x, integral of dy); Van Loan's block exponential.
    """
    system = estimator.plant.system
    n, size = system.n, system.n + system.l
    drift = np.zeros((size, size))
    drift[:n, :n], drift[n:, :n] = system.A, system.C2
    noise = np.vstack([system.B1, system.D21])
    block = np.block([[-drift, noise @ noise.T], [np.zeros_like(drift), drift.T]]) * dt
    phi = expm(block)
    transition = phi[size:, size:].T
    covariance = transition @ phi[:size, size:]
    return transition, (covariance + covariance.T) / 2


def exact_errors(estimator, dt, lag):
    """The stationary error covariance of the discretised estimator, from a discrete Lyapunov."""
    system = estimator.plant.system
    n, n_c, gain = system.n, len(estimator.A_c), estimator.B_c[:, : system.l]
    F, Q = sampled_loop(estimator, dt)
    Phi, Gamma, *_ = cont2discrete((estimator.A_c, gain, np.eye(n_c), np.zeros(gain.shape)), dt)
    Gamma = Gamma / dt  # of the integral
    joint = np.zeros((n + n_c, n + n_c))
    joint[:n, :n], joint[n:, :n], joint[n:, n:] = F[:n, :n], Gamma @ F[n:, :n], Phi
    kick = np.zeros((n + n_c, len(Q)))
    kick[:n, :n], kick[n:, n:] = np.eye(n), Gamma
    P = solve_discrete_lyapunov(joint, kick @ Q @ kick.T)
    truth = np.hstack([system.C0, np.zeros((system.m, n_c))])
    estimate = np.hstack([np.zeros((system.m, n)), estimator.C_a])
    cross = estimate @ np.linalg.matrix_power(joint, lag) @ P @ truth.T
    return truth @ P @ truth.T - cross - cross.T + estimate @ P @ estimate.T


def classical():
    """A fixed-lag smoother of a system with correlated noises, and its sampling of the lag."""
    system = random_system(np.random.default_rng(5), n=2, m=2, measurements=2, g=0, size=0.0)
    return baselines.fixed_lag_smoother(system, 0.6, 3)


def test_the_error_tends_to_that_in_continuous_time():
    estimator = classical()
    Delta = np.zeros((4, 4))
    limit = error_covariance(estimator, Delta, loop="real")
    excess = [
        np.abs(exact_errors(estimator, 0.6 / lag, lag) - limit).max() for lag in (16, 32, 64, 128)
    ]
    assert excess[-1] < 2e-3 * np.abs(limit).max()
    assert_allclose(np.diff(np.log2(excess)), -2.0, atol=0.1)


def test_the_measured_error_is_the_one_that_theory_tells():
    """Simulated exactly, run through the smoother, and compared with the closed loop's formula."""
    estimator = classical()
    lag, paths, rows = 60, 400, 3000
    dt, settle = 0.6 / lag, 200
    system = estimator.plant.system
    n, m = system.n, system.m
    F, Q = sampled_loop(estimator, dt)
    root = np.linalg.cholesky(Q)
    rng = np.random.default_rng(7)
    start = np.linalg.cholesky(solve_discrete_lyapunov(F[:n, :n], Q[:n, :n]))
    x = start @ rng.standard_normal((n, paths))
    truth, y = np.empty((rows, paths, m)), np.empty((rows, paths, system.l))
    for k in range(rows):
        following = F[:, :n] @ x + root @ rng.standard_normal((len(F), paths))
        x = following[:n]
        truth[k], y[k] = (system.C0 @ x).T, following[n:].T / dt
    discrete = held(estimator, dt)
    squares = np.empty((paths, m))
    for path in range(paths):
        discrete.reset()
        found = discrete.run(y[:, path])
        # the row of sample k is of the time (k + 1) dt - lag, where the state is that of k - lag
        error = found[settle + lag :] - truth[settle:-lag, path]
        squares[path] = (error**2).mean(axis=0)
    expected = np.diag(error_covariance(estimator, np.zeros((4, 4)), loop="real"))
    deviation = squares.std(axis=0, ddof=1) / np.sqrt(paths)
    assert (deviation < 0.012 * expected).all()
    assert (np.abs(squares.mean(axis=0) - expected) < SIGMAS * deviation).all()


def test_in_the_homodyne_loop_its_errors_are_those_that_are_predicted():
    """Step by step in the loop: the oscillator has the filtered estimate for the next sample."""
    p = homodyne.PAPER
    estimator = baselines.fixed_lag_smoother(p.uncertain_system(), 3.1e-6, 2, copies=True)
    expected = statistical_linearisation(p, estimator)
    dt, lag, samples, fine = 1e-7, 31, 30_000, 4
    alpha, beta = p.alpha, p.beta
    scale, slope = 2 * alpha * p.gamma, 2 * alpha * beta

    @numba.njit
    def psi(nu):
        return 2 * alpha * (math.sin(nu / scale) - beta * nu / scale)

    discrete = held(estimator, dt, functions=[psi])
    rng = np.random.default_rng(1)
    decay = math.exp(-p.lam * dt / fine)
    kicks = rng.standard_normal((samples, fine)) * math.sqrt(p.kappa / (2 * p.lam) * (1 - decay**2))
    shot = rng.standard_normal(samples) / math.sqrt(dt)
    phase, oscillator = 0.0, 0.0
    phases, filtered, smoothed = np.empty((3, samples))
    for k in range(samples):
        current = shot[k]
        for kick in kicks[k]:
            phase = decay * phase + kick
            current += 2 * alpha * math.sin(phase - oscillator) / fine
        y = (current + slope * oscillator) / slope
        smoothed[k] = discrete.step([y], reference=[scale * oscillator])[0]
        oscillator = filtered[k] = discrete.filtered[0]
        phases[k] = phase
    for errors, mean_square in (
        (phases[500:] - filtered[500:], expected.filtered),
        (phases[500:-lag] - smoothed[500 + lag :], expected.smoothed),
    ):
        # parts of some hundred time constants of the loop are independent
        parts = [part.mean() for part in np.array_split(errors**2, 30)]
        deviation = np.std(parts, ddof=1) / math.sqrt(len(parts))
        assert deviation < 0.06 * mean_square
        assert abs(np.mean(parts) - mean_square) < SIGMAS * deviation


# --- refusals ------------------------------------------------------------------------------------


def test_a_copy_without_function_is_refused():
    estimator = design()
    system = estimator.plant.system
    bare = replace(
        system, nonlinearities=[replace(c, function=None) for c in system.nonlinearities]
    )
    estimator = replace(estimator, plant=replace(estimator.plant, system=bare))
    with pytest.raises(ValueError, match=r"nonlinearities\[0\] must have a function"):
        estimator.discretize(0.2)
    assert isinstance(estimator.discretize(0.2, functions=[bend, sine]), DiscreteSmoother)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"dt": 0.0}, ValueError, "dt must be finite and in"),
        ({"dt": "1"}, TypeError, "dt must be a real number"),
        ({"dt": 1.0, "functions": [np.sin]}, ValueError, "functions must have 2 entries"),
        ({"dt": 1.0, "functions": np.sin}, TypeError, "functions must be a sequence"),
        ({"dt": 1.0, "functions": [np.cos, np.sin]}, ValueError, "must be zero at zero"),
        ({"dt": 1.0, "functions": [1, np.sin]}, TypeError, "must be callable"),
    ],
)
def test_wrong_discretisations_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        design().discretize(**arguments)


WRONG = [
    ([1.0, 2.0], ValueError, r"y must have shape \(N, 2\), got \(2,\)"),
    ([[1.0, 2.0, 3.0]], ValueError, r"y must have shape \(N, 2\), got \(1, 3\)"),
    ([[1.0, 2.0], [3.0]], ValueError, "y must be a rectangular array"),
    ([["a", "b"]], TypeError, "y must be an array of numbers, .* <U1: np.array"),
    ([[True, False]], TypeError, "y must be an array of numbers, .* bool: np.array"),
    ([[1.0, None]], TypeError, "y must be an array of numbers, .* object: np.array"),
    ([[10**400, 0]], TypeError, "y must be an array of numbers, .* object: np.array"),
    ([[1j, 2.0]], ValueError, "y must be real, got complex entries: its .real is"),
    (
        [2 * [0.0] + [1.0], 3 * [2.0]],
        ValueError,
        r"got \(2, 3\); y.T has it, a row for each sample",
    ),
    ([[0.0, 1.0], [np.nan, -np.inf]], ValueError, "got -inf at row 1, column 1"),
]


@pytest.mark.parametrize(("y", "error", "message"), WRONG)
def test_wrong_records_are_refused_and_nothing_is_taken(y, error, message):
    discrete = held(design(), 0.2)
    discrete.run(record(3))
    before = discrete.state
    with pytest.raises(error, match=message):
        discrete.run(y)
    assert discrete.samples == 3
    assert_array_equal(discrete.state, before)


def test_one_measurement_may_be_a_list():
    discrete = baselines.kalman_bucy(homodyne.PAPER.uncertain_system()).discretize(1e-7)
    expected = discrete.run([[0.1], [np.nan], [-0.3]])
    for y in ([0.1, np.nan, -0.3], np.ma.masked_equal([0.1, -7.0, -0.3], -7.0)):
        discrete.reset()
        assert_array_equal(discrete.run(y), expected)
    with pytest.raises(ValueError, match=r"got \(1, 5\); y.T has it"):
        discrete.run(np.zeros((1, 5)))


@pytest.mark.parametrize("delay", ["exact", "model"])
def test_samples_one_by_one_are_those_of_a_run(delay):
    estimator = baselines.fixed_lag_smoother(homodyne.PAPER.uncertain_system(), 3.1e-6, 2, True)
    y = record(200, 1, gaps=0.1)
    expected = estimator.discretize(1e-6, delay=delay, offset=[1.0]).run(y)
    for kind in (float, list, np.array):
        discrete = estimator.discretize(1e-6, delay=delay, offset=[1.0])
        found = [discrete.step(float(row[0]) if kind is float else kind(row)) for row in y]
        assert_array_equal(found, expected)
        assert discrete.samples == 200


@pytest.mark.parametrize("delay", ["exact", "model"])
def test_threads_that_share_a_smoother_take_turns(delay):
    system = homodyne.PAPER.uncertain_system()
    discrete = baselines.fixed_lag_smoother(system, 3.1e-6, 2, True).discretize(1e-6, delay=delay)
    expected = discrete.run(np.ones((4000, 1)))[-1]

    def one_by_one(y):
        for row in y:
            discrete.step(row)

    for take in (one_by_one, discrete.run):
        discrete.reset()
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(take, [np.ones((500, 1))] * 8))
        assert discrete.samples == 4000
        assert_array_equal(discrete.smoothed, expected)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda d: d.step(1.0), r"y must have shape \(2,\), got shape \(\)"),
        (lambda d: d.step([[1.0, 2.0]]), r"y must have shape \(2,\), got shape \(1, 2\)"),
        (lambda d: d.step([1.0, np.inf]), "got inf at row 0, column 1"),
        (lambda d: d.run(record(3), output="both"), "output must be one of"),
        (lambda d: d.run(record(3), reference=np.zeros((2, 2))), "must have 3 rows, as y, got 2"),
        (lambda d: d.run(record(3), reference=np.zeros((3, 1))), r"must have shape \(N, 2\)"),
        (lambda d: d.step([1, 2], reference=[0, np.nan]), "reference must be finite, got nan"),
        (lambda d: d.times(1), "rows must be at most the 0 samples taken, got 1"),
        (lambda d: d.reset([1.0]), r"state must have shape \(2\), got \(1,\)"),
    ],
)
def test_wrong_calls_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(design().discretize(0.2))


def test_a_delay_far_below_a_sample_is_pointed_out():
    system = random_system(np.random.default_rng(0))
    with pytest.warns(
        rs.LongStepWarning, match=r"dt=1 s is more than twice the delay of 2\.8e-05 s"
    ) as w:
        baselines.fixed_lag_smoother(system, 2.8e-5, 2).discretize(1.0)
    assert w[0].filename == __file__
    for delay in (0.0, 0.5):
        baselines.fixed_lag_smoother(system, delay, 2).discretize(1.0)


def test_an_unstable_estimator_is_found_out():
    estimator = linear(design())
    unstable = replace(estimator, A_c=estimator.A_c + 1e3 * np.eye(len(estimator.A_c)))
    with pytest.raises(ArithmeticError, match="too long for an unstable estimator"):
        unstable.discretize(1.0)
    discrete = unstable.discretize(0.1)
    with pytest.raises(ArithmeticError, match="left the range"):
        discrete.run(np.ones((100, 2)))
    assert discrete.samples == 0 and not discrete.state.any()
    with pytest.raises(ArithmeticError, match="left the range"):
        for _ in range(100):  # sample by sample, the last good state stays
            before = discrete.state
            discrete.step([1.0, 1.0])
    assert_array_equal(discrete.state, before)
    assert np.isfinite(before).all() and 0 < discrete.samples < 100


def test_nonlinearities_keep_their_places():
    """The second of two copies is the one that is left when the first has no effect."""
    estimator = design()
    B_c = estimator.B_c.copy()
    B_c[:, estimator.plant.system.l] = 0.0
    half = replace(estimator, B_c=B_c)
    y, reference = record(12), record(12, seed=1)
    found = held(half, 1e-3).run(
        np.repeat(y, 200, axis=0), reference=np.repeat(reference, 200, axis=0)
    )
    expected = solved(half, 0.2, y, reference) @ half.C_a.T
    assert_allclose(found[199::200], expected, atol=1e-5)
    assert isinstance(half.plant.system.nonlinearities[0], Nonlinearity)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy])
@pytest.mark.parametrize("delay", ["exact", "model"])
def test_a_copy_has_a_state_of_its_own(copied, delay):
    estimator = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    first, alone = (estimator.discretize(1e-7, delay=delay) for _ in range(2))
    first.run([1.0, 2.0])
    alone.run([1.0, 2.0])
    second = copied(first)
    first.run([100.0] * 5)
    assert second.samples == 2
    assert_array_equal(second.run([1.0]), alone.run([1.0]))
