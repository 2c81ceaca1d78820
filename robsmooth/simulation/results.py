"""What simulations return: errors with their standard errors, and sample paths."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robsmooth._support import notation
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix
from robsmooth.simulation.statistics import MeanSquare

Floats = NDArray[np.float64]


class InadmissibleWarning(RuntimeWarning):
    """The simulated loop left the region in which the theory's constraints hold.

    Examples
    --------
    >>> import warnings
    >>> import robsmooth as rs
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", rs.InadmissibleWarning)  # make it an error
    """


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedError(MeanSquare):
    """An error's covariance over the paths of `simulate`; its trace is the mean square.

    Attributes
    ----------
    covariance, covariance_error : (m, m) arrays
        Of the error, about zero, and the standard error of each entry, in the squared unit of w.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 0.1]])
    >>> result = rs.simulate(rs.baselines.kalman_bucy(system), runs=8, duration=5.0)
    >>> result.filtered.covariance.shape, result.filtered.covariance_error.shape
    ((1, 1), (1, 1))
    """

    covariance: Matrix
    covariance_error: Matrix

    def __repr__(self) -> str:
        return f"SimulatedError({self}, covariance={notation.array(self.covariance)})"


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """Errors of an estimator in the nonlinear loop, as `simulate` measures them.

    Attributes
    ----------
    smoothed, filtered : SimulatedError
        Of the estimates of w one lag back, and of w now, in the squared unit of w.
    constraints : (k + 3g,) array
        How much of each of the theory's constraints is used, in the order of the multipliers:
        E[xi' M_i xi] / E[zeta' N_i zeta], at most one where the uncertainty is admissible. The
        theory has no reference: in zeta are the nonlinearities' whole arguments.
    violated : (k + 3g,) array
        The fraction of time for which xi' M_i xi > zeta' N_i zeta, where in zeta are the arguments
        less the reference. For a nonlinearity that is Lipschitz in a region only, the time that is
        spent outside.
    equivalent_delta : (r + 2g, h + 2g) array
        The constant uncertainties, and for the nonlinearities the statistically equivalent slopes
        of the Gaussian loop that they make: with it, and the same reference, `error_covariance`
        predicts the errors.
    runs, path_steps, seed : int
        Independent paths, and the steps of all of them, the warm-up included.
    duration, warm_up, step, wall_time : float
        What of a path is averaged, what is simulated before, a step, and the time it took, s.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 0.1]])
    >>> result = rs.simulate(rs.baselines.kalman_bucy(system), runs=8, duration=5.0)
    >>> result.filtered.standard_error < result.filtered.mean_square, result.runs
    (True, 8)
    """

    smoothed: SimulatedError
    filtered: SimulatedError
    constraints: Floats
    violated: Floats
    equivalent_delta: Matrix
    runs: int
    path_steps: int
    wall_time: float
    duration: float
    warm_up: float
    step: float
    seed: int

    def __repr__(self) -> str:
        return (
            f"SimulationResult(smoothed {self.smoothed}, filtered {self.filtered}, {self._setting})"
        )

    def _repr_html_(self) -> str:
        rows = [
            (name, error._repr_latex_(), f"${notation.matrix(error.covariance)}$")
            for name, error in (("smoothed", self.smoothed), ("filtered", self.filtered))
        ]
        columns = ("estimate", "mean square error", "covariance")
        caption = f"The nonlinear loop, in the squared unit of $w$; {self._setting}."
        return Table(columns, rows, caption).html()

    @property
    def _setting(self) -> str:
        return (
            f"constraints used to {self.constraints.max(initial=0.0):.3g}, violated for "
            f"{self.violated.max(initial=0.0):.2%} of the time; {self.runs} runs of "
            f"{self.duration:.4g} s, step {self.step:.4g} s, seed {self.seed}; "
            f"{self.path_steps:.3g} path-steps in {self.wall_time:.2g} s"
        )


@dataclass(frozen=True, eq=False)
class SamplePaths:
    """A few paths of the loop, of `sample_paths`, to look at and to try estimators on.

    Attributes
    ----------
    time : (N,) array
        The ends of the steps, s.
    y : (paths, N, l) array
        The measured record: the mean of dy/dt over the step that ends at `time`.
    reference : (paths, N, g) array
        What was taken off the nonlinearities' arguments: the mean of its values at the ends of the
        same step, as `DiscreteSmoother.run` takes it beside y. Zero without a reference.
    w, delayed : (paths, N, m) arrays
        The outputs at `time`, and one lag before.
    filtered, smoothed : (paths, N, m) arrays
        The estimates of `w` and of `delayed`, made at `time`.
    step, delay : float
        The step, and the lag of the smoothed estimates, s.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> rs.sample_paths(kalman, runs=2, duration=1e-4).y.shape
    (2, 223, 1)
    """

    time: Floats
    y: Floats
    reference: Floats
    w: Floats
    filtered: Floats
    delayed: Floats
    smoothed: Floats
    step: float
    delay: float

    def __repr__(self) -> str:
        paths, steps, measurements = self.y.shape
        return (
            f"SamplePaths({paths} paths of {steps} steps of {self.step:.4g} s, "
            f"lag={self.delay:g} s, {measurements} measurements, {self.w.shape[2]} outputs)"
        )
