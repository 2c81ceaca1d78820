"""The path of barrier problems: its derivatives, and where it leads."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robsmooth import augment, homodyne
from robsmooth.estimators.bound_search import barrier_problem
from robsmooth.estimators.conditions import multiplier_level
from tests.helpers.limits import CASES, limit_of


def example(cost="filtered"):
    problem = barrier_problem(augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2), cost)
    return problem, np.log([1.2e-6 / problem.v.time, 0.8, 0.3, 2e-4, 1e-4])


def in_a_limit():
    plant, zero, rates = CASES["two at different rates"]
    limit = limit_of(plant, zero, rates=rates)
    problem = barrier_problem(plant, "filtered", limit.multipliers == 0.0)
    return problem, problem.point(limit.tau / problem.v.time, limit.multipliers, np.array(rates))


@pytest.mark.parametrize("problem, point", [example(), example("smoothed"), in_a_limit()])
def test_derivatives_are_those_of_differences(problem, point):
    mu, step = 0.01, 1e-4
    gradient = problem.objective(point, mu)[1]
    hessian = problem.hessian(point, mu, gradient)
    for i, direction in enumerate(np.eye(len(point))):
        (low, before), (high, after) = (
            problem.objective(point + sign * step * direction, mu) for sign in (-1, 1)
        )
        assert (high - low) / (2 * step) == pytest.approx(gradient[i], abs=1e-6)
        assert_allclose((after - before) / (2 * step), hessian[i], rtol=0, atol=1e-5)


def test_barrier_is_infinite_outside_the_constraint():
    problem, point = example()
    assert np.isfinite(problem.objective(point, 0.1)[0])
    point[1] = np.log(1.01)
    assert problem.objective(point, 0.1)[0] == np.inf


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
def test_path_approaches_the_boundary_in_proportion_to_the_weight(cost):
    problem, point = example(cost)
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    weights = 10.0 ** -np.arange(1.0, 8.0)
    path = problem.central_path(point, weights)
    slack, bounds = [], []
    for mu, end in zip(weights, path, strict=True):
        bounds.append(problem.log_bound(end)[0])
        slack.append(1 - multiplier_level(plant, problem.arguments(end)[1]))
        gradient = problem.objective(end, mu)[1]
        hessian = problem.hessian(end, mu, gradient)
        assert gradient @ np.linalg.solve(hessian, gradient) < 2e-3 * mu
    assert (np.diff(bounds) < 0).all()
    for falling in (np.array(slack), np.exp([end[3] for end in path])):
        assert_allclose(falling[4:] / falling[3:-1], 0.1, rtol=0.05)
    # as many constraints as there are: two uncertain channels, two of the pair, four multipliers
    assert bounds[3] - bounds[-1] < 8 * weights[3]
