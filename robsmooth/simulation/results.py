"""What simulations return: errors with their standard errors, and sample paths."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robsmooth._support import notation
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix, frozen
from robsmooth.simulation.statistics import MeanSquare


class InadmissibleWarning(RuntimeWarning):
    """The simulated loop left the region in which the theory's constraints hold.

    See Also
    --------
    simulate : Warns.

    Examples
    --------
    >>> import warnings
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", rs.InadmissibleWarning)  # make it an error
    ...     result = rs.simulate(rs.baselines.kalman_bucy(system), runs=4, duration=5.0)
    """


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedError(MeanSquare):
    """An error's covariance over independent paths; its trace is the mean square.

    Attributes
    ----------
    covariance : (m, m) array
        Of the error, about zero, in the squared unit of w.
    covariance_error : (m, m) array
        Standard error of each entry.

    See Also
    --------
    simulate : Makes it.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> result = rs.simulate(rs.baselines.kalman_bucy(system), runs=8, duration=5.0)
    >>> result.filtered.covariance.shape
    (1, 1)
    >>> 0.0 < result.filtered.standard_error < result.filtered.mean_square
    True
    """

    covariance: Matrix
    covariance_error: Matrix

    def __repr__(self) -> str:
        return f"SimulatedError({self}, covariance={notation.array(self.covariance)})"


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """Errors of an estimator in the nonlinear loop.

    Attributes
    ----------
    smoothed, filtered : SimulatedError
        Of the estimates of w one lag back, and of w now: ``.mean_square``, ``.standard_error``,
        ``.covariance``, ``.covariance_error``, in the squared unit of w.
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
    runs : int
        Independent paths.
    path_steps : int
        Steps simulated, over all paths, the warm-up included.
    wall_time : float
        s.
    duration : float
        Of a path, without the warm-up, s.
    warm_up : float
        Simulated before averaging began, s.
    step : float
        s.
    seed : int

    See Also
    --------
    simulate : Makes it.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> smoother = rs.baselines.fixed_lag_smoother(system, delay=0.2, order=2)
    >>> result = rs.simulate(smoother, runs=8, duration=5.0)
    >>> result.smoothed.mean_square < result.filtered.mean_square
    True
    """

    smoothed: SimulatedError
    filtered: SimulatedError
    constraints: NDArray[np.float64]
    violated: NDArray[np.float64]
    equivalent_delta: Matrix
    runs: int
    path_steps: int
    wall_time: float
    duration: float
    warm_up: float
    step: float
    seed: int

    def __post_init__(self):
        for value in (self.constraints, self.violated, self.equivalent_delta):
            frozen(value)

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
    """A few paths of the loop, to look at and to try estimators on.

    Attributes
    ----------
    time : (N,) array
        The ends of the steps, s.
    y : (paths, N, l) array
        The measured record: the mean of dy/dt over the step that ends at `time`.
    reference : (paths, N, g) array
        What was taken off the nonlinearities' arguments: the mean of its values at the ends of the
        same step, as `DiscreteSmoother.run` takes it beside y. Zero without a reference.
    w : (paths, N, m) array
        The outputs at `time`.
    filtered : (paths, N, m) array
        The estimates of w at `time`, made then.
    delayed : (paths, N, m) array
        The outputs one lag before `time`.
    smoothed : (paths, N, m) array
        The estimates of `delayed`, made at `time`.
    step : float
        s.
    delay : float
        The lag of the smoothed estimates, s.

    See Also
    --------
    sample_paths : Makes them.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> smoother = rs.baselines.fixed_lag_smoother(system, delay=0.2, order=2)
    >>> paths = rs.sample_paths(smoother, runs=2, duration=5.0)
    >>> paths.y.shape, paths.smoothed.shape
    ((2, 125, 1), (2, 125, 1))
    """

    time: NDArray[np.float64]
    y: NDArray[np.float64]
    reference: NDArray[np.float64]
    w: NDArray[np.float64]
    filtered: NDArray[np.float64]
    delayed: NDArray[np.float64]
    smoothed: NDArray[np.float64]
    step: float
    delay: float

    def __repr__(self) -> str:
        paths, steps, measurements = self.y.shape
        return (
            f"SamplePaths({paths} paths of {steps} steps of {self.step:.4g} s, "
            f"lag={self.delay:g} s, {measurements} measurements, {self.w.shape[2]} outputs)"
        )
