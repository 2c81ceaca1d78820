"""Families of systems that show where robustness pays, by their uncertainty and measurement noise.

The signal has unit variance, and its time constant is the unit of time. `noise` is the root of the
measurement noise's intensity: at 1, the noise in a unit of time is as large as the signal.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.progress import progress_bar
from robsmooth.analysis.constraints import analysis_bound
from robsmooth.analysis.lag import best_lag
from robsmooth.estimators.baselines import fixed_lag_smoother
from robsmooth.estimators.minimax import minimax_smoother
from robsmooth.systems.augmented import augment
from robsmooth.systems.channels import Uncertainty
from robsmooth.systems.system import UncertainSystem

ORDER = 2  # of the delay's model


def uncertain_gain(size: float, noise: float) -> UncertainSystem:
    """A sensor sees the signal; its gain is known to a fraction `size`."""
    gain = Uncertainty([[0.0]], [[size]], [[1.0]])
    A, B1 = [[-1.0]], [[math.sqrt(2.0), 0.0]]
    return UncertainSystem(A, B1, [[1.0]], [[1.0]], [[0.0, noise]], [gain])


def uncertain_resonance(size: float, noise: float) -> UncertainSystem:
    """The signal is a resonance of quality 10; its squared frequency is known to `size`."""
    damping = 0.05
    A, B1 = [[0.0, 1.0], [-1.0, -2.0 * damping]], [[0.0, 0.0], [2.0 * math.sqrt(damping), 0.0]]
    detuning = Uncertainty([[0.0], [1.0]], [[size, 0.0]], [[0.0]])
    return UncertainSystem(A, B1, [[1.0, 0.0]], [[1.0, 0.0]], [[0.0, noise]], [detuning])


def uncertain_reference(size: float, noise: float) -> UncertainSystem:
    """A sensor of uncertain gain sees a disturbance ten times stronger than the signal."""
    B1 = [[math.sqrt(2.0), 0.0, 0.0, 0.0], [0.0, 20.0, 0.0, 0.0]]
    D21 = np.hstack([np.zeros((2, 2)), noise * np.eye(2)])
    gain = Uncertainty([[0.0], [0.0]], [[0.0, size]], [[0.0], [1.0]])
    A, C2 = np.diag([-1.0, -2.0]), [[1.0, 1.0], [0.0, 1.0]]
    return UncertainSystem(A, B1, [[1.0, 0.0]], C2, D21, [gain])


def uncertain_cancellation(size: float, noise: float) -> UncertainSystem:
    """A sensor sees a difference of two signals; how one drives the other is known to `size`."""
    drive = Uncertainty([[1.0], [0.0]], [[0.0, size]], [[0.0]])
    A, B1 = [[0.0, -1.0], [1.0, -0.5]], np.array([[-2.0, 0.0], [1.0, 0.0]]) / math.sqrt(8.0)
    return UncertainSystem(A, B1, [[1.0, 0.0]], [[-1.0, 1.0]], [[0.0, noise]], [drive])


def robustness_map(
    family: Callable[[float, float], UncertainSystem],
    sizes: Sequence[float],
    noises: Sequence[float],
    *,
    progress: bool = False,
) -> NDArray[np.float64]:
    """Return the classical smoother's certified worst error over the minimax one's, (noise, size).

    The delay is that of `best_lag` for the noise. NaN: no estimator has a finite error.
    """
    bound = partial(analysis_bound, output="smoothed", loop="real")
    ratios = np.full((len(noises), len(sizes)), np.nan)
    delays = [best_lag(family(0.0, noise), ORDER)[0] for noise in noises]
    for i, j in progress_bar(list(np.ndindex(ratios.shape)), unit="system", shown=progress):
        system, delay = family(sizes[j], noises[i]), delays[i]
        try:
            robust = bound(minimax_smoother(augment(system, delay, ORDER))).mean_square
        except InfeasibleDesignError:
            continue
        ratios[i, j] = bound(fixed_lag_smoother(system, delay, ORDER)).mean_square / robust
    return ratios
