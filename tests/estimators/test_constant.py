"""Designs against constant uncertainty: slopes, known values, the floor, limits, invariances."""

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import minimize

import robsmooth as rs
from robsmooth.estimators import constant
from robsmooth.estimators.descent import variables, with_variables
from robsmooth.estimators.loop import LOOPS, OUTPUTS, open_loop
from tests.helpers.strategies import admissible_delta, designs, random_system, seeds
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

NOTHING = rs.Uncertainty(B=[[1]], C=[[0]], D=[[0]])


# --- the error and its slopes ---------------------------------------------------------------------


def difference(function, at, direction, step):
    """The slope of a function in a direction, by differences."""
    above, below = (function(at + sign * step * direction) for sign in (1.0, -1.0))
    return (above - below) / (2.0 * step)


@settings(max_examples=20)
@given(designs(), st.sampled_from(OUTPUTS), st.sampled_from(LOOPS), seeds)
def test_slopes_are_those_of_the_error(design, output, loop, seed):
    rng = np.random.default_rng(seed)
    opened, Delta = open_loop(design, output, loop), 0.9 * admissible_delta(rng, design.plant)
    value, slopes = constant.slopes(opened, Delta)
    if output != "guaranteed":
        error = rs.error_covariance(design, Delta, output, loop).trace()
        assert_allclose(value, error, rtol=1e-8)
    for name in ("A", "B", "inputs", "outputs", "estimate"):
        at, slope = getattr(opened, name), getattr(slopes, name)
        direction = rng.standard_normal(at.shape)
        found = difference(
            lambda changed, name=name: constant.mean_square(
                replace(opened, **{name: changed}), Delta
            ),
            at, direction, 1e-5,
        )  # fmt: skip
        scale = np.linalg.norm(slope) * np.linalg.norm(direction) + value
        assert abs(found - (slope * direction).sum()) < 1e-5 * scale, name
    direction = rng.standard_normal(Delta.shape)
    found = difference(lambda D: constant.mean_square(opened, D), Delta, direction, 1e-5)
    slope = opened.inputs.T @ slopes.A @ opened.outputs.T
    scale = np.linalg.norm(slope) * np.linalg.norm(direction) + value
    assert abs(found - (slope * direction).sum()) < 1e-5 * scale


@settings(max_examples=10)
@given(designs(), seeds)
def test_slopes_are_those_of_the_error_in_the_estimators_matrices(design, seed):
    rng = np.random.default_rng(seed)
    design = with_variables(design, variables(design))  # its w-hat is its smoothed estimate
    Delta = 0.9 * admissible_delta(rng, design.plant)

    def error(x):
        return constant.mean_square(open_loop(with_variables(design, x), "smoothed", "real"), Delta)

    value, slopes = constant.slopes(open_loop(design, "smoothed", "real"), Delta)
    slope, at = slopes.of_estimator(design), variables(design)
    direction = rng.standard_normal(at.shape)
    scale = np.linalg.norm(slope) * np.linalg.norm(direction) + value
    found = difference(error, at, direction, 1e-5)
    assert abs(found - slope @ direction) < 1e-5 * scale


# --- the design -----------------------------------------------------------------------------------

# What an independent prototype reached, from one start.
REACHED = [
    (cancelling(DRIVE), 0.0, 0, 1.25775),
    (cancelling(DRIVE), 1.0, 4, 1.16),
    (referenced(), 0.5, 4, 0.49),
    (EXAMPLE, 3.1e-6, 2, 0.0838),
]


@pytest.mark.parametrize(("system", "delay", "order", "reached"), REACHED)
def test_known_values_are_reached_and_are_the_worst_case(system, delay, order, reached):
    smoother = rs.constant_minimax_smoother(rs.augment(system, delay, order))
    assert smoother.worst_constant <= reached
    assert_allclose(worst(smoother), smoother.worst_constant, rtol=1e-6)
    floor = rs.baselines.worst_optimal_error(system, delay)
    assert smoother.worst_constant >= floor * (1.0 - 1e-9)
    if not delay:  # it is the optimal filter of the worst system: no estimator is better
        assert_allclose(smoother.worst_constant, floor, rtol=1e-5)


PLANTS = {
    "gain and decay": rs.augment(of_gain(0.2, 0.3), 0.2, 2),
    "two sensors": rs.augment(cancelling(DRIVE, GAIN), 1.0, 2),
    "in the measurement": rs.augment(EXAMPLE, 3.1e-6, 1),
    "in the state": rs.augment(driven(0.2), 0.5, 2),
    "a copy and an uncertainty": rs.augment(driven(0.2, seen=True), 0.5, 1),
    "two outputs": rs.augment(
        random_system(np.random.default_rng(3), m=2, measurements=2, g=1, size=0.2), 0.3, 1
    ),
}


@pytest.mark.parametrize("output", ["smoothed", "filtered"])
@pytest.mark.parametrize("name", PLANTS)
def test_it_is_never_worse_than_what_it_starts_from(name, output):
    plant = PLANTS[name]
    smoother = rs.constant_minimax_smoother(plant, output)
    assert smoother.cost == output
    assert_allclose(worst(smoother, output), smoother.worst_constant, rtol=1e-6)
    for other in (
        classical(plant, copies=False),
        classical(plant, copies=True),
        rs.baselines.tuned_fixed_lag_smoother(plant, "constant", output),
        rs.minimax_smoother(plant, output),
    ):
        assert smoother.worst_constant <= worst(other, output) * (1.0 + 1e-6)


def test_it_does_not_depend_on_units():
    system = cancelling(DRIVE, GAIN)
    here = rs.constant_minimax_smoother(rs.augment(system, 1.0, 1))
    for time in (1e-9, 1e9):
        other = in_other_units(system, time, [1e6, 1e-5], [1e4])
        there = rs.constant_minimax_smoother(rs.augment(other, 1.0 / time, 1))
        assert_allclose(there.worst_constant, here.worst_constant, rtol=1e-5)


@pytest.mark.parametrize("uncertainties", [(), (NOTHING,)])
def test_without_uncertainty_it_is_no_worse_than_the_classical_smoother(uncertainties):
    system = replace(of_gain(0.0), uncertainties=uncertainties)
    filtered = rs.constant_minimax_smoother(rs.augment(system, 0.0, 0))
    optimum = rs.baselines.optimal_fixed_lag_error(system, 0.0).trace()
    assert_allclose(filtered.worst_constant, optimum, rtol=1e-6)
    plant = rs.augment(system, 0.2, 1)
    smoothed = rs.constant_minimax_smoother(plant)
    optimum = rs.baselines.optimal_fixed_lag_error(system, 0.2).trace()
    assert optimum < smoothed.worst_constant <= worst(classical(plant, copies=False))


def test_an_uncertainty_that_destabilises_the_plant_is_refused():
    plant = rs.augment(of_gain(0.0, decay=1.5), 0.2, 1)
    with pytest.raises(rs.InfeasibleDesignError, match="constant uncertainty destabilises"):
        rs.constant_minimax_smoother(plant)


def test_a_plant_that_stays_stable_is_not_refused_where_its_copies_are_unstable():
    """The classical smoother runs a copy that its own gain makes unstable."""
    detector = rs.Nonlinearity(B=[[0]], C=[[1]], D=[[1]], lipschitz=20.0)
    system = replace(of_gain(0.0), uncertainties=(), nonlinearities=[detector])
    plant = rs.augment(system, 0.0, 0)
    assert np.isinf(worst(classical(plant, copies=True)))
    smoother = rs.constant_minimax_smoother(plant)
    assert smoother.worst_constant <= worst(classical(plant, copies=False))


def test_bad_arguments_are_refused():
    plant = rs.augment(of_gain(0.2), 0.2, 2)
    with pytest.raises(TypeError, match="plant must be an AugmentedSystem, got UncertainSystem"):
        rs.constant_minimax_smoother(plant.system)
    with pytest.raises(ValueError, match=r"output must be one of .*, got 'both'"):
        rs.constant_minimax_smoother(plant, "both")
    silent = replace(plant.system, D21=[[0.0, 0.0]])
    with pytest.raises(rs.InfeasibleDesignError, match="measurement 0 has no noise"):
        rs.constant_minimax_smoother(rs.augment(silent, 0.2, 2))


# --- the floor ------------------------------------------------------------------------------------


def with_slopes(system, slopes):
    """The system that single uncertainties, then nonlinearities, of these slopes make."""
    A, C2 = system.A, system.C2
    channels = (*system.uncertainties, *system.nonlinearities)
    for slope, channel in zip(slopes, channels, strict=True):
        A, C2 = A + slope * channel.B @ channel.C, C2 + slope * channel.D @ channel.C
    return replace(system, A=A, C2=C2)


def test_floor_of_the_example_is_the_exact_optimum_at_the_edge_of_its_sector():
    edge = with_slopes(EXAMPLE, [0.0, -1.0])
    expected = rs.baselines.optimal_fixed_lag_error(edge, 3.1e-6)[0, 0]
    found = rs.baselines.worst_optimal_error(EXAMPLE, 3.1e-6)
    assert_allclose(found, expected, rtol=1e-9)
    assert_allclose(found, 0.08358, rtol=1e-4)


@pytest.mark.parametrize("delay", [0.0, 1.0, np.inf])
def test_floor_is_the_largest_near_the_largest_of_a_grid(delay):
    system = cancelling(DRIVE, GAIN)

    def error(slopes):
        return rs.baselines.optimal_fixed_lag_error(with_slopes(system, slopes), delay).trace()

    largest = max(product(np.linspace(-1.0, 1.0, 11), repeat=2), key=error)
    near = minimize(
        lambda slopes: -error(slopes), largest, method="Nelder-Mead", bounds=[(-1.0, 1.0)] * 2
    )
    assert_allclose(rs.baselines.worst_optimal_error(system, delay), -near.fun, rtol=1e-5)


def test_floor_of_a_block_is_that_of_the_worst_of_many():
    system = random_system(np.random.default_rng(1), g=0, size=0.3)
    found, rng = rs.baselines.worst_optimal_error(system, 0.5), np.random.default_rng(2)
    plant = rs.augment(system, 0.5, 0)
    for _ in range(200):
        Delta = admissible_delta(rng, plant)
        A = system.A + plant.B1_tilde @ Delta @ plant.C1_tilde
        C2 = system.C2 + plant.D21_tilde @ Delta @ plant.C1_tilde
        made = replace(system, A=A, C2=C2)
        error = rs.baselines.optimal_fixed_lag_error(made, 0.5).trace()
        assert error <= found * (1.0 + 1e-6)


@settings(max_examples=4, deadline=None)
@given(seeds, st.floats(0.05, 0.9), st.floats(0.05, 2.0), st.integers(0, 1))
def test_no_estimator_is_below_the_floor(seed, size, delay, order):
    rng = np.random.default_rng(seed)
    rate = rs.Uncertainty(B=[[1], [0]], C=[[size, 0]], D=[[0]])
    gain = rs.Uncertainty(B=[[0], [0]], C=[[0, size]], D=[[1]])
    B1 = np.hstack([rng.standard_normal((2, 2)), np.zeros((2, 1))])
    A = [[-1.0, 0.0], [rng.standard_normal(), -1.0]]
    C0, C2 = rng.standard_normal((2, 1, 2))
    system = rs.UncertainSystem(A, B1, C0, C2, [[0, 0, 0.3]], [rate, gain])
    plant = rs.augment(system, delay, order)
    floor = rs.baselines.worst_optimal_error(system, delay)
    for estimator in (classical(plant, copies=False), rs.constant_minimax_smoother(plant)):
        assert worst(estimator) >= floor * (1.0 - 1e-9)


def test_floor_without_uncertainty_is_the_exact_optimum_and_grows_with_uncertainty():
    for uncertainties in ((), (NOTHING,)):
        system = replace(of_gain(0.0), uncertainties=uncertainties)
        expected = rs.baselines.optimal_fixed_lag_error(system, 0.2).trace()
        assert_allclose(rs.baselines.worst_optimal_error(system, 0.2), expected, rtol=1e-9)
    floors = [
        rs.baselines.worst_optimal_error(of_gain(size, size), 0.2) for size in (0.1, 0.2, 0.3)
    ]
    assert all(before < after for before, after in pairwise(floors))


def test_floor_wants_a_system_and_a_delay():
    with pytest.raises(TypeError, match="system must be an UncertainSystem"):
        rs.baselines.worst_optimal_error(np.eye(2), 1.0)
    with pytest.raises(ValueError, match=r"^delay must"):
        rs.baselines.worst_optimal_error(EXAMPLE, -1.0)
