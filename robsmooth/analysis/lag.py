"""Lag and order: what waiting longer and a better model of the delay gain, and which to choose.

With an exact delay, waiting longer never hurts: the optimum falls from the error of filtering to
that of two-sided smoothing. With a delay model of finite order there is a best lag: beyond it the
estimate is one of something else than the signal a lag ago. All errors here are those of a real
loop, without the fictitious noise of the copies.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.progress import progress_bar
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix, frozen
from robsmooth.analysis.covariance import error_covariance
from robsmooth.analysis.worst_case import worst_case
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import design_smoother
from robsmooth.systems.augmented import augment
from robsmooth.systems.system import UncertainSystem

Family = Callable[[UncertainSystem, float, int], Estimator]
Design = str | Family
Floats = NDArray[np.float64]
Error = Callable[[float], float]  # of a lag

_LEAST_GAIN = 1e-6  # of that from filtering to two-sided smoothing: a longer lag gains no more
_SHORTEST_LAG = 1e-3  # of the longest: lags are tried from here
_LAG_RATIO = 1.5  # between lags that are tried
_LAG_TOLERANCE = 1e-4  # of the best lag's logarithm; the error's is of the order of its square


@dataclass(frozen=True, eq=False)
class LagSweep:
    """What `lag_sweep` finds: smoothed mean square errors, in the squared unit of w.

    Attributes
    ----------
    lags, orders : (L,) and (O,) arrays, as given
    nominal, worst : (O, L) arrays
        Without uncertainty; under the worst constant one, infinity where that is not stable.
    optimal : (L,) array, the exact optimum: no linear smoother's nominal error is lower
    filtering, two_sided : float, the exact optimum for lag zero and for an infinite one

    Examples
    --------
    >>> import robsmooth as rs
    >>> sweep = rs.lag_sweep(rs.homodyne.PAPER.uncertain_system(), lags=[1e-6, 2e-6], orders=[2])
    >>> sweep.gain.round(2)
    array([[0.6 , 0.84]])
    """

    lags: Floats
    orders: NDArray[np.int_]
    nominal: Matrix
    worst: Matrix
    optimal: Floats
    filtering: float
    two_sided: float

    @property
    def gain(self) -> Matrix:
        """(O, L) share of the possible gain, from filtering to two-sided smoothing, nominally."""
        return (self.filtering - self.nominal) / (self.filtering - self.two_sided)

    def __repr__(self) -> str:
        return (
            f"LagSweep({len(self.orders)} orders x {len(self.lags)} lags, least nominal error "
            f"{self.nominal.min():.5g}, filtering={self.filtering:.5g}, "
            f"two_sided={self.two_sided:.5g})"
        )

    def _repr_html_(self) -> str:
        lags, rows = self.lags, []
        by_order = zip(self.orders, self.nominal, self.gain, self.worst, strict=True)
        for order, nominal, gain, worst in by_order:
            i, j = nominal.argmin(), worst.argmin()
            rows.append((str(order), nominal[i], lags[i], f"{gain[i]:.0%}", worst[j], lags[j]))
        columns = ("order", "nominal error", "at lag (s)", "gain", "worst error", "at lag (s)")
        ends = [f"${notation.number(error)}$" for error in (self.filtering, self.two_sided)]
        caption = (
            f"Least smoothed errors over {len(lags)} lags, in the squared unit of $w$, and the "
            f"share of the possible gain: filtering has {ends[0]}, two-sided smoothing {ends[1]}."
        )
        return Table(columns, rows, caption).html()


@one_thread
def lag_sweep(
    system: UncertainSystem,
    lags: Sequence[float] | Floats,
    orders: Sequence[int] | NDArray[np.int_],
    design: Design = "classical",
    *,
    progress: bool = False,
) -> LagSweep:
    """Find the nominal and the worst smoothed error for each lag and order.

    Parameters
    ----------
    system : UncertainSystem
    lags : sequence of float, in seconds, not negative
    orders : sequence of int, of the delay's Pade model
    design : {"classical", "filtered cost", "smoothed cost"} or callable
        The nominal system's fixed-lag smoother with copies of the nonlinearities; the robust one
        with the least bound on the filtered error, or on the smoothed one, which takes a search
        for each lag and order; or a function that makes an `Estimator` of system, lag and order.
    progress : bool, whether to show a bar

    Returns
    -------
    LagSweep

    Raises
    ------
    InfeasibleDesignError
        Where there is no design.

    See Also
    --------
    best_lag, choose_lag : the lag with the least error, and one that meets a target.

    Examples
    --------
    >>> import robsmooth as rs
    >>> sweep = rs.lag_sweep(rs.homodyne.PAPER.uncertain_system(), lags=[1e-6, 2e-6], orders=[1, 2])
    >>> sweep.nominal.round(4)
    array([[0.0595, 0.0504],
           [0.0594, 0.0496]])
    """
    validation.instance("system", system, UncertainSystem)
    lags = np.array([validation.real("lags", lag, low=0.0) for lag in lags])
    orders = np.array([validation.integer("orders", order, low=1) for order in orders], dtype=int)
    if not lags.size * orders.size:
        raise ValueError(f"{'orders' if lags.size else 'lags'} must have at least one value")
    validation.boolean("progress", progress)
    make = _family(system, design)
    grid = [(lag, int(order)) for order in orders for lag in lags]
    cases = [
        worst_case(make(system, lag, order), loop="real")
        for lag, order in progress_bar(grid, unit="design", shown=progress)
    ]
    errors = np.array([(case.nominal, case.mean_square) for case in cases]).T
    errors = errors.reshape(2, len(orders), len(lags))
    optimal = np.array([_optimal_error(system, lag) for lag in lags])
    ends = (_optimal_error(system, lag) for lag in (0.0, math.inf))
    return LagSweep(*map(frozen, (lags, orders, *errors, optimal)), *ends)


@dataclass(frozen=True)
class LagChoice:
    """The lag and the order that `choose_lag` chooses.

    Attributes
    ----------
    lag, order : float, in seconds, and int, of the delay's Pade model
    error, target : float
        The smoothed mean square error, by the criterion, and its limit, in the squared unit of w.
    shortest : float
        No linear smoother of any order meets the target nominally with a lag below this (s).
    lags : dict of int to float
        The shortest lag (s) for each order that was tried; infinity where none meets the target.

    Examples
    --------
    >>> import robsmooth as rs
    >>> rs.choose_lag(rs.homodyne.PAPER.uncertain_system(), fraction=0.8)
    LagChoice(lag=1.827e-06 s, order=1, error=0.051293, target=0.051293, shortest=1.731e-06 s)
    """

    lag: float
    order: int
    error: float
    target: float
    shortest: float
    lags: dict[int, float]

    def __repr__(self) -> str:
        return (
            f"LagChoice(lag={self.lag:.4g} s, order={self.order}, error={self.error:.5g}, "
            f"target={self.target:.5g}, shortest={self.shortest:.4g} s)"
        )

    def _repr_html_(self) -> str:
        lags = self.lags.items()
        rows = [(str(order), lag, "chosen" if order == self.order else "") for order, lag in lags]
        caption = (
            "The shortest lag that meets the target for each order: an error of "
            f"${notation.number(self.error)}$, at most ${notation.number(self.target)}$ was asked "
            f"for. An exact delay would take ${notation.number(self.shortest)}$ s."
        )
        return Table(("order", "lag (s)", ""), rows, caption).html()


@one_thread
def best_lag(
    system: UncertainSystem, order: int, design: Design = "classical", criterion: str = "nominal"
) -> tuple[float, float]:
    """Find the lag with the least smoothed error for an order of the delay's model.

    Parameters
    ----------
    system : UncertainSystem
    order : int, of the delay's Pade model, at least one
    design
        As in `lag_sweep`.
    criterion : {"nominal", "worst"}, the error without uncertainty, or under the worst constant one

    Returns
    -------
    lag, error : float, in seconds, and in the squared unit of w

    Raises
    ------
    InfeasibleDesignError
        Where there is no design, or smoothing gains nothing.

    See Also
    --------
    lag_sweep, choose_lag : errors for many lags, and the shortest lag that meets a target.

    Examples
    --------
    >>> import robsmooth as rs
    >>> lag, error = rs.best_lag(rs.homodyne.PAPER.uncertain_system(), order=2)
    >>> round(lag, 8), round(error, 4)
    (4.01e-06, 0.0453)
    """
    error = _error_of_lag(system, design, criterion)
    of_lag = partial(error, order=validation.integer("order", order, low=1))
    longest = _longest_lag(system)
    return _least(of_lag, *_on_a_grid(of_lag, _SHORTEST_LAG * longest, 2 * longest))


@one_thread
def choose_lag(
    system: UncertainSystem,
    target: float | None = None,
    *,
    fraction: float | None = None,
    design: Design = "classical",
    criterion: str = "nominal",
    max_order: int = 8,
    slack: float = 0.05,
) -> LagChoice:
    """Choose the lag and the order of a smoother whose error meets a target.

    Each order has a shortest lag that meets the target, if any; higher orders have shorter ones.
    The choice is the lowest order whose lag is, within `slack`, the shortest of all.

    Parameters
    ----------
    system : UncertainSystem
    target : float, optional, the mean square error to meet, in the squared unit of w
    fraction : float, optional
        In its place: the share, from 0 to 1, of the gain from optimal filtering to two-sided
        smoothing.
    design, criterion
        As in `best_lag`: the error that is to meet the target.
    max_order : int, the highest order to try
    slack : float, how much longer than the shortest the lag may be, relatively, for a lower order

    Returns
    -------
    LagChoice
        With lag and order zero where the filter meets the target.

    Raises
    ------
    InfeasibleDesignError
        As in `best_lag`, and where no order up to `max_order` meets the target.
    ValueError
        Where no smoother can.

    See Also
    --------
    lag_sweep, best_lag : errors for many lags, and the lag with the least.

    Examples
    --------
    >>> import robsmooth as rs
    >>> choice = rs.choose_lag(rs.homodyne.PAPER.uncertain_system(), fraction=0.9)
    >>> round(choice.lag, 8), choice.order
    (2.58e-06, 2)
    """
    error = _error_of_lag(system, design, criterion)
    max_order = validation.integer("max_order", max_order, low=1)
    slack = validation.real("slack", slack, low=0.0)
    target = _target(system, target, fraction)
    filtered = error(0.0, order=0)
    if filtered <= target:
        return LagChoice(0.0, 0, filtered, target, 0.0, {0: 0.0})
    longest, shortest = _longest_lag(system), 0.0
    if _optimal_error(system, 0.0) > target:
        shortest = _crossing(partial(_optimal_error, system), target, 0.0, longest)
    low, high = max(shortest, _SHORTEST_LAG * longest), 2 * longest
    lags, least = {}, math.inf
    for order in range(1, max_order + 1):
        lags[order], lowest = _shortest_lag(partial(error, order=order), target, low, high)
        least = min(least, lowest)
        if lags[order] <= (1.0 + slack) * shortest:
            break  # no higher order can do better than that
    best = min(lags.values())
    if math.isinf(best):
        raise InfeasibleDesignError(
            "The target",
            f"no order up to {max_order} has a lag with an error of at most {target:.6g}; the "
            f"least that was found, at lags above the {shortest:.4g} s that an exact delay would "
            f"take, is {least:.6g}; try a higher max_order or another design",
        )
    order, lag = next(item for item in lags.items() if item[1] <= (1.0 + slack) * best)
    return LagChoice(lag, order, error(lag, order=order), target, shortest, lags)


def _optimal_error(system: UncertainSystem, lag: float) -> float:
    """Return the least mean square error of any linear smoother with an exact lag."""
    return float(np.trace(baselines.optimal_fixed_lag_error(system, lag)))


def _target(system: UncertainSystem, target: float | None, fraction: float | None) -> float:
    """Return the mean square error to meet; refuse what no smoother meets."""
    if (target is None) == (fraction is None):
        raise ValueError("choose_lag takes either a target or a fraction of the possible gain")
    filtering, two_sided = _optimal_error(system, 0.0), _optimal_error(system, math.inf)
    if fraction is not None:
        fraction = validation.real("fraction", fraction, low=0.0, high=1.0, without=[1.0])
        target = filtering - fraction * (filtering - two_sided)
    target = validation.positive("target", target)
    if not target > two_sided + _LEAST_GAIN * (filtering - two_sided):
        raise ValueError(
            f"target must be above {two_sided:.6g}, the error of two-sided smoothing, which no lag "
            f"reaches, got {target:.6g}; filtering has {filtering:.6g}"
        )
    return target


def _family(system: UncertainSystem, design: Design) -> Family:
    """Return the function that makes the estimator of a lag and an order."""
    if callable(design):
        return design
    validation.choice("design", design, ("classical", "filtered cost", "smoothed cost"))
    if design == "classical":
        return partial(baselines.fixed_lag_smoother, copies=True)
    if design == "smoothed cost":
        return lambda system, lag, order: minimize_bound(augment(system, lag, order), "smoothed")
    best = minimize_bound(augment(system, 0.0, 0))  # is the best for all lags and orders
    return lambda system, lag, order: design_smoother(
        augment(system, lag, order), best.tau, best.multipliers
    )


def _error_of_lag(system: UncertainSystem, design: Design, criterion: str) -> Callable[..., float]:
    """Return the smoothed mean square error as a function of lag and order."""
    validation.instance("system", system, UncertainSystem)
    criterion = validation.choice("criterion", criterion, ("nominal", "worst"))
    make = _family(system, design)

    def error(lag: float, order: int) -> float:
        smoother = make(system, lag, order)
        if criterion == "worst":
            return worst_case(smoother, loop="real").mean_square
        Delta = smoother.plant.structured_delta()
        return float(np.trace(error_covariance(smoother, Delta, loop="real")))

    return error


def _longest_lag(system: UncertainSystem) -> float:
    """Return a lag beyond which the exact optimum gains next to nothing, up to a factor of two."""
    filtering, two_sided = _optimal_error(system, 0.0), _optimal_error(system, math.inf)
    if not two_sided < (1.0 - _LEAST_GAIN) * filtering:
        raise InfeasibleDesignError(
            "Smoothing", f"it gains nothing: the error is {filtering:.6g} with any lag"
        )
    lag = 1.0 / np.abs(baselines.kalman_bucy(system).poles).max()
    while _optimal_error(system, lag) - two_sided > _LEAST_GAIN * (filtering - two_sided):
        lag *= 2.0
    return lag


def _on_a_grid(error: Error, low: float, high: float) -> tuple[Floats, Floats]:
    """Return lags from low to high, evenly spaced in their logarithm, and their errors."""
    lags = np.geomspace(low, high, 2 + int(math.log(high / low) / math.log(_LAG_RATIO)))
    return lags, np.array([error(lag) for lag in lags])


def _least(error: Error, lags: Floats, errors: Floats) -> tuple[float, float]:
    """Return the lag of the least error, and that error, between the best lag's neighbours."""
    best = int(errors.argmin())
    result = minimize_scalar(
        lambda logarithm: -1.0 / error(math.exp(logarithm)),  # an error may be infinite
        bounds=np.log([lags[max(best - 1, 0)], lags[min(best + 1, len(lags) - 1)]]),
        method="bounded",
        options={"xatol": _LAG_TOLERANCE},
    )
    lag, least = math.exp(result.x), float(-1.0 / result.fun)
    return (lag, least) if least < errors[best] else (float(lags[best]), float(errors[best]))


def _shortest_lag(error: Error, target: float, low: float, high: float) -> tuple[float, float]:
    """Return the shortest lag that meets the target, or infinity, and the least error found."""
    lags, errors = _on_a_grid(error, low, high)
    if not (errors <= target).any():
        lag, least = _least(error, lags, errors)
        if least > target:
            return math.inf, least
        after = np.searchsorted(lags, lag)
        lags, errors = np.insert(lags, after, lag), np.insert(errors, after, least)
    first = int((errors <= target).argmax())
    between = lags[first - 1], lags[first]
    shortest = _crossing(error, target, *between) if first > 0 else float(lags[0])
    return shortest, float(errors.min())


def _crossing(error: Error, target: float, low: float, high: float) -> float:
    """Return the lag between two at which the error, which may be infinite, falls to the target."""
    return brentq(lambda lag: 1.0 - target / error(lag), low, high, xtol=1e-12 * high, rtol=1e-12)
