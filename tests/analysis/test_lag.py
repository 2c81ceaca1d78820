"""Lag and order: against grids, the exact optimum, and what a target means."""

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_allclose

from robsmooth import (
    InfeasibleDesignError,
    UncertainSystem,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
)
from robsmooth.analysis.covariance import worst_case
from robsmooth.analysis.lag import best_lag, choose_lag, lag_sweep
from robsmooth.estimators import baselines
from robsmooth.estimators.baselines import optimal_fixed_lag_error, optimal_two_sided_error
from tests.helpers.strategies import random_system, seeds

EXAMPLE = homodyne.PAPER.uncertain_system()
LAG = 3.1e-6
FILTERING = optimal_fixed_lag_error(EXAMPLE, 0.0)[0, 0]
TWO_SIDED = optimal_two_sided_error(EXAMPLE)[0, 0]


def classical_error(system, delay, order):
    smoother = baselines.fixed_lag_smoother(system, delay, order, copies=True)
    return np.trace(error_covariance(smoother, smoother.plant.structured_delta(), loop="real"))


def near_infimum(system, delay, order):
    """The robust smoother of the example, at multipliers near the best."""
    return design_smoother(augment(system, delay, order), 1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6])


def test_sweep_has_the_errors_of_the_designs():
    delays, orders = (0.0, 1e-6, LAG), (1, 2)
    sweep = lag_sweep(EXAMPLE, delays, orders)
    for i, order in enumerate(orders):
        for j, delay in enumerate(delays):
            smoother = baselines.fixed_lag_smoother(EXAMPLE, delay, order, copies=True)
            assert_allclose(sweep.nominal[i, j], classical_error(EXAMPLE, delay, order), rtol=1e-9)
            edge = smoother.plant.structured_delta((), [-1.0])
            error = error_covariance(smoother, edge, loop="real")[0, 0]
            assert_allclose(sweep.worst[i, j], error, rtol=1e-9)
    optimal = [optimal_fixed_lag_error(EXAMPLE, delay)[0, 0] for delay in delays]
    assert_allclose(sweep.optimal, optimal)
    assert_allclose(sweep.nominal[:, 0], FILTERING, rtol=1e-9)
    least = f"{sweep.nominal[1, 2]:.5g}"
    assert repr(sweep) == f"LagSweep(2 orders x 3 lags, least nominal error {least})"


@settings(max_examples=3)
@given(seeds)
def test_no_design_beats_the_exact_optimum_and_high_orders_come_near_it(seed):
    system = random_system(np.random.default_rng(seed), n=2, m=2, measurements=2, g=1)
    delay = 1.0 / np.abs(baselines.kalman_bucy(system).poles).max()
    sweep = lag_sweep(system, [delay], [1, 2])
    assert (sweep.nominal >= sweep.optimal * (1 - 1e-9)).all()
    assert (sweep.worst >= sweep.nominal).all()
    (optimal,) = sweep.optimal
    # of a rough signal, the rest is in inverse proportion to the order
    rest = [classical_error(system, delay, order) - optimal for order in (6, 12, 24)]
    assert rest[0] < 0.15 * optimal
    assert rest[1] < 0.6 * rest[0] + 1e-9 * optimal
    assert rest[2] < 0.6 * rest[1] + 1e-9 * optimal
    ends = optimal_two_sided_error(system), optimal_fixed_lag_error(system, 0.0)
    assert np.trace(ends[0]) < optimal < np.trace(ends[1])


def test_a_lag_that_is_too_long_for_its_order_is_worse_than_none():
    sweep = lag_sweep(EXAMPLE, [LAG, 1e-4], [2])
    assert sweep.nominal[0, 0] < FILTERING < sweep.nominal[0, 1]


def test_sweep_of_any_design():
    sweep = lag_sweep(EXAMPLE, [1e-6, LAG], [1, 2], near_infimum)
    worst = worst_case(near_infimum(EXAMPLE, LAG, 2), loop="real")
    assert (sweep.nominal[1, 1], sweep.worst[1, 1]) == (worst.nominal, worst.mean_square)


@pytest.mark.parametrize("order", [1, 2])
def test_best_lag_is_that_of_a_fine_grid(order):
    best, error = best_lag(EXAMPLE, order)
    lags = np.geomspace(best / 3, 3 * best, 41)
    errors = lag_sweep(EXAMPLE, lags, [order]).nominal[0]
    assert error <= errors.min() * (1 + 1e-7)
    assert_allclose(errors[20], error, rtol=1e-9)
    assert errors.argmin() in (19, 20, 21)


def test_best_lag_is_none_where_the_model_of_the_delay_is_worse_than_the_filter():
    # two signals nearly cancel: what is left is too fast for a model of order one
    A, B1 = [[0, -1], [1, -0.5]], np.array([[-2, 0], [1, 0]]) / 8**0.5
    system = UncertainSystem(A, B1, [[1, 0]], [[-1, 1]], [[0, 1e-4]])
    lag, error = best_lag(system, 1)
    filtering = np.trace(optimal_fixed_lag_error(system, 0.0))
    assert lag == 0.0
    assert_allclose(error, filtering, rtol=1e-6)


def test_best_lag_grows_and_its_error_falls_with_the_order():
    found = [best_lag(EXAMPLE, order) for order in (1, 2, 3, 4, 6)]
    for (shorter, error), (longer, lower) in pairwise(found):
        assert shorter < longer
        assert error > lower > TWO_SIDED
    # the paper's lag is shorter than the best one for its order, and loses little by it
    assert LAG < found[1][0] < 1.5 * LAG
    assert classical_error(EXAMPLE, LAG, 2) < 1.02 * found[1][1]


@pytest.mark.parametrize("fraction", [0.1, 0.5, 0.9, 0.99])
def test_choice_meets_the_target_and_nothing_shorter_or_simpler_does(fraction):
    choice = choose_lag(EXAMPLE, fraction=fraction)
    assert_allclose(choice.target, FILTERING - fraction * (FILTERING - TWO_SIDED))
    assert_allclose(choice.error, classical_error(EXAMPLE, choice.lag, choice.order))
    assert choice.error <= choice.target * (1 + 1e-9)
    earlier = np.linspace(0.0, 0.999 * choice.lag, 9)
    assert all(classical_error(EXAMPLE, lag, choice.order) > choice.target for lag in earlier)
    for order in range(1, choice.order):
        assert best_lag(EXAMPLE, order)[1] > choice.target


def test_target_and_fraction_are_two_ways_to_say_the_same():
    by_fraction = choose_lag(EXAMPLE, fraction=0.8)
    by_target = choose_lag(EXAMPLE, by_fraction.target)
    assert by_target == by_fraction


def test_filter_is_chosen_where_it_meets_the_target():
    choice = choose_lag(EXAMPLE, 1.01 * FILTERING)
    assert (choice.lag, choice.order) == (0.0, 0)
    assert_allclose(choice.error, FILTERING)


@settings(max_examples=5)
@given(seeds)
def test_choice_for_random_systems_meets_the_target(seed):
    system = random_system(np.random.default_rng(seed), n=2, m=2, measurements=2, g=1)
    try:
        choice = choose_lag(system, fraction=0.7)
    except InfeasibleDesignError:
        low = optimal_fixed_lag_error(system, 0.0), optimal_two_sided_error(system)
        target = np.trace(0.3 * low[0] + 0.7 * low[1])
        assert best_lag(system, 8)[1] > target
        return
    assert classical_error(system, choice.lag, choice.order) <= choice.target * (1 + 1e-9)
    assert classical_error(system, 0.99 * choice.lag, choice.order) > choice.target


def test_choice_does_not_depend_on_the_unit_of_time():
    unit = 2.0**20
    slow = replace(
        EXAMPLE,
        A=EXAMPLE.A / unit,
        B1=EXAMPLE.B1 / unit**0.5,
        D21=EXAMPLE.D21 * unit**0.5,
        uncertainties=[],
        nonlinearities=[],
    )
    fast = replace(EXAMPLE, uncertainties=[], nonlinearities=[])
    here, there = (choose_lag(system, fraction=0.9) for system in (fast, slow))
    assert here.order == there.order
    assert_allclose(there.lag / unit, here.lag, rtol=1e-9)
    assert_allclose(there.error, here.error, rtol=1e-9)


def test_what_cannot_be_met_is_refused():
    with pytest.raises(ValueError, match=r"target must be above 0\.0430209, .* got 0\.04; filt"):
        choose_lag(EXAMPLE, 0.04)
    with pytest.raises(InfeasibleDesignError, match=r"no order up to 8 .* is 0\.043\d+$"):
        choose_lag(EXAMPLE, fraction=0.9999)
    blind = UncertainSystem([[-1.0]], [[1.0, 0.0]], [[1.0]], [[0.0]], [[0.0, 1.0]])
    with pytest.raises(InfeasibleDesignError, match=r"Smoothing fails: it gains nothing: .* 0\.5 "):
        best_lag(blind, 1)


def test_what_is_not_understood_is_refused():
    with pytest.raises(TypeError, match="system must be an UncertainSystem, got str"):
        lag_sweep("system", [1e-6], [1])
    with pytest.raises(ValueError, match="lags must be finite and in"):
        lag_sweep(EXAMPLE, [-1e-6], [1])
    with pytest.raises(ValueError, match="orders must be an integer of at least 1, got 0"):
        lag_sweep(EXAMPLE, [1e-6], [0])
    with pytest.raises(ValueError, match="lags must have at least one value"):
        lag_sweep(EXAMPLE, [], [1])
    with pytest.raises(TypeError, match="design must be a function of system"):
        lag_sweep(EXAMPLE, [1e-6], [1], "robust")
    with pytest.raises(TypeError, match=r"design must .*takes 1 positional argument but"):
        lag_sweep(EXAMPLE, [1e-6], [1], lambda system: system)
    with pytest.raises(TypeError, match=r"design must .*must be an Estimator, got NoneType"):
        lag_sweep(EXAMPLE, [1e-6], [1], lambda *_: None)
    for function in (partial(best_lag, order=1), partial(choose_lag, target=0.05)):
        with pytest.raises(TypeError, match="system must be an UncertainSystem, got str"):
            function("system")
    with pytest.raises(ValueError, match="order must be an integer of at least 1"):
        best_lag(EXAMPLE, 0)
    for both in ({}, {"target": 0.05, "fraction": 0.5}):
        with pytest.raises(ValueError, match="takes either a target or a fraction"):
            choose_lag(EXAMPLE, **both)
    with pytest.raises(ValueError, match="fraction must be finite and in"):
        choose_lag(EXAMPLE, fraction=1.0)
    with pytest.raises(ValueError, match="target must be finite and in"):
        choose_lag(EXAMPLE, math.nan)
