r"""Statistical linearisation: a slope stands for each nonlinearity of a loop.

For a Gaussian argument v, :math:`E(\psi(v) - sv)^2` is least at :math:`s = E[\psi(v)v]/E[v^2]`. The
variance of v depends on the slopes: an iteration finds both (`docs/source/simulation.md`).
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from robsmooth._support.errors import UnstableLoopError

_ITERATIONS = 200
_ROUNDING = 1e-9  # a change below this that no longer shrinks is rounding
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(32)

Vector = NDArray[np.float64]


def equivalent_slopes(
    start: Vector,
    variances: Callable[[Vector], Vector],
    slopes: Callable[[Vector], Vector],
    *,
    tolerance: float,
    unit: Vector | float = 1.0,
    largest: float = math.inf,
) -> Vector:
    """Return the slopes s = slopes(variances(s)), iterated from `start`.

    The iteration ends where they change by less than the tolerance, in their unit, or by rounding.
    An UnstableLoopError says that it does not end, or that a variance exceeds the largest.
    """
    found, before, part, size = start, np.zeros(len(start)), 1.0, math.inf
    for _ in range(_ITERATIONS):
        now = variances(found)
        if now.max(initial=0.0) > largest:
            break
        change = (slopes(now) - found) / unit
        bend = before - change
        # all of the change, or a secant step where the slopes oscillate
        part = part * float(before @ bend) / float(bend @ bend) if before @ change < 0.0 else 1.0
        found, before = found + part * unit * change, change
        size_before, size = size, np.abs(change).max(initial=0.0)
        if size < tolerance or size_before <= size < _ROUNDING:
            return found
    raise UnstableLoopError("the loop is not in lock: the statistically linear loop diverges")


def of_function(function: Callable[[NDArray], NDArray], variance: float) -> float:
    """Return the slope of a vectorised function, by quadrature."""
    if variance == 0.0:
        return 0.0
    deviation = math.sqrt(variance)
    with np.errstate(all="ignore"):
        values = function(deviation * _NODES)
    values = np.where(np.isfinite(values), values, 0.0)  # no path need reach the outermost nodes
    return float(_WEIGHTS @ (values * _NODES) / (_WEIGHTS.sum() * deviation))
