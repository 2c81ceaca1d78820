"""The tuned classical smoother: known values, never worse than untuned, limits, invariances."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import OptimizeResult

import robsmooth as rs
from robsmooth.estimators import tuned
from tests.helpers.certificates import certified
from tests.helpers.strategies import random_system, seeds
from tests.helpers.systems import (
    DRIVE,
    EXAMPLE,
    GAIN,
    cancelling,
    classical,
    driven,
    in_other_units,
    of_gain,
    referenced,
    worst,
)

AGAINST = ("constant", "admissible")
tuned_fixed_lag_smoother = rs.baselines.tuned_fixed_lag_smoother


ERRORS = {"constant": worst, "admissible": certified}

# With all measurement noises larger by one factor, which a grid of factors found.
REACHED = [
    (cancelling(DRIVE), 0.0, 0, 1.479),
    (cancelling(DRIVE), 1.0, 4, 1.46),
    (referenced(), 0.5, 4, 0.578),
]


@pytest.mark.parametrize(("system", "delay", "order", "reached"), REACHED)
def test_more_noises_than_one_factor_are_tuned(system, delay, order, reached):
    plant = rs.augment(system, delay, order)
    smoother = tuned_fixed_lag_smoother(plant)
    assert worst(smoother) < reached < worst(classical(plant, copies=False))
    floor = rs.baselines.worst_optimal_error(system, delay)
    assert worst(smoother) >= floor * (1.0 - 1e-9)


def test_in_the_example_it_is_the_kalman_smoother_of_the_smallest_slope_with_its_copy():
    plant = rs.augment(EXAMPLE, 3.1e-6, 2)
    smoother = tuned_fixed_lag_smoother(plant)
    errors = rs.delta_sweep(smoother, [0.0, -0.5, -1.0], loop="real")[:, 0, 0]
    assert_allclose(errors, [0.0483, 0.0600, 0.0838], rtol=5e-3)


PLANTS = {
    "gain and decay": rs.augment(of_gain(0.2, 0.3), 0.2, 2),
    "small": rs.augment(of_gain(1e-3), 0.2, 2),
    "two sensors": rs.augment(cancelling(DRIVE, GAIN), 1.0, 2),
    "in the measurement": rs.augment(EXAMPLE, 3.1e-6, 1),
    "in the state": rs.augment(driven(0.2), 0.5, 2),
    "a copy and an uncertainty": rs.augment(driven(0.2, seen=True), 0.5, 1),
}


@pytest.mark.parametrize("output", ["smoothed", "filtered"])
@pytest.mark.parametrize("against", AGAINST)
@pytest.mark.parametrize("name", PLANTS)
def test_it_is_never_worse_than_the_classical_smoother(name, against, output):
    plant, error = PLANTS[name], ERRORS[against]
    smoother = tuned_fixed_lag_smoother(plant, against, output)
    untuned = classical(plant, copies=plant.system.g > 0)
    assert error(smoother, output) <= error(untuned, output) * (1.0 + 1e-9)


@pytest.mark.parametrize("against", AGAINST)
def test_a_search_that_gains_nothing_ends_at_the_classical_smoother(against, monkeypatch):
    plant = PLANTS["gain and decay"]

    def stuck(objective, start, **_):
        return OptimizeResult(x=start, fun=objective(start))

    monkeypatch.setattr(tuned, "minimize", stuck)
    smoother, untuned = tuned_fixed_lag_smoother(plant, against), classical(plant, copies=False)
    error = ERRORS[against]
    assert error(smoother) <= error(untuned) * (1.0 + 1e-9)


@settings(max_examples=10, deadline=None)
@given(seeds, st.integers(1, 2), st.floats(0.0, 0.3), st.integers(0, 1))
def test_it_is_never_worse_than_the_classical_smoother_of_a_random_system(seed, m, size, g):
    rng = np.random.default_rng(seed)
    plant = rs.augment(random_system(rng, m=m, g=g, size=size), rng.uniform(0.1, 1.0), 1)
    smoother, untuned = tuned_fixed_lag_smoother(plant), classical(plant, copies=g > 0)
    assert worst(smoother) <= worst(untuned) * (1.0 + 1e-9)


@pytest.mark.parametrize("against", AGAINST)
def test_it_does_not_depend_on_units(against):
    system = cancelling(DRIVE, GAIN)
    here = ERRORS[against](tuned_fixed_lag_smoother(rs.augment(system, 1.0, 1), against))
    for time in (1e-9, 1e9):
        other = in_other_units(system, time, [1e6, 1e-5], [1e4])
        there = tuned_fixed_lag_smoother(rs.augment(other, 1.0 / time, 1), against)
        assert_allclose(ERRORS[against](there), here, rtol=1e-3)


@pytest.mark.parametrize("against", AGAINST)
def test_without_uncertainty_it_is_the_kalman_filter(against):
    plant = rs.augment(replace(of_gain(0.0), uncertainties=()), 0.0, 0)
    smoother, untuned = tuned_fixed_lag_smoother(plant, against), classical(plant, copies=False)
    assert_allclose(worst(smoother), worst(untuned), rtol=1e-9)
    assert_allclose(smoother.A_c, untuned.A_c, rtol=1e-4)


def test_it_is_a_filter_of_the_plant_and_runs_its_copies():
    plant = rs.augment(EXAMPLE, 3.1e-6, 2)
    smoother = tuned_fixed_lag_smoother(plant)
    assert smoother.plant is plant
    untuned = classical(plant, copies=True)
    for name in ("C_c", "C_a", "C_f"):
        assert_allclose(getattr(smoother, name), getattr(untuned, name), rtol=1e-12)
    # its copy's output is taken off the measurement with the gain of the measurement
    assert_allclose(smoother.B_c[:, 1], -smoother.B_c[:, 0] * EXAMPLE.nonlinearities[0].D[0, 0])
    linear = tuned_fixed_lag_smoother(rs.augment(of_gain(0.2), 0.2, 2))
    assert_array_equal(linear.B_c.shape, (3, 1))


def test_bad_arguments_are_refused():
    plant = rs.augment(of_gain(0.2), 0.2, 2)
    with pytest.raises(TypeError, match="plant must be an AugmentedSystem, got UncertainSystem"):
        tuned_fixed_lag_smoother(plant.system)
    with pytest.raises(ValueError, match="against must be one of 'constant', 'admissible'"):
        tuned_fixed_lag_smoother(plant, "dynamic")
    with pytest.raises(ValueError, match=r"output must be one of .*, got 'both'"):
        tuned_fixed_lag_smoother(plant, output="both")
    silent = replace(plant.system, D21=[[0.0, 0.0]])
    with pytest.raises(rs.InfeasibleDesignError, match="measurement 0 has no noise"):
        tuned_fixed_lag_smoother(rs.augment(silent, 0.2, 2))
    drifting = replace(plant.system, A=[[0.0]])
    with pytest.raises(
        rs.InfeasibleDesignError, match=r"output C x of .*\[0\] grows without bound"
    ):
        tuned_fixed_lag_smoother(rs.augment(drifting, 0.2, 2))
