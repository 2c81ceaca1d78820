"""The results of simulations, from independent paths: errors, standard errors, slips.

The standard error of a mean over N paths is their standard deviation over the root of N.
`docs/source/simulation.md` has the control variates.
"""

import math
from dataclasses import astuple, dataclass
from operator import add
from typing import NamedTuple

import numpy as np

from robsmooth._support import plots, tables
from robsmooth._support.validation import Frozen, Matrix


@dataclass(frozen=True)
class MeanSquare(Frozen):
    """A mean square error over independent paths.

    Attributes
    ----------
    mean_square, standard_error : float
        In the squared unit of what is estimated: rad^2 for a phase. The second is NaN for one path.
    variance_reduction : float, paths needed without control variates, over those with them

    Examples
    --------
    >>> print(rs.MeanSquare(0.1, standard_error=0.002))
    0.1 +- 0.002
    """

    mean_square: float
    standard_error: float
    variance_reduction: float = 1.0

    def __str__(self) -> str:
        return f"{self.mean_square:.6g} +- {self.standard_error:.2g}"


class InadmissibleWarning(RuntimeWarning):
    """The simulated loop left the region in which the theory's constraints hold."""


@dataclass(frozen=True, eq=False)
class SimulationResult(Frozen):
    """Errors of an estimator in the nonlinear loop, as `simulate` measures them.

    Attributes
    ----------
    smoothed, filtered : MeanSquare
        Of the estimates of w one lag back, and of w now, in the squared unit of w.
    constraints : (k + 3g,) array
        E[xi' M_i xi] / E[zeta' N_i zeta], with the arguments before the reference is subtracted, in
        the order of the multipliers: at most one where the uncertainty is admissible.
    violated : (k + 3g,) array
        The fraction of time for which xi' M_i xi > zeta' N_i zeta, with the arguments less the
        reference: the time outside a region where a nonlinearity is Lipschitz.
    equivalent_delta : (r + 2g, h + 2g) array
        The constant uncertainties, and statistically equivalent slopes for the nonlinearities: with
        it, and the same reference, `error_covariance` predicts the errors.
    runs, path_steps, seed : int
        Independent paths, and the steps of all of them, the warm-up included.
    duration, warm_up, step : float, the time averaged, the time before, and a step, s
    """

    smoothed: MeanSquare
    filtered: MeanSquare
    constraints: Matrix
    violated: Matrix
    equivalent_delta: Matrix
    runs: int
    path_steps: int
    duration: float
    warm_up: float
    step: float
    seed: int

    def __repr__(self) -> str:
        return (
            f"SimulationResult(smoothed {self.smoothed}, filtered {self.filtered}; constraints "
            f"used to {self.constraints.max(initial=0.0):.3g}, violated for "
            f"{self.violated.max(initial=0.0):.2%} of the time; {self.runs} runs of "
            f"{self.duration:.4g} s, step {self.step:.4g} s, seed {self.seed}; "
            f"{self.path_steps:.3g} path-steps)"
        )


@dataclass(frozen=True, eq=False)
class SamplePaths(Frozen):
    """A few paths of the loop, made by `sample_paths`.

    Attributes
    ----------
    time : (N,) array, the ends of the steps, s
    y : (paths, N, l) array, the measured record: the mean of dy/dt over the step
    reference : (paths, N, g) array
        The mean of the references at both ends of the step, as `DiscreteSmoother.run` takes it.
    w, delayed : (paths, N, m) arrays, the outputs at `time`, and one lag before
    filtered, smoothed : (paths, N, m) arrays, their estimates, made at `time`
    step, delay : float, s; the second is the lag of the smoothed estimates
    """

    time: Matrix
    y: Matrix
    reference: Matrix
    w: Matrix
    filtered: Matrix
    delayed: Matrix
    smoothed: Matrix
    step: float
    delay: float

    def __repr__(self) -> str:
        paths, steps, measurements = self.y.shape
        return (
            f"SamplePaths({paths} paths of {steps} steps of {self.step:.4g} s, "
            f"lag={self.delay:g} s, {measurements} measurements, {self.w.shape[2]} outputs)"
        )

    def to_frame(self) -> "tables.DataFrame":
        """Return the paths as a pandas data frame, with a row for each path and end of a step."""
        series = [(name, each) for name, each in vars(self).items() if np.ndim(each) == 3]
        columns = {f"{name}[{i}]": x[..., i] for name, x in series for i in range(x.shape[2])}
        return tables.data_frame({"path": range(len(self.y)), "time": self.time}, columns)

    def plot(self, ax: "plots.Axes | None" = None, path: int = 0, output: int = 0) -> "plots.Axes":
        """Draw w and its estimates, each at the time it belongs to; matplotlib is needed."""
        times = self.time - [[0.0], [0.0], [self.delay]]
        found = {"true": self.w, "filtered": self.filtered, "smoothed": self.smoothed}
        curves = {name: each[path, :, output] for name, each in found.items()}
        labels = {"xlabel": "time (s)", "ylabel": f"w[{output}] (unit of $w$)"}
        return plots.draw_curves(ax, times, curves, **labels)


@dataclass(frozen=True, eq=False)
class Moments:
    """Means and variances of values that come in parts."""

    count: int = 0
    means: Matrix | float = 0.0
    squares: Matrix | float = 0.0  # sums of squared deviations from the mean

    @classmethod
    def of(cls, values: Matrix) -> "Moments":
        """Return the moments of values, (variables, paths)."""
        count = values.shape[-1]
        means = values.mean(axis=-1) if count else np.zeros(values.shape[:-1])
        return cls(count, means, ((values - means[..., None]) ** 2).sum(axis=-1))

    def __add__(self, other: "Moments") -> "Moments":
        """Return the moments of all values (Chan, Golub and LeVeque's update)."""
        count, shift = self.count + other.count, other.means - self.means
        share = other.count / max(count, 1)
        squares = self.squares + (other.squares + shift**2 * (self.count * share))
        return Moments(count, self.means + shift * share, squares)

    def mean_square(self, variable: int, plain: int | None = None) -> MeanSquare:
        """Return that of a variable; `plain` is the variable without control variates."""
        if self.count == 0:
            return MeanSquare(math.nan, math.nan)
        squares = self.squares[variable]
        gain = 1.0 if plain is None or squares == 0 else self.squares[plain] / squares
        error = np.sqrt(squares / (self.count - 1 if self.count > 1 else math.nan) / self.count)
        return MeanSquare(float(self.means[variable]), float(error), float(gain))


def control_weights(values: Matrix, controls: Matrix) -> Matrix:
    """Return the regression weights, (values, controls), of values on controls, (., paths)."""
    values = values - values.mean(axis=1, keepdims=True)
    controls = controls - controls.mean(axis=1, keepdims=True)
    scale = np.sqrt((controls**2).sum(axis=1))
    scale[scale == 0.0] = 1.0
    # Two controls may be equal, as without a delay: then the weights are those of least norm.
    weights = np.linalg.lstsq((controls / scale[:, None]).T, values.T, rcond=1e-10)[0]
    return (weights / scale[:, None]).T


class Tally(NamedTuple):
    """What is kept of paths: moments of all, moments of those without a slip, and all slips."""

    all: Moments = Moments()
    locked: Moments = Moments()
    slips: int = 0

    @classmethod
    def of(cls, values: Matrix, slips: Matrix) -> "Tally":
        """Return the tally of values (variables, paths) and slips (paths,)."""
        return cls(Moments.of(values), Moments.of(values[:, slips == 0]), int(slips.sum()))

    def __add__(self, other: "Tally") -> "Tally":
        """Return the tally of all paths."""
        return Tally(*map(add, self, other))

    def state(self) -> tuple[list, int]:
        """Return it as JSON values, without rounding."""
        moments = [[np.asarray(part).tolist() for part in astuple(each)] for each in self[:2]]
        return moments, self.slips

    @classmethod
    def from_state(cls, moments: list, slips: int) -> "Tally":
        """Return the tally with this `state`."""
        return cls(*(Moments(count, *map(np.array, rest)) for count, *rest in moments), slips)
