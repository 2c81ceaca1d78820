"""The worst constant uncertainty: against grids, random ones, and what theory says of it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robsmooth import (
    UncertainSystem,
    Uncertainty,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
)
from robsmooth.analysis.covariance import worst_case
from robsmooth.estimators import baselines
from robsmooth.estimators.loop import LOOPS
from tests.helpers.loops import looking_at_nothing
from tests.helpers.strategies import (
    admissible_delta,
    designs,
    feasible_design,
    random_system,
    seeds,
)
from tests.helpers.systems import DRIVE, GAIN, cancelling, in_other_units


@pytest.fixture(scope="module")
def example():
    """Its cost is on the smoothed error, for which no constant uncertainty is the worst."""
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    return design_smoother(plant, 7.0229e-7, [1.0, 0.4999, 1e-6, 1e-6], "smoothed")


def designed(seed, cost="filtered", size=0.1, **sizes):
    """A random design whose bound was not minimised."""
    rng = np.random.default_rng(seed)
    design = feasible_design(rng, augment(random_system(rng, size=size, **sizes), 0.7, 2), cost)
    assert design is not None
    return design


@settings(max_examples=15)
@given(designs(), st.sampled_from(["smoothed", "filtered"]), st.sampled_from(LOOPS), seeds)
def test_no_admissible_uncertainty_is_worse(design, output, loop, seed):
    worst = worst_case(design, output, loop)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        Delta = admissible_delta(rng, design.plant)
        error = np.trace(error_covariance(design, Delta, output, loop))
        assert error <= worst.mean_square * (1 + 1e-9)
    assert worst.nominal <= worst.mean_square


@settings(max_examples=15)
@given(designs(), st.sampled_from(["smoothed", "filtered"]))
def test_worst_uncertainty_is_admissible_and_has_the_error_that_it_is_said_to(design, output):
    plant, worst = design.plant, worst_case(design, output)
    assert worst.mean_square == np.trace(error_covariance(design, worst.Delta, output))
    blocks, slopes = [], []
    row = column = 0
    for rows, columns in zip(plant.input_sizes, plant.output_sizes, strict=True):
        blocks.append(worst.Delta[row : row + rows, column : column + columns])
        row, column = row + rows, column + columns
    k, g = plant.system.k, plant.system.g
    for block, channel in zip(blocks[:k], plant.system.uncertainties, strict=True):
        assert np.linalg.norm(block, 2) <= 1 + 1e-12
        assert channel.C.any() or not block.any()
    for own, copy, channel in zip(
        blocks[k : k + g], blocks[k + g :], plant.system.nonlinearities, strict=True
    ):
        assert own == copy
        assert abs(own[0, 0]) <= channel.lipschitz * (1 + 1e-12)
        slopes.append(own[0, 0])
    assert_array_equal(worst.Delta, plant.structured_delta(blocks[:k], slopes))


def test_worst_of_two_slopes_is_the_largest_of_a_grid():
    plain = random_system(np.random.default_rng(3), n=2, m=2, measurements=2, g=2, size=0.15)
    channels = [Uncertainty(c.B, 0 * c.C, c.D) for c in plain.uncertainties]
    system = UncertainSystem(
        plain.A, plain.B1, plain.C0, plain.C2, plain.D21, channels, plain.nonlinearities
    )
    design = baselines.fixed_lag_smoother(system, 0.7, 2, copies=True)
    worst = worst_case(design)
    constants = [c.lipschitz for c in system.nonlinearities]
    grid = [
        np.trace(error_covariance(design, design.plant.structured_delta((), slopes)))
        for a in np.linspace(-1, 1, 21)
        for b in np.linspace(-1, 1, 21)
        for slopes in [(a * constants[0], b * constants[1])]
    ]
    assert max(grid) <= worst.mean_square * (1 + 1e-12)
    assert_allclose(max(grid), worst.mean_square, rtol=1e-3)


def test_worst_slope_of_the_example_is_the_edge_of_its_sector(example):
    for output in ("smoothed", "filtered"):
        worst = worst_case(example, output, loop="real")
        assert_array_equal(worst.Delta, example.plant.structured_delta((), [-1.0]))


@pytest.mark.parametrize("uncertainty", [0.2, 0.9])
def test_decay_rate_is_at_its_slowest(uncertainty):
    worst = worst_case(looking_at_nothing(uncertainty), "filtered")
    assert_allclose(worst.mean_square, 1 / (2 * (1 - uncertainty)), rtol=1e-12)
    assert_array_equal(worst.Delta, np.diag([1.0, 0.0]))
    assert repr(worst).startswith("WorstCase(mean_square=")


@pytest.mark.parametrize("uncertainty", [1.0, 1.5])
def test_worst_case_is_infinite_where_the_loop_can_be_unstable(uncertainty):
    smoother = looking_at_nothing(uncertainty)
    worst = worst_case(smoother, "filtered")
    assert math.isinf(worst.mean_square)
    assert_allclose(worst.nominal, 0.5)
    A = smoother.plant.A_p + smoother.plant.B1_tilde @ worst.Delta @ smoother.plant.C1_tilde
    assert np.linalg.eigvals(A).real.max() > -1e-12


def test_worst_case_of_a_loop_that_is_never_stable_is_infinite():
    one = np.ones((1, 1))
    broken = replace(looking_at_nothing(0.1), A_c=one, B_c=one, C_f=one)
    worst = worst_case(broken, "filtered")
    assert math.isinf(worst.mean_square)
    assert math.isinf(worst.nominal)


def test_without_uncertainty_the_nominal_case_is_the_worst():
    design = baselines.kalman_bucy(UncertainSystem([[-1.0]], [[1.0, 0.0]], [[1]], [[1]], [[0, 1]]))
    worst = worst_case(design)
    assert worst.mean_square == worst.nominal
    assert worst.Delta.shape == (0, 0)


@settings(max_examples=6)
@given(st.sampled_from(["filtered", "smoothed"]).flatmap(lambda cost: designs(cost=cost)))
def test_guarantee_holds_for_the_error_that_it_is_for(design):
    assert worst_case(design, "guaranteed").mean_square <= design.mean_square_bound


def test_guaranteed_error_is_against_the_model_of_the_delay(example):
    # the model is good, and so is C_a instead of w-hat's gain: the two errors are nearly the same
    smoothed, guaranteed = (worst_case(example, o) for o in ("smoothed", "guaranteed"))
    assert smoothed.mean_square != guaranteed.mean_square
    assert_allclose(smoothed.mean_square, guaranteed.mean_square, rtol=0.01)


def test_search_does_not_depend_on_the_number_of_starts(monkeypatch):
    design = designed(8, n=3, m=2, measurements=2, g=2)
    many = worst_case(design).mean_square
    monkeypatch.setattr("robsmooth.analysis.covariance._STARTS", 8)
    assert_allclose(worst_case(design).mean_square, many, rtol=1e-9)


def test_worst_case_does_not_depend_on_the_unit_of_time():
    design = designed(5, n=2, m=1, measurements=1, g=1)
    system, fast = design.plant.system, 2.0**30

    def faster(channel):
        return {"B": channel.B * fast, "D": channel.D}

    quick = UncertainSystem(
        A=system.A * fast,
        B1=system.B1 * fast**0.5,
        C0=system.C0,
        C2=system.C2,
        D21=system.D21 / fast**0.5,
        uncertainties=[Uncertainty(C=c.C, **faster(c)) for c in system.uncertainties],
        nonlinearities=[
            type(c)(C=c.C, lipschitz=c.lipschitz, **faster(c)) for c in system.nonlinearities
        ],
    )
    pair = [
        baselines.fixed_lag_smoother(s, lag, 2, copies=True)
        for s, lag in ((system, 0.7), (quick, 0.7 / fast))
    ]
    slow, fast_one = (worst_case(each, loop="real") for each in pair)
    assert_allclose(fast_one.mean_square, slow.mean_square, rtol=1e-9)


def test_what_is_not_understood_is_refused(example):
    with pytest.raises(TypeError, match="smoother must be an Estimator, got str"):
        worst_case("design")
    with pytest.raises(ValueError, match=r"output must be one of .*, got 'both'"):
        worst_case(example, "both")
    with pytest.raises(ValueError, match="loop must be one of 'theory', 'real', got 'ideal'"):
        worst_case(example, loop="ideal")


@pytest.mark.parametrize("time", [1e-9, 1e9])
def test_worst_case_does_not_depend_on_the_units_of_states_and_measurements(time):
    system = cancelling(DRIVE, GAIN)
    other = in_other_units(system, time, [1e6, 1e-5], [1e4])
    here, there = (
        worst_case(baselines.fixed_lag_smoother(s, delay, 2), loop="real")
        for s, delay in ((system, 1.0), (other, 1.0 / time))
    )
    assert_allclose(there.mean_square, here.mean_square, rtol=1e-6)
    assert_allclose(there.Delta, here.Delta, atol=1e-6)
