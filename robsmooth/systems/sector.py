"""The sector of a function: its least and largest slope up to a given argument."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support import validation
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.systems.channels import Nonlinearity
from robsmooth.systems.functions import Combination, Function, check_function, compiled, on_arrays

_POINTS = 2**13  # even, so that zero is not one of them
_UNEVEN = 0.1  # of the slopes' second differences: where they differ by more, there is a corner
_ROUNDING = 1e-10  # of the slopes: smaller second differences are rounding
_STEEPENING = 1.1  # the range of slopes over that of means of two: above it they have no bound
_FLAT = 1e-9  # of the slopes: a smaller range of them is rounding


@dataclass(frozen=True)
class Sector(Frozen):
    """A function f and its slopes from -reach to reach, as `sector` finds them.

    Attributes
    ----------
    function : callable
    reach, lower, upper : float
        The largest argument, and the least and the largest slope up to it.
    slope, half_width : float, the slope in the middle, the Lipschitz constant of f less its line
    """

    function: Function
    reach: float
    lower: float
    upper: float
    slope: float
    half_width: float

    def nonlinearity(
        self, B: ArrayLike, C: ArrayLike, D: ArrayLike, noise: float = 1.0
    ) -> Nonlinearity:
        """Return f(C x), which drives the state through B and y through D, as a `Nonlinearity`.

        It is scaled: its Lipschitz constant, when centred, is 1, and the intensity of a noise
        `noise` [B; D] through its channel is 1 (Assumption 1).
        """
        noise = validation.positive("noise", noise)
        argument = noise / self.half_width
        given = Nonlinearity(B, C, D, self.half_width)
        return Nonlinearity(
            B=noise * given.B,
            C=given.C / argument,
            D=noise * given.D,
            function=compiled(Combination(self.function, argument, value=1.0 / noise)),
            sector=(self.lower / self.half_width, self.upper / self.half_width),
        )


def sector(function: Function, reach: float) -> Sector:
    """Find the least and the largest slope of a function up to a given size of its argument.

    They are accurate to about 1e-9 where f is smooth. `Sector.nonlinearity` puts f in a system.

    Parameters
    ----------
    function : callable f, vectorised or compiled by numba, and zero at zero
    reach : float, the largest argument; beyond it nothing is guaranteed

    Raises
    ------
    ValueError
        For a function that is not finite, of unbounded slope or linear.

    Examples
    --------
    The noise of a sensor that saturates has the intensity 0.1:

    >>> tanh = rs.sector(np.tanh, reach=0.6)
    >>> sensor = tanh.nonlinearity(B=[[0.0]], C=[[1.0]], D=[[1.0]], noise=0.1)
    >>> rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[0]], [[0, 0.1]], [], [sensor]).C2.round(4)
    array([[0.8558]])
    """
    check_function("function", function)
    reach = validation.positive("reach", reach)
    x = reach * np.linspace(-1.0, 1.0, _POINTS)
    with np.errstate(all="ignore"):
        values = np.asarray(on_arrays(function)(x), dtype=float)
    if not np.isfinite(values).all():
        first = int(np.argmin(np.isfinite(values)))
        raise ValueError(f"function must be finite, got {values[first]} at {x[first]:.5g}")
    slopes = np.diff(values) / np.diff(x)
    if np.ptp(slopes) > _STEEPENING * np.ptp(slopes[2:] + slopes[:-2]) / 2:
        at = f"near {x[np.abs(slopes).argmax()]:.5g}"
        raise ValueError(f"function must have slopes within bounds, got ever larger ones {at}")
    lower, upper = 0.0 - _largest(-slopes), _largest(slopes)
    if not upper - lower > _FLAT * max(abs(lower), abs(upper)):
        line = f"a line of slope {upper:.5g}, which belongs into A and C2"
        raise ValueError(f"function must not be linear, got {line}")
    return Sector(function, reach, lower, upper, (lower + upper) / 2, (upper - lower) / 2)


def _largest(slopes: Matrix) -> float:
    """Return the largest slope from means over equal intervals, by a parabola if it is smooth."""
    best = int(slopes.argmax())
    around = slopes[max(best - 2, 0) :][:5] if best < len(slopes) - 3 else slopes[-5:]
    bends = np.diff(around, 2)
    if np.ptp(bends) > _UNEVEN * np.abs(bends).max() + _ROUNDING * np.abs(slopes).max():
        return float(slopes[best])  # a corner
    middle = min(max(best, 1), len(slopes) - 2)
    first, second, third = slopes[middle - 1 : middle + 2]
    bend = first - 2 * second + third
    t = np.clip([-1.5, (first - third) / (2 * bend or 1.0), 1.5], -1.5, 1.5)
    parabola = second + t * (third - first) / 2 + (t**2 - 1 / 12) * bend / 2
    return float(parabola.max())
