"""Estimators side by side, in the example's loop: with uncertainty, and with its sine."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robsmooth._support.progress import progress_bar
from robsmooth.analysis.constraints import AnalysisBound, analysis_bound
from robsmooth.analysis.covariance import delta_sweep
from robsmooth.analysis.worst_case import WorstCase, worst_case
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.homodyne.moments import StationaryErrors, stationary_errors
from robsmooth.homodyne.montecarlo import LossOfLockWarning, MeanSquare, monte_carlo
from robsmooth.homodyne.parameters import HomodyneParameters


@dataclass(frozen=True)
class Compared:
    """The errors of one estimator in a real loop, whose copies have no noise.

    Attributes
    ----------
    estimator : Estimator
    output : str
        The estimate that it is for: "smoothed", or "filtered" for a filter.
    at : tuple of float
        Mean square errors at the given slopes of the nonlinearity, rad^2.
    worst : WorstCase
        The worst constant uncertainty.
    allowed : AnalysisBound
        The worst that the quadratic constraints allow.
    simulated : MeanSquare
        The error in the loop with the sine itself, by the paper's protocol, rad^2.
    slips : int
        Cycle slips in the simulation: an estimator that ignores the measurement is not in lock.
    moments : StationaryErrors
        The error in lock, without sampling.
    """

    estimator: Estimator
    output: str
    at: tuple[float, ...]
    worst: WorstCase
    allowed: AnalysisBound
    simulated: MeanSquare
    slips: int
    moments: StationaryErrors

    @property
    def promised(self) -> float | None:
        """Twice the design's bound V, rad^2: what it promises of the error of its cost."""
        robust = isinstance(self.estimator, RobustSmoother)
        return self.estimator.mean_square_bound if robust else None

    @property
    def exact(self) -> float:
        """The error in the loop with the sine, from the moments, rad^2."""
        return getattr(self.moments, self.output)


def compare(
    estimators: Mapping[str, tuple[Estimator, str]],
    parameters: HomodyneParameters,
    slopes: Sequence[float],
    *,
    progress: bool = False,
    **simulation,
) -> dict[str, Compared]:
    """Find the errors of each estimator, all with the same noise in the simulation.

    Parameters
    ----------
    estimators : mapping
        From a name to an estimator and the output, "smoothed" or "filtered", to judge it by.
    parameters : HomodyneParameters
    slopes : sequence of float
        Of the nonlinearity, the paper's Delta_2.
    progress : bool
        Show a progress bar.
    **simulation
        For `monte_carlo`: runs, seed and so on.

    Returns
    -------
    dict of Compared
    """
    found = {}
    cases = progress_bar(estimators.items(), unit="estimator", shown=progress)
    for name, (estimator, output) in cases:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LossOfLockWarning)  # the result has the slips
            result = monte_carlo(parameters, estimator, "paper", **simulation)
        found[name] = Compared(
            estimator=estimator,
            output=output,
            at=tuple(delta_sweep(estimator, slopes, output, loop="real")[:, 0, 0].tolist()),
            worst=worst_case(estimator, output, loop="real"),
            allowed=analysis_bound(estimator, output, loop="real"),
            simulated=getattr(result, output),
            slips=result.slips,
            moments=stationary_errors(parameters, estimator),
        )
    return found
