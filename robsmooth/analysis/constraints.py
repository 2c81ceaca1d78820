"""The exact worst case of a given estimator under the paper's constraints.

It is the least bound of `robsmooth.estimators.certificate` over the multipliers: there is no
duality gap (`docs/source/methods.md`). The energies of the worst input are its gradient.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from robsmooth._support.blas import one_thread
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.estimators.certificate import NONE, ConstraintProblem, certify, model_loop
from robsmooth.estimators.constant import mean_square
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, open_loop, scaled, which_loop
from robsmooth.systems.augmented import AugmentedSystem, augment

_DELAY_ORDERS = (10, 14, 20, 40, 60, 80)
_AGREEMENT = 1e-3  # of bounds with two orders, and of the worst errors with delay and model


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

    For the smoothed error the delay has a Pade model of order 14 to 80. The bound agrees to 0.1%
    with that of the order before, and under the worst input so do model and exact delay.

    Source: I. R. Petersen, V. A. Ugrinovskii and A. V. Savkin, *Robust Control Design Using
    H-infinity Methods*, Springer, 2000, on the S-procedure for stochastic uncertainty
    constraints.

    Parameters
    ----------
    smoother, output, loop, copy_noise : as in `error_covariance`

    Raises
    ------
    ArithmeticError
        Where they do not agree at order 80: the delay is very long for the estimator.

    Examples
    --------
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> round(rs.analysis_bound(ngcf, "filtered", loop="real").mean_square, 4)
    0.1388
    """
    loop = which_loop(loop, copy_noise)
    opened, plant = open_loop(smoother, output, loop), smoother.plant
    if not opened.delay:
        return _least_bound(opened, plant)
    # the own delay model has a bound where a finer one has, and nearly the same multipliers
    found, before = _least_bound(model_loop(smoother, loop), plant), 0.0
    for order in _DELAY_ORDERS:
        if math.isinf(found.mean_square):
            return found
        finer = augment(plant.system, plant.delay, order, J_21=plant.J_21)
        modelled = replace(smoother, plant=finer)
        model = model_loop(modelled, loop)
        found = _least_bound(model, plant, found.multipliers)
        if abs(before - found.mean_square) <= _AGREEMENT * min(before, found.mean_square):
            both = model, open_loop(modelled, output, loop)
            closed = (scaled(replace(each, outputs=found.feedback))[0] for each in both)
            error, exact = (mean_square(each, np.eye(len(found.feedback))) for each in closed)
            if abs(error - exact) <= _AGREEMENT * exact:
                return found
        before = found.mean_square
    raise ArithmeticError(
        f"the certified error needs a model of the delay of an order above {order}, because "
        f"{plant.delay:g} s is very long for this estimator: take a shorter delay"
    )


def _least_bound(opened: OpenLoop, plant: AugmentedSystem, start: Matrix = NONE) -> AnalysisBound:
    """Return the least bound on an error without delay, as `certify` finds it."""
    opened, x = scaled(opened)
    problem, g = ConstraintProblem(opened, plant), plant.system.g
    bound, fraction, theta = certify(problem, start)
    if fraction < 1.0 and g:
        # the input of a nonlinearity, or of a copy, may have no effect by itself
        differences = np.repeat([True, False], [len(plant.M_i) - 2 * g, 2 * g])
        reduced = ConstraintProblem(opened, plant, differences)
        found = certify(reduced)
        if found[1] > fraction:
            problem, (bound, fraction, theta) = reduced, found
    if fraction < 1.0:
        return AnalysisBound(math.inf, math.nan, fraction, np.empty(0), np.empty((0, 0)))
    return AnalysisBound(
        mean_square=bound,
        gap=problem.gap(theta),
        fraction=1.0,
        multipliers=problem.all_multipliers(theta),
        feedback=problem.at(theta).feedback @ problem.states / x,
    )
