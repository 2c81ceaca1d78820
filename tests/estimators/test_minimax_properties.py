"""The least certified error, of random systems: no candidate below, no attack above it, limits."""

from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import robsmooth as rs
from tests.helpers.attacks import all_pass_error, switching_error
from tests.helpers.certificates import against_the_model, certified
from tests.helpers.observers import Observers
from tests.helpers.strategies import admissible_delta, random_system, seeds
from tests.helpers.systems import DRIVE, cancelling, classical, resonance


@st.composite
def plants(draw, max_size=0.3, max_outputs=1):
    rng = np.random.default_rng(draw(seeds))
    g, size = draw(st.integers(0, 1)), draw(st.floats(0.02, max_size))
    m, measurements = (draw(st.integers(1, max_outputs)) for _ in range(2))
    system = random_system(rng, draw(st.integers(1, 3)), m, measurements, g, size)
    if g:  # as a detector's: in the measurement
        channel = system.nonlinearities[0]
        system = replace(system, nonlinearities=[replace(channel, B=np.zeros_like(channel.B))])
    return rs.augment(system, draw(st.floats(0.1, 1.0)), draw(st.integers(0, 3)))


def minimax(plant):
    """The minimax smoother, or None where none has a guarantee."""
    with suppress(rs.InfeasibleDesignError):
        return rs.minimax_smoother(plant)


@settings(max_examples=4)
@given(plants(max_size=0.15))
def test_no_candidate_is_certified_lower(plant):
    smoother = minimax(plant)
    designs = [partial(classical, plant, copies) for copies in (False, True)]
    designs += [
        partial(rs.minimize_bound, plant, cost, starts=1) for cost in ("filtered", "smoothed")
    ]
    designs.append(partial(rs.baselines.tuned_fixed_lag_smoother, plant, "admissible"))
    designs.append(partial(rs.constant_minimax_smoother, plant))
    least = smoother.certified if smoother else np.inf
    for design in designs:
        with suppress(rs.InfeasibleDesignError):
            assert least <= certified(design()) * (1.0 + 1e-6)


@pytest.mark.parametrize("seed", [0, 12, 351])  # of few multipliers, nearly infeasible
def test_what_the_design_certifies_is_certified_by_the_analysis_also_against_the_true_delay(seed):
    rng = np.random.default_rng(1000 + seed)
    rng.random()
    n = int(rng.integers(1, 4))
    system = random_system(rng, n, g=0, size=rng.uniform(0.02, 0.6))
    smoother = rs.minimax_smoother(
        rs.augment(system, rng.uniform(0.1, 1.0), int(rng.integers(0, 3)))
    )
    assert_allclose(certified(smoother), smoother.certified, rtol=1e-5)
    assert np.isfinite(rs.judge(smoother).certified)


@settings(max_examples=12)
@given(plants(), seeds)
def test_no_attack_is_above_what_is_certified(plant, seed):
    smoother = minimax(plant)
    if smoother is None:
        return
    rng = np.random.default_rng(seed)
    worst = rs.worst_case(smoother, "guaranteed", "real")
    found = [worst.mean_square]
    for Delta in (worst.Delta, *(admissible_delta(rng, plant) for _ in range(4))):
        found.append(rs.error_covariance(smoother, Delta, "guaranteed", loop="real").trace())
        for rate in np.geomspace(0.03, 30.0, 7):
            found += [all_pass_error(smoother, sign * Delta, rate) for sign in (1.0, -1.0)]
            for other in (-Delta, worst.Delta, admissible_delta(rng, plant)):
                found.append(switching_error(smoother, (Delta, other), 1.0 / rate))
    assert max(found) <= smoother.certified * (1.0 + 1e-9)


def test_uncertainty_in_step_with_a_resonance_is_worse_than_every_constant():
    """So the attacks above are more than another search for the worst constant."""
    smoother = rs.minimax_smoother(rs.augment(resonance(0.06, 10.0), 0.5, 2))
    worst = rs.worst_case(smoother, "guaranteed", "real")
    switched = switching_error(smoother, (worst.Delta, -worst.Delta), np.pi / 2.0)
    passed = max(all_pass_error(smoother, sign * worst.Delta, 1.0) for sign in (1.0, -1.0))
    assert 1.03 * worst.mean_square < switched <= smoother.certified
    assert 1.5 * worst.mean_square < passed <= smoother.certified


@pytest.mark.parametrize("dwell", [1e-5, 1e5])
def test_fast_switching_is_the_mean_uncertainty_and_slow_switching_has_the_mean_error(dwell):
    smoother = rs.minimax_smoother(rs.augment(cancelling(DRIVE), 1.0, 2))
    Deltas = [smoother.plant.structured_delta([value]) for value in (1.0, 0.0, 0.0)]
    fast = [smoother.plant.structured_delta([1.0 / 3.0])]
    constant = [
        rs.error_covariance(smoother, Delta, "guaranteed", loop="real").trace()
        for Delta in (fast if dwell < 1.0 else Deltas)
    ]
    assert_allclose(switching_error(smoother, Deltas, dwell), np.mean(constant), rtol=1e-5)


@settings(max_examples=10)
@given(plants(max_size=0.1, max_outputs=2))
def test_a_search_over_observers_of_the_worst_plant_ends_at_the_same_error(plant):
    smoother = minimax(plant)
    certified = smoother.certified if smoother else np.inf
    assert_allclose(Observers(plant).least_error(), certified, rtol=1e-5)


@settings(max_examples=12)
@given(st.integers(1, 3), st.integers(1, 2), st.integers(1, 2), st.integers(0, 3), seeds)
def test_without_uncertainty_it_is_the_kalman_filter_and_the_classical_smoother(
    n, m, measurements, order, seed
):
    system = random_system(np.random.default_rng(seed), n, m, measurements, g=0)
    plant = rs.augment(replace(system, uncertainties=()), 0.5, order)
    for output in ("smoothed", "filtered"):
        smoother = rs.minimax_smoother(plant, output)
        optimal = against_the_model(classical(plant, copies=False), output)
        nothing = np.zeros((0, 0))
        error = rs.error_covariance(optimal, nothing, "guaranteed", loop="real").trace()
        assert_allclose(smoother.certified, error, rtol=1e-6)
        # the optimum is a minimum: what differs from it by a root of that has the same error
        omega = np.geomspace(0.1, 10.0, 15)
        ours, theirs = (frequency_response(each, omega) for each in (smoother, optimal))
        assert np.abs(ours - theirs).max() < 1e-2 * np.abs(theirs).max()


def frequency_response(estimator, omega):
    """Of w-hat to the measurement."""
    m, l = estimator.plant.system.m, estimator.plant.system.l  # noqa: E741
    resolvents = np.linalg.inv(
        1j * omega[:, None, None] * np.eye(len(estimator.A_c)) - estimator.A_c
    )
    return estimator.C_c[:m] @ resolvents @ estimator.B_c[:, :l]
