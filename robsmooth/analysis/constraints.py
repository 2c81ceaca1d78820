r"""The exact worst case of a given estimator under the paper's constraints.

How large can the error of a *given* estimator become? The bound of
`robsmooth.estimators.certificate` holds for all multipliers :math:`\theta`. The least one is not
only a bound: inputs may be mixed by a coin tossed at the start, so that the mean energies that can
be reached form a convex set, and there is no duality gap. The worst input spends energy where and
when it does most harm. Its own energies are the gradient: at the minimum it meets the constraints.

A design's V is this bound with :math:`\theta = \tau\lambda` and more noise: :math:`2V =
\operatorname{tr} B_\xi M(\lambda)^{-1}B_\xi'P`, where :math:`M(\lambda)^{-1} \ge JJ'` and
:math:`B_\xi JJ'B_\xi' = \mathbf{BB}'`.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robsmooth._support import notation
from robsmooth._support.blas import one_thread
from robsmooth._support.tables import Table
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.estimators.certificate import (
    ConstraintProblem,
    largest_fraction,
    least_certificate,
)
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, guarantee, open_loop, scaled, which_loop
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.delay import pade_delay

_DELAY_ORDER = 10


@dataclass(frozen=True, eq=False)
class AnalysisBound(Frozen):
    """The least bound on an estimator's error, and what attains it: see `analysis_bound`.

    Attributes
    ----------
    mean_square : float
        Above the mean square error under every admissible uncertainty, in the squared unit of w;
        infinity where no multipliers give a bound.
    gap : float
        The share of `mean_square` that no admissible input was shown to reach, to first order.
    fraction : float
        The share of the uncertainty for which there is a bound: 0 for a loop unstable without it.
    guarantee : float or None, twice the bound V of the design, where that is for this error
    multipliers : (k + 3g,) array
        theta, s (unit of w)^2; infinity for a constraint that allows its input no energy.
    feedback : (r + 2g, N) array
        The worst input as a feedback of the states X, and after them those of the delay's model.
        Both are empty where there is no bound.

    Examples
    --------
    >>> import robsmooth as rs
    >>> bound = rs.analysis_bound(rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system()))
    >>> bound.mean_square < bound.guarantee, bound.gap < 1e-6  # an admissible input reaches it
    (True, True)
    """

    mean_square: float
    gap: float
    fraction: float
    guarantee: float | None
    multipliers: NDArray[np.float64]
    feedback: Matrix

    def __repr__(self) -> str:
        given = "none" if self.guarantee is None else f"{self.guarantee:.5g}"
        return (
            f"AnalysisBound(mean_square={self.mean_square:.5g}, gap={self.gap:.1g}, "
            f"fraction={self.fraction:.3g}, guarantee={given})"
        )

    def _repr_html_(self) -> str:
        rows = [
            ("largest mean square error, (unit of $w$)²", self.mean_square),
            ("share of it that no input was shown to reach", self.gap),
            ("share of the uncertainty for which there is a bound", self.fraction),
            ("guarantee, $2V$", self.guarantee),
            (r"multipliers $\theta$, s (unit of $w$)²", f"${notation.matrix([self.multipliers])}$"),
        ]
        caption = "The worst that the constraints on the uncertainty allow."
        known = [row for row in rows if row[1] is not None]
        return Table(("", "value"), known, caption, digits=5).html()


@one_thread
def analysis_bound(
    smoother: Estimator,
    output: str = "guaranteed",
    loop: str = "theory",
    *,
    copy_noise: bool | None = None,
) -> AnalysisBound:
    """Return the largest error that the constraints on the uncertainty allow an estimator.

    Where `output` is "smoothed", it is that against a Pade model of order 10 of the delayed w, with
    states of its own: the true delay has no finite state.

    Parameters
    ----------
    smoother, output, loop, copy_noise
        As in `error_covariance`.

    Returns
    -------
    AnalysisBound

    References
    ----------
    I. R. Petersen, V. A. Ugrinovskii and A. V. Savkin, *Robust Control Design Using H-infinity
    Methods*, Springer, 2000, on the S-procedure for stochastic uncertainty constraints.

    Examples
    --------
    >>> import robsmooth as rs
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.analysis_bound(ngcf, "filtered", loop="real").mean_square, 4)
    0.1388
    """
    loop = which_loop(loop, copy_noise)
    opened = open_loop(smoother, output, loop)
    if opened.delay > 0.0:
        opened = _with_delay_model(opened, _DELAY_ORDER)
    proven = guarantee(smoother, output, loop)
    opened, x = scaled(opened)
    fraction, problem, theta = _feasible(opened, smoother.plant)
    if fraction < 1.0:
        return AnalysisBound(math.inf, math.nan, fraction, proven, np.empty(0), np.empty((0, 0)))
    theta = least_certificate(problem, theta)
    point = problem.at(theta)
    return AnalysisBound(
        mean_square=point.mean_square,
        gap=problem.gap(theta),
        fraction=1.0,
        guarantee=proven,
        multipliers=problem.all_multipliers(theta),
        feedback=point.feedback @ problem.states / x,
    )


def _feasible(
    loop: OpenLoop, plant: AugmentedSystem
) -> tuple[float, ConstraintProblem, np.ndarray]:
    """Return the largest fraction of the uncertainty that has a bound, the problem and its theta.

    Where there is none with all constraints, those of the nonlinearities and of the copies by
    themselves are left out: what they let in may have no effect on the error.
    """
    problem = ConstraintProblem(loop, plant)
    fraction, theta = largest_fraction(problem)
    g = plant.system.g
    if fraction < 1.0 and g:
        kept = np.repeat([True, False], [plant.system.k + g, 2 * g])
        reduced = ConstraintProblem(loop, plant, kept)
        larger, found = largest_fraction(reduced)
        if larger > fraction:
            return larger, reduced, found
    return fraction, problem, theta


def _with_delay_model(loop: OpenLoop, order: int) -> OpenLoop:
    """Return the loop with its delay of the truth as a Pade model, in states of its own."""
    model = pade_delay(loop.delay, order, len(loop.truth))
    below, beside = ((0, len(model.F)), (0, 0)), ((0, 0), (0, len(model.F)))
    return replace(
        loop,
        A=np.vstack([np.pad(loop.A, beside), np.hstack([model.G @ loop.truth, model.F])]),
        B=np.pad(loop.B, below),
        inputs=np.pad(loop.inputs, below),
        outputs=np.pad(loop.outputs, beside),
        truth=np.hstack([model.J @ loop.truth, model.H]),
        estimate=np.pad(loop.estimate, beside),
        delay=0.0,
    )
