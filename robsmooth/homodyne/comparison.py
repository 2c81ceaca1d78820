"""Estimators side by side, in the example's loop: with uncertainty, and with its sine."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robsmooth._support.progress import progress_bar
from robsmooth.analysis.constraints import AnalysisBound, analysis_bound
from robsmooth.analysis.covariance import delta_sweep
from robsmooth.analysis.worst_case import WorstCase, worst_case
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.moments import StationaryErrors, stationary_errors
from robsmooth.homodyne.montecarlo import LossOfLockWarning, MeanSquare, monte_carlo
from robsmooth.homodyne.parameters import HomodyneParameters


@dataclass(frozen=True)
class Compared:
    """The errors of one estimator, rad^2, in a real loop, whose copies have no noise."""

    estimator: Estimator
    output: str  # the estimate that it is for: "smoothed", or "filtered" for a filter
    at: tuple[float, ...]  # at the given slopes of the nonlinearity
    worst: WorstCase  # constant uncertainty
    allowed: AnalysisBound  # the worst that the quadratic constraints allow
    simulated: MeanSquare  # in the loop with the sine itself, by the paper's protocol
    slips: int  # in the simulation: without the measurement an estimator is not in lock
    moments: StationaryErrors  # in lock, without sampling

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
    """Find the errors of each estimator and its output, at slopes Delta_2 and in `monte_carlo`."""
    found = {}
    cases = estimators.items()
    for name, (estimator, output) in progress_bar(cases, unit="estimator", shown=progress):
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
