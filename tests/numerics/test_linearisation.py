"""Statistical linearisation: the slopes of a law, and the iteration to those of a loop."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import norm

from robsmooth import UnstableLoopError
from robsmooth._numerics.linearisation import equivalent_slopes, of_function
from robsmooth.estimators.baselines import fixed_lag_smoother
from robsmooth.homodyne import PAPER
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.simulation.loop import nonlinear_loop
from tests.helpers.printed import printed_estimator


@pytest.mark.parametrize("variance", [1e-20, 0.09, 1.0, 4.0])
def test_slope_leaves_least_of_a_function(variance):
    assert of_function(np.sin, variance) == pytest.approx(math.exp(-variance / 2), rel=1e-12)
    assert of_function(lambda v: v**3, variance) == pytest.approx(3 * variance, rel=1e-12)
    deviation = math.sqrt(variance)
    regression = quad(
        lambda v: np.tanh(v) * v * norm.pdf(v, scale=deviation), -9 * deviation, 9 * deviation
    )[0]
    assert of_function(np.tanh, variance) == pytest.approx(regression / variance, rel=1e-3)


def test_slope_of_an_argument_that_is_still_is_none():
    assert of_function(np.sin, 0.0) == 0.0


def one_slope(slope_of, variance_of, start=1.0, **more):
    found = equivalent_slopes(
        np.array([start]),
        lambda slopes: np.array([variance_of(slopes[0])]),
        lambda variances: np.array([slope_of(variances[0])]),
        tolerance=1e-13,
        **more,
    )
    return found[0]


@pytest.mark.parametrize("noise", [0.1, 0.5, 0.73])
def test_slopes_belong_to_the_variances_that_they_make(noise):
    """dx = -sin(x) dt + noise: the last is just short of 2/e, beyond which there are none."""
    found = one_slope(lambda P: math.exp(-P / 2), lambda s: noise / s)
    expected = brentq(lambda s: s - math.exp(-noise / s / 2), noise / 2, 1.0, xtol=1e-15)
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("bend", [1.0, 30.0, 1e3])
def test_slopes_that_swing_from_side_to_side_are_found(bend):
    """dx = -(x + bend x^3) dt + noise: the larger the variance, the smaller it makes itself."""
    found = one_slope(lambda P: 1 + 3 * bend * P, lambda s: 0.5 / s)
    assert found == pytest.approx((1 + math.sqrt(1 + 6 * bend)) / 2, rel=1e-9)


@pytest.mark.parametrize("unit", [1e-12, 1e9])
def test_slopes_do_not_depend_on_their_unit(unit):
    steps, units = [], np.array([1.0, unit])

    def variances(slopes):
        steps.append(1)
        return 0.5 / slopes

    def in_units(variances):
        return units * np.exp(-0.5 * variances)

    plain = equivalent_slopes(np.ones(2), variances, lambda P: np.exp(-0.5 * P), tolerance=1e-12)
    taken, steps[:] = len(steps), []
    found = equivalent_slopes(
        units, lambda slopes: variances(slopes / units), in_units, tolerance=1e-12, unit=units
    )
    assert len(steps) == taken
    assert_allclose(found, plain * units, rtol=1e-14)


def test_loop_without_such_slopes_is_an_error():
    with pytest.raises(UnstableLoopError, match="the statistically linear loop diverges"):
        one_slope(lambda P: math.exp(-P / 2), lambda s: 2.0 / s, largest=100.0)


def test_no_nonlinearities_have_no_slopes():
    none = np.zeros(0)
    assert equivalent_slopes(none, lambda s: none, lambda P: none, tolerance=1e-12).shape == (0,)


@pytest.mark.parametrize("oscillator", ["filtered", "smoothed"])
def test_slopes_of_the_homodyne_loop_are_the_same_by_every_route_to_its_covariance(oscillator):
    """Of its root, of its covariance, of any nonlinear loop."""
    estimator = printed_estimator()
    loop = homodyne_loop(PAPER, estimator, oscillator=oscillator)
    slopes = loop.equivalent_slopes()
    rows = loop.arguments
    variances = (rows @ loop.covariance(*slopes) @ rows.T).diagonal()
    assert_allclose(np.exp(-0.5 * variances), slopes, rtol=1e-9)
    system = estimator.plant.system
    (sine,) = system.nonlinearities
    referring = replace(system, nonlinearities=[replace(sine, reference=oscillator)])
    general = nonlinear_loop(replace(estimator, plant=replace(estimator.plant, system=referring)))
    assert_allclose(PAPER.beta + PAPER.gamma * np.diag(general.delta)[1:], slopes, rtol=1e-6)


def test_where_there_are_no_slopes_the_general_loop_keeps_a_stable_one():
    estimator = fixed_lag_smoother(PAPER.uncertain_system(), 3.1e-6, 2)
    system = estimator.plant.system
    loud = replace(estimator.plant, system=replace(system, D21=10 * system.D21))
    loop = nonlinear_loop(replace(estimator, plant=loud))
    assert loop.slowest_rate > 0.0
    with pytest.raises(UnstableLoopError):
        homodyne_loop(PAPER, estimator, shot_noise=100.0).equivalent_slopes()
