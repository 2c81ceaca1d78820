"""The worst constant uncertainty of an estimator."""

from dataclasses import dataclass

import numpy as np

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.tables import table_of_values
from robsmooth._support.validation import Matrix, frozen
from robsmooth.analysis.covariance import error_covariance
from robsmooth.estimators.constant import mean_square, worst_delta
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import guarantee, open_loop, scaled


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
    >>> round(rs.worst_case(ngcf, "filtered").tightness, 3)
    0.844
    """

    Delta: Matrix
    mean_square: float
    nominal: float
    guarantee: float | None

    @property
    def tightness(self) -> float | None:
        """The mean square error relative to the guarantee; None without one."""
        return None if self.guarantee is None else self.mean_square / self.guarantee

    def __repr__(self) -> str:
        proven = ""
        if self.guarantee is not None:
            proven = f", guarantee={self.guarantee:.5g}, tightness={self.tightness:.3f}"
        return f"WorstCase(mean_square={self.mean_square:.5g}, nominal={self.nominal:.5g}{proven})"

    def _repr_html_(self) -> str:
        rows = [
            ("nominal", self.nominal),
            ("worst constant uncertainty", self.mean_square),
            ("guarantee, $2V$", self.guarantee),
            ("worst relative to the guarantee", self.tightness),
            (r"$\Delta$ of the worst", f"${notation.matrix(self.Delta)}$"),
        ]
        caption = "Mean square errors, in the squared unit of $w$, and the worst uncertainty."
        return table_of_values(rows, caption, digits=5).html()


@one_thread
def worst_case(
    smoother: Estimator,
    output: str = "smoothed",
    loop: str = "theory",
    *,
    starts: int = 16,
) -> WorstCase:
    """Search for the constant admissible uncertainty with the largest mean square error.

    Parameters
    ----------
    smoother, output, loop
        As in `error_covariance`.
    starts : int, number of corners of the admissible set to start from, besides its centre

    Returns
    -------
    WorstCase
        With an infinite mean square where an admissible uncertainty makes the loop unstable.

    See Also
    --------
    analysis_bound : a bound for all that the constraints allow.

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> rs.worst_case(ngcf, "filtered")
    WorstCase(mean_square=0.2053, nominal=0.12483, guarantee=0.24335, tightness=0.844)
    """
    opened, _ = scaled(open_loop(smoother, output, loop))
    starts = validation.integer("starts", starts, low=1)
    _, Delta = worst_delta(opened, starts)

    def error(Delta: Matrix) -> float:
        if not np.isfinite(mean_square(opened, Delta)):
            return np.inf
        return float(np.trace(error_covariance(smoother, Delta, output, loop)))

    worst, nominal = error(Delta), error(np.zeros_like(Delta))
    return WorstCase(frozen(Delta), worst, nominal, guarantee(smoother, output, loop))
