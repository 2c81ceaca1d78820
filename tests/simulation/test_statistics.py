"""What is made of the paths' results, against NumPy on the whole sample."""

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robsmooth.simulation.statistics import Moments, Tally, control_weights

SAMPLE = np.random.default_rng(0).normal(3, 1, (2, 1000)) ** 2


def moments_of(values, at=()):
    return sum((Moments.of(part) for part in np.split(values, at, axis=1)), Moments())


@pytest.mark.parametrize("at", [(), (32, 64, 65, 700), (0, 999)], ids=str)
def test_standard_error_is_that_of_the_sample(at):
    moments = moments_of(SAMPLE, at)
    for variable, values in enumerate(SAMPLE):
        given = moments.mean_square(variable)
        assert given.mean_square == pytest.approx(values.mean(), rel=1e-14)
        assert given.standard_error == pytest.approx(values.std(ddof=1) / 1000**0.5, rel=1e-13)
        assert given.variance_reduction == 1.0


def test_merged_moments_are_those_of_all_values():
    whole = moments_of(SAMPLE[:, :300])
    for part in (SAMPLE[:, 300:300], SAMPLE[:, 300:]):
        whole += moments_of(part)
    expected = moments_of(SAMPLE)
    assert whole.count == 1000
    assert_allclose(whole.means, expected.means, rtol=1e-14)
    assert_allclose(whole.squares, expected.squares, rtol=1e-13)


def test_variance_reduction_is_the_ratio_of_the_variances():
    values = np.vstack([SAMPLE[0], 0.1 * SAMPLE[0]])
    assert moments_of(values).mean_square(1, plain=0).variance_reduction == pytest.approx(100)


def test_few_paths_have_no_standard_error():
    assert math.isnan(moments_of(SAMPLE[:, :0]).mean_square(0).mean_square)
    one = moments_of(SAMPLE[:, :1]).mean_square(0)
    assert one.mean_square == SAMPLE[0, 0] and math.isnan(one.standard_error)


def test_control_weights_are_those_of_a_regression():
    rng = np.random.default_rng(1)
    controls = rng.normal(size=(3, 200)) * [[1e-3], [1], [1e3]]
    values = np.array([[2.0, -1, 0.5], [0, 3, 1]]) @ controls + rng.normal(size=(2, 200))
    for value, weights in zip(values, control_weights(values, controls), strict=True):
        design = np.column_stack([np.ones(200), controls.T])
        assert_allclose(weights, np.linalg.lstsq(design, value, rcond=None)[0][1:], rtol=1e-8)


def test_control_weights_of_controls_that_are_the_same_or_constant_are_finite():
    control = SAMPLE[0]
    controls = np.vstack([control, control, np.full_like(control, 7.0)])
    weights = control_weights(2 * control[None], controls)
    assert_allclose(weights, [[1, 1, 0]], atol=1e-10)


def test_tally_keeps_paths_that_slipped_apart_and_survives_json():
    slips = np.zeros(1000)
    slips[[3, 500]] = 1, 4
    tally = Tally() + Tally.of(SAMPLE[:, :400], slips[:400])
    tally = Tally.from_state(*json.loads(json.dumps(tally.state())))
    tally += Tally.of(SAMPLE[:, 400:], slips[400:])
    assert tally.slips == 5
    assert (tally.all.count, tally.locked.count) == (1000, 998)
    kept = SAMPLE[0, slips == 0]
    assert tally.locked.mean_square(0).mean_square == pytest.approx(kept.mean(), rel=1e-13)
