"""The exact worst case of a given estimator under the paper's constraints.

It is the least bound of `robsmooth.estimators.certificate` over the multipliers: there is no
duality gap (`docs/source/methods.md`). The energies of the worst input are its gradient.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from robsmooth._support.blas import one_thread
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.estimators import certificate
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import open_loop, scaled, which_loop
from robsmooth.systems.augmented import augment

_DELAY_ORDER = 10


@dataclass(frozen=True, eq=False)
class AnalysisBound(Frozen):
    """The least bound on an error that `analysis_bound` finds, and the input that attains it.

    Attributes
    ----------
    mean_square : float, in the squared unit of w
        Bound for every admissible uncertainty; infinity where no multipliers give one.
    gap : float, relative, from `mean_square` to the error under an admissible input, to first order
    fraction : float, share of the uncertainty that has a bound: 0 for a loop unstable without it
    multipliers : (k + 3g,) array, empty without a bound
        theta, s (unit of w)^2; infinity for a constraint that allows its input no energy.
    feedback : (r + 2g, N) array, empty without a bound
        The worst input as a feedback of the states X, those of the delay's model included.
    """

    mean_square: float
    gap: float
    fraction: float
    multipliers: Matrix
    feedback: Matrix

    def __repr__(self) -> str:
        errors = f"mean_square={self.mean_square:.5g}, gap={self.gap:.1g}"
        return f"AnalysisBound({errors}, fraction={self.fraction:.3g})"


@one_thread
def analysis_bound(
    smoother: Estimator,
    output: str = "guaranteed",
    loop: str = "theory",
    *,
    copy_noise: bool | None = None,
) -> AnalysisBound:
    """Return the largest error that the constraints on the uncertainty allow an estimator.

    The smoothed error is against a Pade model of order 10: the true delay has no finite state.

    Parameters
    ----------
    smoother, output, loop, copy_noise : as in `error_covariance`

    References
    ----------
    I. R. Petersen, V. A. Ugrinovskii and A. V. Savkin, *Robust Control Design Using H-infinity
    Methods*, Springer, 2000, on the S-procedure for stochastic uncertainty constraints.

    Examples
    --------
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.analysis_bound(ngcf, "filtered", loop="real").mean_square, 4)
    0.1388
    """
    loop = which_loop(loop, copy_noise)
    opened = open_loop(smoother, output, loop)
    if opened.delay > 0.0:
        plant = smoother.plant
        finer = augment(plant.system, plant.delay, _DELAY_ORDER, J_21=plant.J_21)
        opened = certificate.model_loop(replace(smoother, plant=finer), loop)
    opened, x = scaled(opened)
    problem, g = certificate.ConstraintProblem(opened, smoother.plant), smoother.plant.system.g
    mean_square, fraction, theta = certificate.certify(problem)
    if fraction < 1.0 and g:
        # the input of a nonlinearity, or of a copy, may have no effect by itself
        differences = np.repeat([True, False], [len(smoother.plant.M_i) - 2 * g, 2 * g])
        reduced = certificate.ConstraintProblem(opened, smoother.plant, differences)
        found = certificate.certify(reduced)
        if found[1] > fraction:
            problem, (mean_square, fraction, theta) = reduced, found
    if fraction < 1.0:
        return AnalysisBound(math.inf, math.nan, fraction, np.empty(0), np.empty((0, 0)))
    return AnalysisBound(
        mean_square=mean_square,
        gap=problem.gap(theta),
        fraction=1.0,
        multipliers=problem.all_multipliers(theta),
        feedback=problem.at(theta).feedback @ problem.states / x,
    )
