"""The path of barrier problems: its derivatives, and where it leads."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robsmooth import augment, homodyne
from robsmooth.estimators.bound_search import face_where
from robsmooth.estimators.smoother import multiplier_level
from tests.helpers.limits import CASES, limit_of


def example_face(cost="filtered"):
    face = face_where(augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2), cost)
    return face, np.log([1.2e-6 / face.v.time, 0.8, 0.3, 2e-4, 1e-4])


def limit_face():
    plant, zero, rates = CASES["two at different rates"]
    limit = limit_of(plant, zero, rates=rates)
    face = face_where(plant, "filtered", limit.multipliers == 0.0)
    values = [limit.tau / face.v.time, *limit.multipliers[face.v.active], *rates[4:]]
    return face, np.log(values)


@pytest.mark.parametrize("face, point", [example_face(), example_face("smoothed"), limit_face()])
def test_derivatives_are_those_of_differences(face, point):
    mu, step = 0.01, 1e-4
    gradient, hessian = face.objective(point, mu)[1], face.curvature(point, mu)
    for i, direction in enumerate(np.eye(len(point))):
        (low, before), (high, after) = (
            face.objective(point + sign * step * direction, mu) for sign in (-1, 1)
        )
        assert (high - low) / (2 * step) == pytest.approx(gradient[i], abs=1e-6)
        assert_allclose((after - before) / (2 * step), hessian[i], rtol=0, atol=1e-5)


def test_barrier_is_infinite_outside_the_constraint():
    face, point = example_face()
    assert np.isfinite(face.objective(point, 0.1)[0])
    point[1] = np.log(1.01)
    assert face.objective(point, 0.1)[0] == np.inf


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
def test_path_approaches_the_boundary_in_proportion_to_the_weight(cost):
    face, point = example_face(cost)
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    weights = 10.0 ** -np.arange(1.0, 8.0)
    path = face.follow(point, weights)
    slack, bounds = [], []
    for mu, end in zip(weights, path, strict=True):
        bounds.append(face.log_bound(end)[0])
        slack.append(1 - multiplier_level(plant, plant.M(face.split(end)[1])))
        hessian = face.curvature(end, mu)
        gradient = face.objective(end, mu)[1]
        assert gradient @ np.linalg.solve(hessian, gradient) < 2e-3 * mu
    assert (np.diff(bounds) < 0).all()
    for falling in (np.array(slack), np.exp([end[3] for end in path])):
        assert_allclose(falling[4:] / falling[3:-1], 0.1, rtol=0.05)
    # as many constraints as there are: two uncertain channels, two of the pair, four multipliers
    assert bounds[3] - bounds[-1] < 8 * weights[3]
