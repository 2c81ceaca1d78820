r"""The estimator whose largest error over all constant uncertainties is the least.

The largest error over a finite set of :math:`\Delta` is minimised over all matrices of the
estimator. The worst :math:`\Delta` of the result joins the set, until it is no new one. The maximum
of the errors :math:`J_i` is smoothed as :math:`\tfrac1s\log\tfrac1N\sum_i J_i^s`, with a sharpness
s that grows.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from operator import itemgetter

import numpy as np

from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.certificate import model_loop
from robsmooth.estimators.constant import mean_square, slopes, worst_constant, worst_delta
from robsmooth.estimators.descent import descend
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, open_loop
from robsmooth.estimators.minimax import is_convex, minimax_smoother
from robsmooth.estimators.tuned import classical, tuned_fixed_lag_smoother
from robsmooth.estimators.units import Natural, in_plant_states
from robsmooth.systems.augmented import AugmentedSystem

_SHARPNESS = (1e1, 1e2, 1e3, 1e4)
_ROUNDS = 8
_CLOSED = 1e-4  # relative: a worst Delta is new where it is worse by more
_STARTS = 16  # of the search for the worst Delta


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ConstantMinimaxSmoother(Estimator):
    """The estimator that `constant_minimax_smoother` designs.

    Attributes
    ----------
    worst_constant : float
        The largest mean square error against the exactly delayed w that was found under a constant
        admissible uncertainty, in the squared unit of w.
    cost : {"smoothed", "filtered"}, which error it is
    """

    worst_constant: float
    cost: str

    @property
    def _figures(self) -> str:
        return f"worst_constant={self.worst_constant:.5g}, cost={self.cost!r}"


@one_thread
def constant_minimax_smoother(
    plant: AugmentedSystem, output: str = "smoothed"
) -> ConstantMinimaxSmoother:
    """Design the estimator whose largest error under constant uncertainties is the least.

    A descent from the best of the classical, the tuned and the minimax smoother ends in a local
    minimum, which is never worse than these.

    Parameters
    ----------
    plant, output : as in `minimax_smoother`

    Raises
    ------
    InfeasibleDesignError
        Where each has an infinite error for some constant uncertainty; as in `minimax_smoother`.

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> round(rs.constant_minimax_smoother(plant).worst_constant, 4)
    0.0837
    """
    natural = Natural.of(plant, output)
    drifts = natural.drift.V.size > 0  # then the error is that against the delay model's output
    loop_of = model_loop if drifts else partial(open_loop, output="smoothed", loop="real")
    found = [(*worst_delta(loop_of(each), _STARTS), each) for each in _candidates(natural.plant)]
    start = min(found, key=itemgetter(0))
    if math.isinf(start[0]):
        raise InfeasibleDesignError(
            "A finite error under constant uncertainty",
            "some constant uncertainty destabilises the plant, so that its error has no limit; "
            "less uncertainty (smaller outputs C or Lipschitz constants) may help",
        )
    value, estimator = _designed(*start, loop_of)
    fields = natural.restored(in_plant_states(estimator))
    value *= natural.units.w**2
    if drifts:
        value, _ = worst_constant(Estimator(**fields), output, _STARTS)
    return ConstantMinimaxSmoother(**fields, worst_constant=value, cost=output)


def _candidates(plant: AugmentedSystem) -> list[Estimator]:
    """Return the estimators from which the descent may start."""
    # without copies the error has a limit wherever the plant is stable
    found = [classical(plant, copies) for copies in sorted({False, plant.system.g > 0})]
    found.append(tuned_fixed_lag_smoother(plant))
    with suppress(InfeasibleDesignError):
        if is_convex(plant):  # else its design is a descent, too
            found.append(minimax_smoother(plant))
    return found


def _designed(
    value: float, Delta: Matrix, estimator: Estimator, loop_of: Callable[[Estimator], OpenLoop]
) -> tuple[float, Estimator]:
    """Return the least largest error from a start, and the estimator."""
    Deltas, best = [np.zeros_like(Delta), Delta], (value, estimator)

    def smooth_maximum(sharpness: float, trial: Estimator, _: Matrix) -> tuple[float, Matrix]:
        loop = loop_of(trial)
        values, gradients = zip(*(slopes(loop, Delta) for Delta in Deltas), strict=True)
        powers = np.exp(sharpness * np.log(np.array(values) / max(values)))
        shares = powers / powers.sum() / values
        value = math.log(max(values)) + math.log(powers.mean()) / sharpness
        return value, shares @ [each.of_estimator(trial) for each in gradients]

    for _ in range(_ROUNDS):
        for sharpness in _SHARPNESS:
            estimator, *_ = descend(estimator, partial(smooth_maximum, sharpness))
        loop = loop_of(estimator)
        inner = max(mean_square(loop, each) for each in Deltas)
        value, Delta = worst_delta(loop, _STARTS)
        if value < best[0]:
            best = value, estimator
        if value <= (1.0 + _CLOSED) * inner:
            break
        Deltas.append(Delta)
    return best
