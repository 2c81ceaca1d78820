"""The error over the lag and over the order of the delay model, and the choice of both.

With an exact delay, the optimal error falls with the lag, from that of filtering to that of
two-sided smoothing. With a delay model of finite order there is a best lag: beyond it the model's
misfit outweighs the gain. All errors are of a real loop, without the copies' fictitious noise.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from robsmooth._support import plots, tables, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.progress import progress_bar
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.analysis.covariance import error_covariance, worst_case
from robsmooth.estimators import baselines
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.delay import checked_order
from robsmooth.systems.system import UncertainSystem

Design = Callable[[UncertainSystem, float, int], Estimator]

_MOST_ORDER = 8  # that `choose_lag` tries
_LEAST_GAIN = 1e-6  # of the gain from filtering to two-sided smoothing: the rest at the longest lag
_LAGS = np.geomspace(1e-3, 2.0, 20)  # that are tried, in units of the longest lag
_LAG_TOLERANCE = 1e-4  # relative, of the best lag; the error's is of the order of its square


@dataclass(frozen=True, eq=False)
class LagSweep(Frozen):
    """What `lag_sweep` finds: smoothed mean square errors, in the squared unit of w.

    Attributes
    ----------
    lags, orders : (L,) and (O,) arrays, as given
    nominal, worst : (O, L) arrays
        Without uncertainty, and under the worst constant one; infinity where that is not stable.
    optimal : (L,) array, the least nominal error of any linear smoother
    """

    lags: Matrix
    orders: NDArray[np.int_]
    nominal: Matrix
    worst: Matrix
    optimal: Matrix

    def __repr__(self) -> str:
        sizes = f"{len(self.orders)} orders x {len(self.lags)} lags"
        return f"LagSweep({sizes}, least nominal error {self.nominal.min():.5g})"

    def to_frame(self) -> "tables.DataFrame":
        """Return the errors as a pandas data frame, with a row for each order and lag."""
        errors = {name: getattr(self, name) for name in ("nominal", "worst", "optimal")}
        return tables.data_frame({"order": self.orders, "lag": self.lags}, errors)

    def plot(self, ax: "plots.Axes | None" = None, error: str = "nominal") -> "plots.Axes":
        """Draw the nominal or the worst errors over the delay; matplotlib is needed."""
        validation.choice("error", error, ("nominal", "worst"))
        curves = {"exact optimum": self.optimal}
        curves |= zip(self.orders.tolist(), getattr(self, error), strict=True)
        labels = {"xlabel": "delay (s)", "ylabel": f"{error} {plots.MEAN_SQUARE}"}
        return plots.draw_curves(ax, self.lags, curves, **labels)


_classical = partial(baselines.fixed_lag_smoother, copies=True)


@one_thread
def lag_sweep(
    system: UncertainSystem,
    lags: Sequence[float] | Matrix,
    orders: Sequence[int] | NDArray[np.int_],
    design: Design | None = None,
    *,
    progress: bool = False,
) -> LagSweep:
    """Find the nominal and the worst smoothed error for each lag and order.

    Parameters
    ----------
    system : UncertainSystem
    lags : sequence of float, at least zero, s
    orders : sequence of int, of the delay's Pade model
    design : callable, optional, of system, lag and order
        Makes an `Estimator`. Default: the fixed-lag smoother with copies of the nonlinearities.
    progress : bool, whether to show a bar

    Examples
    --------
    >>> sweep = rs.lag_sweep(rs.homodyne.PAPER.uncertain_system(), lags=[1e-6, 2e-6], orders=[1, 2])
    >>> sweep.nominal.round(4)
    array([[0.0595, 0.0504],
           [0.0594, 0.0496]])
    """
    validation.instance("system", system, UncertainSystem)
    lags = validation.sequence("lags", lags)
    lags = np.array([validation.real("lags", lag, low=0.0) for lag in lags])
    orders = validation.sequence("orders", orders, of="integers")
    orders = np.array([checked_order("orders", order) for order in orders], dtype=int)
    if not lags.size * orders.size:
        raise ValueError(f"{'orders' if lags.size else 'lags'} must have at least one value")
    design = _classical if design is None else design
    validation.boolean("progress", progress)
    grid = [(lag, int(order)) for order in orders for lag in lags]
    bar = progress_bar(grid, unit="design", shown=progress)
    try:
        cases = [worst_case(design(system, lag, order), loop="real") for lag, order in bar]
    except TypeError as error:
        rule = "design must be a function of system, lag and order to an Estimator"
        raise TypeError(f"{rule}: {validation.line(error)}") from error
    errors = np.array([(case.nominal, case.mean_square) for case in cases]).T
    errors = errors.reshape(2, len(orders), len(lags))
    return LagSweep(lags, orders, *errors, np.array([optimal_error(system, lag) for lag in lags]))


@one_thread
def best_lag(system: UncertainSystem, order: int) -> tuple[float, float]:
    """Find the lag with the least nominal error of the classical smoother of an order.

    Parameters
    ----------
    system : UncertainSystem
    order : int, of the delay's Pade model, at least one

    Returns
    -------
    lag, error : float, s, and the squared unit of w

    Raises
    ------
    InfeasibleDesignError
        Where smoothing gains nothing.

    Examples
    --------
    >>> lag, error = rs.best_lag(rs.homodyne.PAPER.uncertain_system(), order=2)
    >>> round(lag, 8), round(error, 4)
    (4.01e-06, 0.0453)
    """
    order = checked_order("order", order)
    lags, errors = _errors_of_lags(system, order, _longest_lag(system))
    best = errors.argmin()
    return float(lags[best]), float(errors[best])


@dataclass(frozen=True)
class LagChoice(Frozen):
    """The lag and the order that `choose_lag` chooses; both are zero where the filter suffices.

    Attributes
    ----------
    lag, order : float, s, and int, of the delay's Pade model
    error, target : float
        The classical smoother's nominal mean square error, and its limit, in the squared unit of w.
    """

    lag: float
    order: int
    error: float
    target: float


@one_thread
def choose_lag(
    system: UncertainSystem, target: float | None = None, *, fraction: float | None = None
) -> LagChoice:
    """Choose the lowest order of a classical smoother that meets a target, and its shortest lag.

    Parameters
    ----------
    system : UncertainSystem
    target : float, optional, the nominal mean square error to meet, in the squared unit of w
    fraction : float, optional
        Instead: the share, in [0, 1), of the gain from optimal filtering to two-sided smoothing.

    Raises
    ------
    InfeasibleDesignError
        As in `best_lag`, and where no order up to 8 meets the target.
    ValueError
        Where no linear smoother meets it.

    Examples
    --------
    >>> choice = rs.choose_lag(rs.homodyne.PAPER.uncertain_system(), fraction=0.9)
    >>> round(choice.lag, 8), choice.order
    (2.58e-06, 2)
    """
    target = _target(system, target, fraction)
    filtered = classical_error(system, 0, 0.0)
    if filtered <= target:
        return LagChoice(0.0, 0, filtered, target)
    longest, least = _longest_lag(system), math.inf
    for order in range(1, _MOST_ORDER + 1):
        lags, errors = _errors_of_lags(system, order, longest)
        least = min(least, errors.min())
        if least <= target:
            break
    else:
        none = f"no order up to {_MOST_ORDER} has an error of at most {target:.6g} at any lag"
        detail = f"{none}; the least that was found is {least:.6g}"
        raise InfeasibleDesignError("The target", detail)
    error, first = partial(classical_error, system, order), (errors <= target).argmax()
    low, high = lags[first - 1 : first + 1]
    tolerance = {"xtol": 1e-12 * high, "rtol": 1e-12}
    lag = brentq(lambda lag: error(lag) / target - 1.0, low, high, **tolerance)
    return LagChoice(lag, order, error(lag), target)


def optimal_error(system: UncertainSystem, lag: float) -> float:
    """Return the least mean square error of any linear smoother with an exact lag."""
    return float(np.trace(baselines.optimal_fixed_lag_error(system, lag)))


def classical_error(system: UncertainSystem, order: int, lag: float) -> float:
    """Return the nominal mean square error of the classical smoother."""
    smoother = _classical(system, lag, order)
    Delta = smoother.plant.structured_delta()
    return float(np.trace(error_covariance(smoother, Delta, loop="real")))


def _target(system: UncertainSystem, target: float | None, fraction: float | None) -> float:
    """Return the mean square error to meet; refuse one that no smoother meets."""
    if (target is None) == (fraction is None):
        raise ValueError("choose_lag takes either a target or a fraction of the possible gain")
    filtering, two_sided = optimal_error(system, 0.0), optimal_error(system, math.inf)
    if fraction is not None:
        fraction = validation.real("fraction", fraction, low=0.0, high=1.0, without=[1.0])
        target = filtering - fraction * (filtering - two_sided)
    target = validation.positive("target", target)
    if not target > two_sided + _LEAST_GAIN * (filtering - two_sided):
        limit = f"{two_sided:.6g}, the error of two-sided smoothing, which no lag reaches"
        given = f"{target:.6g}; filtering has {filtering:.6g}"
        raise ValueError(f"target must be above {limit}, got {given}")
    return target


def _longest_lag(system: UncertainSystem) -> float:
    """Return a lag, up to a factor of two, beyond which the optimum falls by next to nothing."""
    filtering, two_sided = optimal_error(system, 0.0), optimal_error(system, math.inf)
    if not two_sided < (1.0 - _LEAST_GAIN) * filtering:
        detail = f"it gains nothing: the error is {filtering:.6g} with any lag"
        raise InfeasibleDesignError("Smoothing", detail)
    lag = 1.0 / np.abs(baselines.kalman_bucy(system).poles).max()
    while optimal_error(system, lag) - two_sided > _LEAST_GAIN * (filtering - two_sided):
        lag *= 2.0
    return lag


def _errors_of_lags(system: UncertainSystem, order: int, longest: float) -> tuple[Matrix, Matrix]:
    """Return lags from zero on, the best one included, and the classical errors."""
    error = partial(classical_error, system, order)
    lags = np.append(0.0, _LAGS * longest)
    errors = np.array([error(lag) for lag in lags])
    best = int(errors.argmin())
    ends = lags[max(best - 1, 0)], lags[min(best + 1, len(_LAGS))]
    how = {"bounds": ends, "method": "bounded", "options": {"xatol": _LAG_TOLERANCE * ends[1]}}
    found = minimize_scalar(error, **how)
    after = np.searchsorted(lags, found.x)
    return np.insert(lags, after, found.x), np.insert(errors, after, found.fun)
