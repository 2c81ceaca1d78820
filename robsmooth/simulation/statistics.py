r"""What is made of the paths' results: mean squares, standard errors and the count of slips.

Paths are independent. Over N of them, with :math:`v_i` the result of path i,

.. math::

    \overline v = \frac1N\sum_i v_i,\qquad
    \text{standard error} = \sqrt{\frac{\sum_i (v_i - \overline v)^2}{N(N - 1)}} .

With control variates :math:`c_i` of known mean :math:`\mu` the results are
:math:`v_i - \beta'(c_i - \mu)` instead. The weights :math:`\beta` must not depend on these paths:
those of a regression on the same paths bias the mean, by a part of its (small) standard error that
spoils the intervals. They come from a pilot, of other paths.

References
----------
S. Asmussen and P. W. Glynn, "Stochastic Simulation", Springer, 2007, Section V.2.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from robsmooth._support import notation, validation

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MeanSquare:
    """A mean square error over independent paths.

    Attributes
    ----------
    mean_square, standard_error : float
        In the squared unit of the estimated quantity: rad^2 for a phase. The second is not a
        number for a single path.
    variance_reduction : float
        How many times as many paths it would take without control variates.

    Examples
    --------
    >>> import robsmooth as rs
    >>> error = rs.MeanSquare(0.1, standard_error=0.002)
    >>> print(error, [round(end, 4) for end in error.interval(0.95)])
    0.1 +- 0.002 [0.0961, 0.1039]
    """

    mean_square: float
    standard_error: float
    variance_reduction: float = 1.0

    def __str__(self) -> str:
        return f"{self.mean_square:.6g} +- {self.standard_error:.2g}"

    def _repr_latex_(self) -> str:
        return f"${notation.estimate(self.mean_square, self.standard_error)}$"

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Return the interval that holds the mean with this probability."""
        confidence = validation.real(
            "confidence", confidence, low=0.0, high=1.0, low_open=True, high_open=True
        )
        reach = float(ndtri((1 + confidence) / 2)) * self.standard_error
        return self.mean_square - reach, self.mean_square + reach


class Moments:
    """Means and variances of values that come in parts, whatever the parts' sizes."""

    def __init__(self, variables: int | tuple[int, ...]):
        self.count, self.means = 0, np.zeros(variables)
        self.squares = np.zeros(variables)  # sums of squared deviations from the mean

    def add(self, values: Floats) -> None:
        """Add values, (variables, paths)."""
        added = Moments(0)
        added.count = values.shape[-1]
        if added.count > 0:
            added.means = values.mean(axis=-1)
            added.squares = ((values - added.means[..., None]) ** 2).sum(axis=-1)
        self.merge(added)

    def merge(self, other: "Moments") -> None:
        """Add other values, of which the moments are given (Chan, Golub and LeVeque's update)."""
        if other.count == 0:
            return
        count = self.count + other.count
        shift = other.means - self.means
        self.squares += other.squares + shift**2 * (self.count * other.count / count)
        self.means += shift * (other.count / count)
        self.count = count

    @property
    def standard_errors(self) -> Floats:
        """Of the means; not numbers where there are less than two values."""
        return np.sqrt(self.squares / (self.count - 1 if self.count > 1 else math.nan) / self.count)

    def mean_square(self, variable: int, plain: int | None = None) -> MeanSquare:
        """Return that of a variable; `plain` is the same one without control variates."""
        if self.count == 0:
            return MeanSquare(math.nan, math.nan)
        squares = self.squares[variable]
        gain = 1.0 if plain is None or squares == 0 else self.squares[plain] / squares
        error = self.standard_errors[variable]
        return MeanSquare(float(self.means[variable]), float(error), float(gain))

    def state(self) -> dict:
        """All of it as JSON values, every bit."""
        return {**vars(self), "means": self.means.tolist(), "squares": self.squares.tolist()}

    @classmethod
    def from_state(cls, state: dict) -> "Moments":
        """Return what `state` was taken of."""
        moments = cls(0)
        moments.count = state["count"]
        moments.means, moments.squares = np.array(state["means"]), np.array(state["squares"])
        return moments


def control_weights(values: Floats, controls: Floats) -> Floats:
    """Return weights, (values, controls), of controls that leave least of values: (., paths)."""
    values = values - values.mean(axis=1, keepdims=True)
    controls = controls - controls.mean(axis=1, keepdims=True)
    scale = np.sqrt((controls**2).sum(axis=1))
    scale[scale == 0.0] = 1.0
    # Where two controls are the same, as without a delay, the weights of least norm.
    weights = np.linalg.lstsq((controls / scale[:, None]).T, values.T, rcond=1e-10)[0]
    return (weights / scale[:, None]).T


class Tally:
    """All that is kept of the paths: moments of all and of those that never slipped, and slips."""

    def __init__(self, variables: int):
        self.all, self.locked = Moments(variables), Moments(variables)
        self.slips, self.slipped_paths = 0, 0

    def add(self, values: Floats, slips: Floats) -> None:
        """Add paths: the variables (variables, paths) and the slips (paths,)."""
        kept = slips == 0
        self.all.add(values)
        self.locked.add(values[:, kept])
        self.slips += int(slips.sum())
        self.slipped_paths += int((~kept).sum())

    def merge(self, other: "Tally") -> None:
        """Add the paths of another tally."""
        self.all.merge(other.all)
        self.locked.merge(other.locked)
        self.slips += other.slips
        self.slipped_paths += other.slipped_paths

    def state(self) -> dict:
        """All of it as JSON values, every bit."""
        return {**vars(self), "all": self.all.state(), "locked": self.locked.state()}

    @classmethod
    def from_state(cls, state: dict) -> "Tally":
        """Return what `state` was taken of."""
        tally = cls(0)
        tally.all, tally.locked = (Moments.from_state(state[name]) for name in ("all", "locked"))
        tally.slips, tally.slipped_paths = state["slips"], state["slipped_paths"]
        return tally
