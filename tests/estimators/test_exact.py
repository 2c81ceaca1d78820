"""The exact smoother of a record: against conditioning, the textbook's recursion, simulation."""

import copy
import math
import os
import pickle
import subprocess
import sys
from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.linalg import block_diag, expm

import robsmooth as rs
from robsmooth._numerics.lyapunov import covariances
from robsmooth.estimators import baselines
from tests.helpers.records import conditioned, in_samples, rauch_tung_striebel, simulated
from tests.helpers.strategies import seeds
from tests.helpers.systems import in_other_units

# samples of any length, beside any delay
pytestmark = pytest.mark.filterwarnings("ignore::robsmooth.LongStepWarning")

SIGMAS = 4.5  # a correct program is further off once in 150 000 times, were the seeds free
DT = 0.1
WALK = rs.UncertainSystem([[0]], [[1, 0]], [[1]], [[1]], [[0, 1]])
PAIR = rs.UncertainSystem(
    A=[[-1.0, 0.5], [0.0, -2.0]],
    B1=[[1.0, 0.0, 0.2, 0.0], [0.3, 1.0, 0.0, 0.0]],
    C0=[[1.0, 0.0], [1.0, 1.0]],
    C2=[[1.0, 1.0], [0.0, 1.0]],
    D21=[[0.1, 0.0, 0.4, 0.0], [0.1, 0.0, 0.0, 0.3]],
)


def exact(system, delay, dt=DT, **options):
    return baselines.fixed_lag_smoother(system, delay, 2).discretize(dt, **options)


def random_plant(seed):
    """A detectable system with eigenvalues left of, on and right of the axis, and two outputs."""
    rng = np.random.default_rng(seed)
    integrators = [[0.0]], [[0.0, 1.0], [0.0, 0.0]]
    blocks = [integrators[rng.integers(2)], [[0.0, 2.0], [-2.0, 0.0]], [[0.4]], [[-0.7]]]
    A = block_diag(*(blocks[i] for i in rng.permutation(4)[: rng.integers(1, 3)]))
    n, l = len(A), rng.integers(1, 3)  # noqa: E741
    noise = np.hstack([rng.standard_normal((l, n)), np.diag(rng.uniform(0.2, 1.0, l))])
    B1 = np.hstack([rng.standard_normal((n, n)), np.zeros((n, l))])
    C0, C2 = rng.standard_normal((2, n)), rng.standard_normal((l, n))
    return rs.UncertainSystem(A, B1, C0, C2, noise), rng


def with_gaps(y, rng, share=0.2):
    y = y.copy()
    y[rng.random(y.shape) < share] = np.nan
    return y


# --- what is estimated ---------------------------------------------------------------------------


@settings(max_examples=30)
@given(seeds, st.sampled_from([(0, 1), (1, 1), (6, 2), (5, 2), (1, 4), (13, 5)]))
def test_estimates_are_means_given_the_samples_whatever_the_delay(seed, parts_of_a_sample):
    count, parts = parts_of_a_sample
    system, rng = random_plant(seed)
    delay, covariance = count / parts * DT, np.diag(rng.uniform(0.5, 2.0, system.n))
    y = with_gaps(rng.standard_normal((15, system.l)), rng)
    y[4:8] = np.nan
    discrete = exact(system, delay)
    discrete.reset(np.zeros(system.n), covariance=covariance)
    found = discrete.run(y, return_std=True)
    expected = conditioned(system, DT, y, delay, covariance, parts)
    for one, other in zip(found, expected, strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.nanmax(np.abs(other)))


@settings(max_examples=30)
@given(seeds, st.integers(0, 9), st.booleans())
def test_samples_may_have_any_lengths_and_be_of_instants(seed, parts_of_the_delay, instants):
    system, rng = random_plant(seed)
    delay, covariance = parts_of_the_delay / 4 * DT, np.diag(rng.uniform(0.5, 2.0, system.n))
    counts = rng.integers(1, 6, 15)
    y = with_gaps(rng.standard_normal((15, system.l)), rng)
    discrete = exact(system, delay, samples="instants" if instants else "means")
    discrete.reset(np.zeros(system.n), covariance=covariance)
    found, now = [], []
    for rows in np.split(np.arange(15), [rng.integers(1, 15)]):
        found.append(discrete.run(y[rows], intervals=counts[rows] * DT / 4, return_std=True))
        now.append([discrete.smoothed, discrete.filtered])
        assert_allclose(now[-1][0], found[-1][0][-1], rtol=1e-9)
    expected = conditioned(system, DT, y, delay, covariance, 4, counts=counts, instants=instants)
    for one, other in zip(np.concatenate(found, axis=1), expected, strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.nanmax(np.abs(other), initial=0.0))
    discrete.reset(np.zeros(system.n), covariance=covariance)
    found = discrete.two_sided(y, intervals=counts * DT / 4)
    expected = conditioned(
        system, DT, y, 0.0, covariance, 4, whole=True, counts=counts, instants=instants
    )
    for one, other in zip(found, expected, strict=True):
        assert_allclose(one, other, rtol=1e-8, atol=1e-8 * np.abs(other).max())


@settings(max_examples=30)
@given(seeds)
def test_two_sided_estimates_are_those_of_rauch_tung_and_striebel(seed):
    system, rng = random_plant(seed)
    covariance = np.diag(rng.uniform(0.5, 2.0, system.n))
    y = with_gaps(rng.standard_normal((60, system.l)), rng)
    discrete = exact(system, 0.25)
    discrete.reset(np.zeros(system.n), covariance=covariance)
    means, P = rauch_tung_striebel(system, DT, y, covariance)
    expected = means @ system.C0.T, np.sqrt(np.diagonal(system.C0 @ P @ system.C0.T, 0, 1, 2))
    for one, other in zip(discrete.two_sided(y), expected, strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())
    assert discrete.samples == 0
    assert_array_equal(discrete.two_sided(y)[0][-1], discrete.run(y, output="filtered")[-1])


def test_a_record_of_a_stable_system_begins_with_its_stationary_covariance():
    y = np.random.default_rng(1).standard_normal((20, 2))
    P = covariances(PAIR.A, PAIR.B1).stationary
    w, deviations = exact(PAIR, 0.3).run(y, return_std=True)
    expected = conditioned(PAIR, DT, y, 0.3, P)
    assert_allclose(w[2:], expected[0, 2:], atol=1e-12)
    assert_allclose(deviations[2:], expected[1, 2:], atol=1e-12)
    # before the record its model is all that is known, and what the samples tell backward
    prior = np.sqrt(np.diag(PAIR.C0 @ P @ PAIR.C0.T))
    assert (deviations[:2] < prior).all() and (deviations[:2] > expected[1, 3]).all()
    assert np.isfinite(w[:2]).all()


@pytest.mark.parametrize("start", [5.0, -1e9])
@pytest.mark.parametrize("system", [WALK, rs.examples.clock()])
def test_a_drift_begins_where_the_record_does(system, start):
    y = np.random.default_rng(2).standard_normal((200, 1))
    plain, deviations = exact(system, 0.2).run(y, return_std=True)
    w, again = exact(system, 0.2).run(y + start, return_std=True)
    unknown = 2 if system is WALK else 3  # rows: one sample tells a phase, two a frequency
    assert (np.isnan(w[:, 0]) == (np.arange(200) < unknown)).all()
    assert_allclose(w - start, plain, atol=1e-7 * deviations[-1, 0] * max(1.0, abs(start) / 1e8))
    assert_array_equal(again, deviations)


@settings(max_examples=20)
@given(seeds)
def test_what_is_not_known_at_the_start_is_least_squares(seed):
    system, rng = random_plant(seed)
    assume(np.linalg.eigvals(system.A).real.min() > -1e-6)  # nothing is known of any mode
    y, offset = rng.standard_normal((25, system.l)), 1e3 * rng.standard_normal(system.n)
    through, _ = in_samples(system, DT)
    x, path, responses = offset, [], []
    for _ in y:
        end = through @ x
        x = end[: system.n]
        path.append(system.C0 @ x)
        responses.append(end[system.n :] / DT)
    discrete = exact(system, 0.0)
    found, deviations = discrete.two_sided(y)
    expected = conditioned(system, DT, y, 0.0, None, whole=True)
    known = np.isfinite(found[:, 0])
    assert known[-15:].all()
    assert_allclose(deviations[known], expected[1, known], rtol=1e-6)
    assert_allclose(found[known], expected[0, known], atol=1e-6 * np.nanmax(deviations))
    moved, _ = discrete.two_sided(y + np.array(responses))
    assert_allclose((moved - found - path)[known] / np.abs(path).max(), 0.0, atol=1e-7)


def test_error_bars_of_one_output_are_not_those_of_the_other():
    y = np.random.default_rng(17).standard_normal((300, 1))
    discrete = exact(WALK, 2.0)
    discrete.run(y, return_std=True)
    found = discrete.run(y, output="filtered", return_std=True)[1]
    assert_allclose(found[-1], exact(WALK, 2.0).run(y, output="filtered", return_std=True)[1][-1])


def test_what_a_long_gap_of_an_unstable_system_loses_is_not_given():
    growing = rs.UncertainSystem([[1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 1.0]])
    y = np.random.default_rng(18).standard_normal((300, 1))
    y[20:220] = np.nan
    discrete = exact(growing, 0.5)
    discrete.reset([0.0], covariance=[[1.0]])
    w, deviations = discrete.two_sided(y)
    assert_allclose(
        deviations[:20], discrete.two_sided(np.delete(y, np.s_[60:200], 0))[1][:20], rtol=1e-5
    )
    lost = np.isnan(deviations[:, 0])
    assert_array_equal(lost, np.isnan(w[:, 0]))
    assert lost[160:219].all() and not lost[:120].any() and not lost[221:].any()
    assert (deviations[~lost] > 0.0).all()


def test_a_stiff_stable_system_is_stationary():
    rate = 1e9
    stiff = rs.UncertainSystem(
        np.diag([-rate, -1.0]),
        [[(2 * rate) ** 0.5, 0, 0], [0, 2**0.5, 0]],
        [[0, 1]],
        [[1, 1]],
        [[0, 0, 0.1]],
    )
    deviations = exact(stiff, 0.02, 0.01).run(np.full((5, 1), np.nan), return_std=True)[1]
    assert_allclose(deviations, 1.0, rtol=1e-6)


def test_a_loop_begins_in_lock():
    loop = replace(rs.homodyne.PAPER, lam=0.0).uncertain_system()
    discrete = baselines.kalman_bucy(loop, copies=True).discretize(2e-8)
    w, deviations = discrete.run(np.zeros((50, 1)), output="filtered", return_std=True)
    assert_allclose(w, 0.0, atol=1e-12)
    assert_allclose(deviations, deviations[0, 0], rtol=0.05)


def test_a_known_start_is_used():
    discrete = exact(WALK, 0.2)
    discrete.reset([5.0], covariance=[[1e-6]])
    w, deviations = discrete.run(np.zeros((30, 1)), return_std=True)
    assert w[1, 0] == pytest.approx(5.0, abs=1e-4)
    assert deviations[1, 0] == pytest.approx(1e-3, rel=1e-3)
    assert (np.diff(w[1:, 0]) < 0.0).all()


def test_where_a_delay_model_fails_the_exact_smoother_has_the_optimal_error():
    a, d = 1.0, 0.02
    rough = rs.UncertainSystem(
        A=[[-a, 0.0], [0.0, -1.02 * a]],
        B1=[[1.0, 0.0], [1.0, 0.0]],
        C0=[[1.0, -1.0]],
        C2=[[1.0, -1.0]],
        D21=[[0.0, d]],
    )
    delay, dt = 0.1, 1e-3
    deviation = exact(rough, delay, dt).run(np.zeros((40_000, 1)), return_std=True)[1][-1, 0]
    optimum = baselines.optimal_fixed_lag_error(rough, delay)[0, 0]
    assert deviation**2 == pytest.approx(optimum, rel=1e-3)


def test_what_the_delay_needs_is_kept_while_filtered_estimates_are_read():
    y = np.random.default_rng(24).standard_normal((60, 2))
    lengths = np.full(60, DT / 5)  # more samples are in the delay than of dt
    whole = exact(PAIR, 0.3).run(y, intervals=lengths)
    discrete = exact(PAIR, 0.3)
    discrete.run(y[:40], intervals=lengths[:40], output="filtered")
    assert_allclose(discrete.smoothed, whole[39], atol=1e-13)
    assert_allclose(discrete.run(y[40:], intervals=lengths[40:]), whole[40:], atol=1e-13)


def test_a_call_with_lengths_that_fails_leaves_no_trace():
    rows = np.random.default_rng(25).standard_normal((20, 1))
    plain, tried = (exact(WALK, 0.25) for _ in range(2))
    with pytest.raises(ArithmeticError, match="left the range"):
        y = np.zeros((5000, 1))
        y[-2:] = [[1.7e308], [-1.7e308]]  # in the second piece of those that are taken at a time
        tried.run(y, intervals=np.full(5000, DT))
    assert_array_equal(tried.run(rows), plain.run(rows))
    assert_allclose(tried.times(2), plain.times(2))


@pytest.mark.parametrize("delay", [0.3, 0.25])
def test_lengths_of_dt_change_nothing(delay):
    y = with_gaps(np.random.default_rng(22).standard_normal((40, 2)), np.random.default_rng(4))
    plain, told = exact(PAIR, delay), exact(PAIR, delay)
    expected = plain.run(y)
    assert_allclose(told.run(y[:20], intervals=np.full(20, DT)), expected[:20], atol=1e-13)
    assert_allclose(told.run(y[20:30]), expected[20:30], atol=1e-13)
    assert_allclose([told.step(row) for row in y[30:]], expected[30:], atol=1e-13)


# --- error bars ----------------------------------------------------------------------------------


@pytest.mark.parametrize("system", [PAIR, WALK, rs.examples.resonant_phase()])
def test_errors_are_as_large_as_their_bars(system):
    rate = np.abs(baselines.kalman_bucy(system).poles).max()
    dt, rows, rng = 0.3 / rate, 30, np.random.default_rng(5)
    discrete, squares = exact(system, 2.5 * dt, dt), []
    covariance = np.eye(system.n) if system is WALK else covariances(system.A, system.B1).stationary
    runs = 300
    for _ in range(runs):
        start = np.linalg.cholesky(covariance) @ rng.standard_normal(system.n)
        y, x = simulated(system, dt, rows, rng, start)
        y[12:20] = np.nan
        discrete.reset(np.zeros(system.n), covariance=covariance)
        w, deviations = discrete.run(y, output="filtered", return_std=True)
        two_sided, narrow = discrete.two_sided(y)
        truth = x @ system.C0.T
        squares.append([((w - truth) / deviations) ** 2, ((two_sided - truth) / narrow) ** 2])
        assert (narrow <= deviations * (1.0 + 1e-9)).all()
    means = np.mean(squares, axis=0)  # each of chi-squared values, of variance 2
    assert np.abs(means - 1.0).max() < math.sqrt(2.0 / runs) * (SIGMAS + 1.0)  # of many
    assert (deviations[12:20, 0] > deviations[11, 0]).all()  # in the gap


# --- what is known besides -----------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0.3, 0.25, 0.0])
def test_known_inputs_move_the_estimates_as_they_move_the_system(delay):
    driven = replace(PAIR, B2=[[1.0, 0.0], [0.5, 2.0]], D22=[[0.0, 0.3], [1.0, 0.0]])
    rng = np.random.default_rng(6)
    y, u = rng.standard_normal((50, 2)), rng.standard_normal((50, 2))
    fine, x, moved, added = 20, np.zeros(2), [np.zeros(2)], []
    step = expm(DT / fine * np.block([[driven.A, driven.B2], [np.zeros((2, 4))]]))
    for row in u:  # the response, by a fine grid
        means = []
        for _ in range(fine):
            end = step @ np.concatenate([x, row])
            means.append((x + end[:2]) / 2)
            x = end[:2]
            moved.append(x)
        added.append(driven.C2 @ np.mean(means, axis=0) + driven.D22 @ row)
    at = np.arange(1, 51) * fine - round(delay / DT * fine)
    response = np.where(at[:, None] >= 0, np.array(moved)[np.maximum(at, 0)] @ driven.C0.T, 0.0)
    found = exact(driven, delay).run(y + added, inputs=u)
    assert_allclose(found, exact(PAIR, delay).run(y) + response, atol=2e-3)
    assert_allclose(exact(driven, delay).run(y, inputs=0.0 * u), exact(PAIR, delay).run(y))
    with pytest.raises(ValueError, match="inputs must be given: the system has 2"):
        exact(driven, delay).run(y)
    with pytest.raises(ValueError, match="a system with known inputs is for an exact smoother"):
        baselines.kalman_bucy(driven).discretize(DT, delay="model")


def test_a_mean_and_an_offset_are_taken_off_and_put_back():
    y, mean, offset = np.random.default_rng(7).standard_normal((60, 2)), [3.0, -2.0], [10.0, 0.5]
    shifted = y + PAIR.C2 @ mean + offset
    estimator = baselines.fixed_lag_smoother(PAIR, 0.25, 2)
    for delay in ("exact", "model"):
        discrete = estimator.discretize(DT, delay=delay, mean=mean, offset=offset)
        plain = estimator.discretize(DT, delay=delay)
        assert_allclose(discrete.run(shifted), plain.run(y) + PAIR.C0 @ mean, atol=1e-12)
        assert_allclose(discrete.smoothed, plain.smoothed + PAIR.C0 @ mean, atol=1e-12)
    discrete = estimator.discretize(DT, mean=mean, offset=offset)
    found, deviations = discrete.two_sided(shifted)
    expected = estimator.discretize(DT).two_sided(y)
    assert_allclose(found, expected[0] + PAIR.C0 @ mean)
    assert_allclose(deviations, expected[1])
    discrete.reset([3.0, -2.0], covariance=np.eye(2))
    assert_allclose(discrete.state, mean)


# --- robust designs, nonlinearities --------------------------------------------------------------


def test_a_tuned_smoother_filters_as_its_own_equations_do():
    drifting = rs.UncertainSystem(
        A=[[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]],
        B1=[[0.3, 0, 0, 0], [0, 0.2, 0, 0], [0, 0, 1, 0]],
        C0=[[1, 0, 1]],
        C2=[[1, 0, 1]],
        D21=[[0, 0, 0, 0.3]],
        uncertainties=[rs.Uncertainty([[0.2], [0], [1.0]], [[0, 0, 0.5]], [[0.1]])],
    )
    for against in ("constant", "admissible"):
        plant = rs.augment(drifting, 0.5, 4)
        tuned = baselines.tuned_fixed_lag_smoother(plant, against=against)
        y = np.random.default_rng(8).standard_normal((20_000, 1))
        found = tuned.discretize(1e-3).run(y, output="filtered")[10_000:]
        own = tuned.discretize(1e-3, delay="model").run(y, output="filtered")[10_000:]
        assert_allclose(found, own, atol=1e-3 * np.abs(own).max())


@numba.njit
def bend(v):
    return math.tanh(v)


PYTHONS = np.vectorize(math.tanh)  # numba cannot compile it


@pytest.mark.filterwarnings("ignore:numba cannot compile")
@pytest.mark.parametrize("function", [bend, np.tanh, PYTHONS])
def test_copies_act_as_in_continuous_time(function):
    channel = rs.Nonlinearity([[0.5], [1.0]], [[1.0, -0.5]], [[0.3], [0.2]], 1.0, function)
    system = replace(PAIR, nonlinearities=[channel])
    estimator = baselines.kalman_bucy(system, copies=True)
    y = 3.0 * np.repeat(np.random.default_rng(9).standard_normal((80, 2)), 50, axis=0)
    reference = np.repeat(np.random.default_rng(10).standard_normal((80, 1)), 50, axis=0)
    discrete = estimator.discretize(2e-3)
    assert discrete.compiled == (function is not PYTHONS)
    found = discrete.run(y, reference=reference)[3000:]
    own = estimator.discretize(2e-3, delay="model").run(y, reference=reference)[3000:]
    assert_allclose(found, own, atol=2e-3 * np.abs(own).max())
    lengths = np.random.default_rng(11).uniform(1e-3, 3e-3, 4000)
    for samples, intervals in (("means", lengths), ("instants", None)):
        given = {"reference": reference, "intervals": intervals, "output": "filtered"}
        found = estimator.discretize(2e-3, samples=samples).run(y, **given)[3000:]
        own = estimator.discretize(2e-3, delay="model").run(y, **given)[3000:]
        assert_allclose(found, own, atol=3e-3 * np.abs(own).max())


@pytest.mark.parametrize("delay", [0.034, 0.03])
def test_estimates_within_a_sample_move_with_copies_and_inputs(delay):
    channel = rs.Nonlinearity([[0.5], [1.0]], [[1.0, -0.5]], [[0.3], [0.2]], 1.0, bend)
    driven = replace(PAIR, B2=[[1.0], [0.0]], D22=[[0.0], [0.5]], nonlinearities=[channel])
    estimator = baselines.fixed_lag_smoother(driven, delay, 2, copies=True)
    rows = np.repeat(np.random.default_rng(23).standard_normal((20, 3)), 30, axis=0)
    coarse = estimator.discretize(1e-2).run(rows[:, :2], inputs=rows[:, 2:])
    rows = np.repeat(rows, 10, axis=0)
    fine = estimator.discretize(1e-3).run(rows[:, :2], inputs=rows[:, 2:])[9::10]
    assert_allclose(coarse[100:], fine[100:], atol=5e-3 * np.abs(fine).max())


def test_a_robust_design_runs_with_its_delay_model():
    plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    robust, classical = (
        rs.minimax_smoother(plant),
        baselines.fixed_lag_smoother(plant.system, 3.1e-6, 2),
    )
    assert not robust.discretize(1e-7).exact and classical.discretize(1e-7).exact
    with pytest.raises(ValueError, match="delay 'exact' is for classical and tuned designs"):
        robust.discretize(1e-7, delay="exact")
    changed = replace(classical, B_c=2.0 * classical.B_c)
    assert not changed.discretize(1e-7).exact  # it is no filter of the nominal system any more
    discrete = robust.discretize(1e-7)
    for call in (
        lambda: discrete.run([[0.0]], return_std=True),
        lambda: discrete.two_sided([[0.0]]),
        lambda: discrete.innovations([[0.0]]),
        lambda: discrete.reset([0.0], covariance=[[1.0]]),
    ):
        with pytest.raises(ValueError, match="is for an exact smoother"):
            call()


def test_more_samples_in_a_delay_than_can_be_kept_are_refused():
    estimator = baselines.fixed_lag_smoother(PAIR, 1.0, 2)
    with pytest.raises(ValueError, match="samples, too many to keep: take a longer dt"):
        estimator.discretize(1e-9)
    assert not estimator.discretize(1e-9, delay="model").exact


# --- records -------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0.0, 0.25, 0.7])
def test_a_record_in_pieces_is_as_one(delay):
    rng = np.random.default_rng(11)
    y = with_gaps(rng.standard_normal((200, 2)), rng)
    whole = np.stack(exact(PAIR, delay).run(y, return_std=True))
    discrete, parts = exact(PAIR, delay), []
    for piece in np.split(y, [1, 2, 30, 31, 150]):
        parts.append(discrete.run(piece, return_std=True))
        discrete = pickle.loads(pickle.dumps(discrete))
    assert_array_equal(np.concatenate(parts, axis=1), whole)
    discrete.reset()
    assert_array_equal([discrete.step(row) for row in y], whole[0])


@pytest.mark.filterwarnings("ignore:numba cannot compile")
@pytest.mark.parametrize("delay", ["exact", "model"])
@pytest.mark.parametrize("function", [bend, np.tanh, PYTHONS])
def test_a_copy_of_a_smoother_goes_on_as_it_does(delay, function):
    channel = rs.Nonlinearity([[0.5], [1.0]], [[1.0, -0.5]], [[0.3], [0.2]], 1.0, function)
    estimator = baselines.fixed_lag_smoother(
        replace(PAIR, nonlinearities=[channel]), 0.3, 2, copies=True
    )
    discrete = estimator.discretize(DT, delay=delay)
    discrete.run(np.ones((5, 2)))
    for again in (pickle.loads(pickle.dumps(discrete)), copy.deepcopy(discrete)):
        found = again.run(np.ones((3, 2)))
        assert_array_equal(found, copy.deepcopy(discrete).run(np.ones((3, 2))))


def test_it_runs_where_the_compiler_is_switched_off():
    program = """
import numpy as np, robsmooth as rs
channel = rs.Nonlinearity([[0.5]], [[1.0]], [[0.3]], 1.0, np.tanh)
system = rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 0.3]], nonlinearities=[channel])
for copies in (False, True):
    discrete = rs.baselines.kalman_bucy(system, copies=copies).discretize(0.1)
    print(discrete.run(np.ones((3, 1)), return_std=True)[0].ravel().round(6), discrete.compiled)
"""
    found = []
    for switch in ("0", "1"):
        environment = os.environ | {"NUMBA_DISABLE_JIT": switch}
        ended = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True
        )
        assert ended.stderr == ""
        found.append([line.partition("]")[0] for line in ended.stdout.splitlines()])
    assert found[0] == found[1] and len(found[0]) == 2


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda d: d.reset(covariance=[[1, 0.9], [0, 1]]), "covariance must be symmetric"),
        (lambda d: d.reset(covariance=[[1, 2], [2, 1]]), "covariance must be nonnegative definite"),
        (lambda d: d.run([[0, 0]], intervals=[0.1, 0.1]), "intervals must be the lengths of 1 int"),
        (lambda d: d.run([[0, 0]] * 2, intervals=[0.1, -0.1]), "rows in order of times"),
        (lambda d: d.step([0, 0], interval=0.0), "not below 1e-06 dt"),
        (lambda d: [d.step([0, 0], interval=0.2), d.times(1)], "rows had intervals of their own"),
        (
            lambda d: baselines.kalman_bucy(PAIR).discretize(1, delay="model", samples="instants"),
            "samples='instants' is for an exact smoother",
        ),
        (lambda d: replace(PAIR, D22=1.0), r"D22 must have 2 dimension"),
        (lambda d: replace(PAIR, B2=np.zeros((2, 1)), D22=np.zeros((2, 2))), "D22 must have shape"),
        (lambda d: replace(PAIR, D22=np.zeros((3, 1))), "D22 must have shape"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call(exact(PAIR, 0.3))


def test_singular_covariances_and_empty_records_are_right():
    rng = np.random.default_rng(19)
    discrete = exact(PAIR, 0.3)
    for _ in range(50):
        direction = 10.0 ** rng.uniform(-6, 6, 2) * rng.standard_normal(2)
        discrete.reset(np.zeros(2), covariance=np.outer(direction, direction))
        assert np.isfinite(discrete.run(np.ones((5, 2)), return_std=True)[1][3:]).all()
    assert discrete.run([]).shape == (0, 2)


def test_a_call_that_fails_leaves_the_state_as_it_was():
    discrete = exact(rs.UncertainSystem([[0.0]], [[1, 0]], [[1]], [[1e-3]], [[0, 1e-5]]), 0.3)
    discrete.run([[1.0]] * 5)
    before, estimate = discrete.state, discrete.smoothed
    with pytest.raises(ArithmeticError, match="left the range"):
        discrete.run([[1e308]] * 50)
    assert_array_equal(discrete.state, before)
    assert_array_equal(discrete.smoothed, estimate)
    assert discrete.samples == 5


def test_masked_samples_are_missing():
    y = np.random.default_rng(12).standard_normal((30, 2))
    mask = np.random.default_rng(13).random((30, 2)) < 0.3
    masked, missing = np.ma.array(y, mask=mask), np.where(mask, np.nan, y)
    estimator = baselines.fixed_lag_smoother(PAIR, 0.3, 2)
    for delay in ("exact", "model"):
        discrete = estimator.discretize(DT, delay=delay)
        expected = discrete.run(missing)
        discrete.reset()
        assert_array_equal(discrete.run(masked), expected)
        discrete.reset()
        assert_array_equal([discrete.step(row) for row in masked], expected)
    with pytest.raises(ValueError, match="A must have no masked entries"):
        rs.UncertainSystem(np.ma.array([[-1.0]], mask=True), [[1]], [[1]], [[1]], [[1]])


def test_nothing_depends_on_units():
    rng = np.random.default_rng(14)
    y = with_gaps(rng.standard_normal((60, 2)), rng)
    found = np.stack(exact(PAIR, 0.25).run(y, return_std=True))
    for time in (1e-9, 3e7):
        scaled = in_other_units(PAIR, time, [1e-9, 1e9], [1e3, 1e-3])
        again = exact(scaled, 0.25 / time, DT / time)
        units = scaled.D21[:, 2:].diagonal() / PAIR.D21[:, 2:].diagonal()
        other = np.stack(again.run(y * units * math.sqrt(time), return_std=True))
        assert_allclose(other, found, rtol=1e-9, atol=1e-9 * np.abs(found).max())


# --- innovations ---------------------------------------------------------------------------------


def test_innovations_of_a_record_of_the_model_are_white_and_of_variance_one():
    rng = np.random.default_rng(15)
    start = np.linalg.cholesky(covariances(PAIR.A, PAIR.B1).stationary) @ rng.standard_normal(2)
    y, _ = simulated(PAIR, DT, 20_000, rng, start)
    z = exact(PAIR, 0.0).innovations(with_gaps(y, rng, 0.1))
    z = np.where(np.isfinite(z), z, rng.standard_normal(z.shape))
    rows = len(z)
    for lag in range(4):
        product = z[lag:].T @ z[: rows - lag] / (rows - lag)
        expected = np.eye(2) if lag == 0 else np.zeros((2, 2))
        error = math.sqrt((2.0 if lag == 0 else 1.0) / rows)
        assert np.abs(product - expected).max() < (SIGMAS + 0.5) * error
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-5


def test_their_likelihood_is_that_of_the_record():
    y = np.random.default_rng(16).standard_normal((12, 2))
    z = exact(PAIR, 0.0).innovations(y)
    through, root = in_samples(PAIR, DT)
    P, total = covariances(PAIR.A, PAIR.B1).stationary, 2 + 12 * root.shape[1]
    x, rows = np.zeros((2, total)), []
    x[:, :2] = np.linalg.cholesky(P)
    for i in range(12):
        end = through @ x
        end[:, 2 + i * root.shape[1] : 2 + (i + 1) * root.shape[1]] += root
        x = end[:2]
        rows.append(end[2:] / DT)
    whole = np.vstack(rows)
    expected = y.ravel() @ np.linalg.solve(whole @ whole.T, y.ravel())
    assert (z**2).sum() == pytest.approx(expected, rel=1e-10)
