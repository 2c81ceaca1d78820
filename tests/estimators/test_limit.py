"""The limit of vanishing multipliers: against designs next to it, its structure, its guarantee."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robsmooth import (
    InfeasibleDesignError,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
)
from robsmooth.estimators.smoother import limiting_smoother
from tests.helpers.limits import CASES, limit_of, observer_plant
from tests.helpers.strategies import admissible_delta

COSTS = ("filtered", "smoothed")
EXAMPLE = (1.1e-6, [1.0, 0.5, 0.0, 0.0])


@pytest.fixture(scope="module")
def example():
    return augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)


def extrapolated(limit, rates, quantity, step=1e-4):
    """A quantity of designs next to a limit, extrapolated to it."""
    values = []
    for epsilon in (step, step / 2, step / 4):
        multipliers = limit.multipliers + epsilon * rates
        design = design_smoother(limit.plant, limit.tau, multipliers, limit.cost)
        values.append(quantity(design))
    return (values[0] - 6 * values[1] + 8 * values[2]) / 3


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("case", CASES)
def test_limit_is_that_of_designs_next_to_it(case, cost):
    plant, zero = CASES[case]
    limit = limit_of(plant, zero, cost)
    approach = (limit.multipliers == 0.0) * np.linspace(1.0, 3.0, len(limit.multipliers))
    for name in ("bound", "A_c", "B_c", "C_c", "X", "Y"):
        expected = extrapolated(limit, approach, lambda design, name=name: getattr(design, name))
        size = np.abs(expected).max()
        assert_allclose(getattr(limit, name), expected, rtol=0, atol=1e-6 * size + 1e-9)


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("case", CASES)
def test_designs_keep_their_digits_however_close_to_a_limit(case, cost):
    plant, zero = CASES[case]
    limit = limit_of(plant, zero, cost)
    approach = (limit.multipliers == 0.0) * 1.0
    slopes = []
    for epsilon in (1e-7, 1e-9, 1e-11):
        design = design_smoother(plant, limit.tau, limit.multipliers + epsilon * approach, cost)
        slopes.append((design.bound / limit.bound - 1) / epsilon)
    assert_allclose(slopes, slopes[0], rtol=0, atol=3e-3 * max(1.0, abs(slopes[0])))


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("case", CASES)
def test_a_limit_that_exists_at_one_tau_exists_at_all_larger_ones(case, cost):
    # R/tau falls with tau, and X/tau does not depend on it
    plant, zero = CASES[case]
    limit = limit_of(plant, zero, cost)
    for tau in limit.tau * np.geomspace(1.0, 1e3, 25):
        limiting_smoother(plant, tau, limit.multipliers, cost)


@pytest.mark.parametrize("cost", COSTS)
def test_limit_of_the_example_is_that_of_designs_next_to_it(example, cost):
    limit = limiting_smoother(example, *EXAMPLE, cost)
    for name in ("bound", "A_c", "B_c", "C_c", "Y"):
        expected = extrapolated(
            limit,
            np.array([0.0, -1.0, 1.0, 1.0]),
            lambda design, name=name: getattr(design, name),
            step=1e-5,
        )
        size = np.abs(expected).max()
        assert_allclose(getattr(limit, name), expected, rtol=0, atol=1e-6 * size)
    assert_allclose(limit.X, 0.0, atol=0)


@pytest.mark.parametrize("case", ["one measurement", "both of two", "with uncertainty"])
def test_limit_is_a_nonlinear_observer(case):
    # the copy's output enters the estimator as the nonlinearity enters the system
    plant, zero = CASES[case]
    limit = limit_of(plant, zero)
    system, n = plant.system, plant.system.n
    innovation = limit.B_c[:, : system.l]
    for i, channel in enumerate(system.nonlinearities):
        if system.k + system.g + i not in zero:
            continue
        expected = -innovation @ channel.D
        expected[:n] += channel.B
        assert_allclose(limit.B_c[:, [system.l + i]], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("case", ["both of two", "with uncertainty"])
def test_the_guarantee_holds_in_the_limit(case, cost):
    plant, zero = CASES[case]
    limit = limit_of(plant, zero, cost)
    rng = np.random.default_rng(0)
    for _ in range(20):
        P = error_covariance(limit, admissible_delta(rng, plant), "guaranteed")
        assert np.trace(P) <= limit.mean_square_bound


def test_where_M_stays_positive_the_limit_is_the_design(example):
    multipliers = [0.9, 0.4, 0.0, 1e-4]
    limit = limiting_smoother(example, 1.1e-6, multipliers)
    design = design_smoother(example, 1.1e-6, multipliers)
    assert limit.bound == design.bound
    assert_allclose(limit.A_c, design.A_c, rtol=0)


def test_limit_does_not_depend_on_the_unit_of_time(example):
    unit = 1e-5
    parameters = homodyne.HomodyneParameters(
        lam=9.14e3 * unit, kappa=4e4 * unit, alpha=1162.0 * np.sqrt(unit), beta=1.0, gamma=0.4
    )
    other = augment(parameters.uncertain_system(), 3.1e-6 / unit, 2)
    tau, multipliers = EXAMPLE
    for cost in COSTS:
        here = limiting_smoother(example, tau, multipliers, cost)
        there = limiting_smoother(other, tau / unit, multipliers, cost)
        assert there.bound == pytest.approx(here.bound, rel=1e-11)
        assert_allclose(there.poles / unit, here.poles, rtol=1e-8)


# --- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "multipliers", [[0.0, 0.4, 1e-3, 1e-3], [0.9, 0, 0, 0], [0.9, 0, 0, 0.1], [0.9, 0, 0.1, 0]]
)
def test_other_multipliers_may_not_vanish(example, multipliers):
    with pytest.raises(InfeasibleDesignError, match="every uncertainty needs") as caught:
        limiting_smoother(example, 1e-6, multipliers)
    assert caught.value.condition == "M(lambda) > 0"


def test_a_nonlinearity_that_enters_the_state_has_no_limit():
    with pytest.raises(InfeasibleDesignError, match="does not enter the state needs") as caught:
        limiting_smoother(observer_plant(1), 1.0, [0.5, 0.5, 0.2, 0.0, 0.0])
    assert caught.value.condition == "M(lambda) > 0"


def test_multipliers_outside_the_constraint_are_refused(example):
    with pytest.raises(InfeasibleDesignError, match=r"divide the multipliers by 1\.2"):
        limiting_smoother(example, 1e-6, [1.2, 0.5, 0.0, 0.0])


def test_bad_arguments_are_those_of_a_design(example):
    with pytest.raises(ValueError, match="tau must"):
        limiting_smoother(example, 0.0, EXAMPLE[1])
    with pytest.raises(ValueError, match="cost must be one of"):
        limiting_smoother(example, *EXAMPLE, "both")
    with pytest.raises(TypeError, match="plant must be an AugmentedSystem"):
        limiting_smoother(example.system, *EXAMPLE)
