"""How long a design and a sweep over its uncertainty take: what a slider waits for.

The paper's example near its least bound, and Fig. 4 at 101 points, after a first call of each.
"""

import time
from collections.abc import Callable

import numpy as np

from robsmooth import augment, delta_sweep, design_smoother, homodyne
from robsmooth.paper.published import DELAY, ORDER

TAU, MULTIPLIERS = 1.0987e-6, (1.0, 0.4999, 1e-4, 1e-4)
SLOPES = np.linspace(-1.0, 1.0, 101)
AIM = 0.050  # s, for both together


def design_and_sweep(repeats: int = 31) -> dict[str, float]:
    """Return the median seconds of a design, of a sweep with it, and of both in turn."""
    plant = augment(homodyne.PAPER.uncertain_system(), DELAY, ORDER)
    smoother = design_smoother(plant, TAU, MULTIPLIERS)

    def design():
        return design_smoother(plant, TAU, MULTIPLIERS)

    def both():
        return delta_sweep(design(), SLOPES)

    return {
        "design": _median(design, repeats),
        "sweep": _median(lambda: delta_sweep(smoother, SLOPES), repeats),
        "both": _median(both, repeats),
    }


def _median(call: Callable[[], object], repeats: int) -> float:
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))
