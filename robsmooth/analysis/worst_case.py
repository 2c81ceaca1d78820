"""The worst constant uncertainty of an estimator."""

from dataclasses import dataclass

import numpy as np

from robsmooth._support.blas import one_thread
from robsmooth._support.validation import Matrix, frozen
from robsmooth.analysis.covariance import error_covariance
from robsmooth.estimators.constant import mean_square, worst_delta
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import guarantee, open_loop, scaled

_STARTS = 16  # corners of the admissible set to search from, besides its centre


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The worst constant uncertainty, as `worst_case` finds it.

    Attributes
    ----------
    Delta : (r + 2g, h + 2g) array
        The uncertainty; channels without an effect have zero blocks.
    mean_square, nominal : float
        The mean square error under it and without uncertainty, in the squared unit of w; infinity
        where the loop is not stable.
    guarantee : float or None, twice the bound V of the design, where that is for this error

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> rs.worst_case(ngcf, "filtered").Delta
    array([[ 0.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0., -1.]])
    """

    Delta: Matrix
    mean_square: float
    nominal: float
    guarantee: float | None

    def __repr__(self) -> str:
        proven = "" if self.guarantee is None else f", guarantee={self.guarantee:.5g}"
        return f"WorstCase(mean_square={self.mean_square:.5g}, nominal={self.nominal:.5g}{proven})"


@one_thread
def worst_case(
    smoother: Estimator,
    output: str = "smoothed",
    loop: str = "theory",
) -> WorstCase:
    """Search for the constant admissible uncertainty with the largest mean square error.

    Parameters
    ----------
    smoother, output, loop
        As in `error_covariance`.

    Returns
    -------
    WorstCase
        With an infinite mean square where an admissible uncertainty makes the loop unstable.

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> rs.worst_case(ngcf, "filtered")
    WorstCase(mean_square=0.2053, nominal=0.12483, guarantee=0.24335)
    """
    opened, _ = scaled(open_loop(smoother, output, loop))
    _, Delta = worst_delta(opened, _STARTS)

    def error(Delta: Matrix) -> float:
        if not np.isfinite(mean_square(opened, Delta)):
            return np.inf
        return float(np.trace(error_covariance(smoother, Delta, output, loop)))

    worst, nominal = error(Delta), error(np.zeros_like(Delta))
    return WorstCase(frozen(Delta), worst, nominal, guarantee(smoother, output, loop))
