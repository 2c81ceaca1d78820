"""What the minimax smoother certifies, how long it takes, and what others certify.

Systems from the paper, from the README, and two in which the measurement nearly cancels.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

import robsmooth as rs
from robsmooth.estimators.certificate import certify, problem_of
from robsmooth.paper.published import DELAY, ORDER

LONGEST = 1.0  # s, for a design


def plants() -> Iterator[tuple[str, rs.AugmentedSystem, str, float]]:
    """Yield names, plants, outputs, and the certified error that a prototype had."""
    example = rs.homodyne.PAPER
    centred = replace(example, beta=0.8, gamma=0.2).uncertain_system()
    example = example.uncertain_system()
    yield "the paper's example, smoothed", rs.augment(example, DELAY, ORDER), "smoothed", 0.0887
    yield "the same, its sine in [0.6, 1]", rs.augment(centred, DELAY, ORDER), "smoothed", 0.0864
    yield "the same, sector 1 ± 0.4, filtered", rs.augment(example, 0.0, 0), "filtered", 0.1389
    gain, decay = rs.Uncertainty([[0.0]], [[0.2]], [[1.0]]), rs.Uncertainty([[1]], [[0.1]], [[0]])
    system = rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 0.1]], [gain])
    yield "a gain known to 20%", rs.augment(system, 0.2, 4), "smoothed", 0.0919
    known = rs.Uncertainty([[0.0]], [[0.05]], [[1.0]])
    both = replace(system, uncertainties=(decay, known))
    yield "gain to 5%, decay to 10%", rs.augment(both, 0.2, 4), "smoothed", 0.0594
    drive, sensor = rs.Uncertainty([[1], [0]], [[0, 0.3]], [[0]]), np.zeros((2, 1))
    A = rs.UncertainSystem(
        [[0, -1], [1, -0.5]], [[-2, 0], [1, 0]], [[1, 0]], [[-100, 100]], [[0, 1]], [drive]
    )
    B = replace(A, uncertainties=(drive, rs.Uncertainty(sensor, [[10, 0]], [[1]])))
    yield "A: a measurement that nearly cancels", rs.augment(A, 1.0, 4), "smoothed", 2.228
    yield "B: A with an uncertain sensor", rs.augment(B, 1.0, 4), "smoothed", 2.74
    yield "A without a lag", rs.augment(A, 0.0, 0), "smoothed", 3.1274


def guarantees(repeats: int = 5, most: int | None = None) -> list[dict]:
    """Return the certified errors of plants against the delay model, and the median time."""
    rows = []
    for name, plant, output, reference in islice(plants(), most):
        seconds, design = _median(lambda: rs.minimax_smoother(plant, output), repeats)  # noqa: B023
        copies = plant.system.g > 0
        classical = rs.baselines.fixed_lag_smoother(plant.system, plant.delay, plant.order, copies)
        tuned = rs.baselines.tuned_fixed_lag_smoother(plant, "admissible", output)
        row = {"plant": name, "minimax": design.certified, "reference": reference}
        row |= {"classical": _certified(classical), "tuned": _certified(tuned)}
        rows.append(row | {"route": design.route, "seconds": seconds})
    return rows


def _certified(estimator: rs.Estimator) -> float:
    """Return the certified error against the output of the delay model."""
    return certify(problem_of(estimator))[0]


def _median(
    call: Callable[[], rs.MinimaxSmoother], repeats: int
) -> tuple[float, rs.MinimaxSmoother]:
    times = []
    for _ in range(1 + repeats):
        start = time.perf_counter()
        found = call()
        times.append(time.perf_counter() - start)
    return float(np.median(times[1:])), found
