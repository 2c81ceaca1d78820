"""The choice of lag and order: the lag with the least error, or the shortest that meets a target.

Errors are searched over the lag for each order of the delay's model. All are those of a real loop,
without the fictitious noise of the copies.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.tables import Table
from robsmooth.analysis.covariance import error_covariance
from robsmooth.analysis.lag import Family, family, optimal_error
from robsmooth.analysis.worst_case import worst_case
from robsmooth.estimators import baselines
from robsmooth.systems.system import UncertainSystem

CRITERIA = ("nominal", "worst")
_LEAST_GAIN = 1e-6  # of that from filtering to two-sided smoothing: a longer lag gains no more
_SHORTEST_LAG = 1e-3  # of the longest: lags are tried from here
_LAG_RATIO = 1.5  # between lags that are tried
_LAG_TOLERANCE = 1e-4  # of the best lag's logarithm; the error's is of the order of its square


@dataclass(frozen=True)
class LagChoice:
    """A lag and an order whose smoothed error meets a target.

    Attributes
    ----------
    lag : float
        In seconds.
    order : int
        Of the delay's Pade model.
    error : float
        The smoothed mean square error, by the criterion asked for, in the squared unit of w.
    target : float
        What it had to meet, in the squared unit of w.
    shortest : float
        No linear smoother of any order meets the target nominally with a lag below this (s).
    lags : dict of int to float
        The shortest lag that meets the target with each order that was tried (s); infinity where
        none does.

    See Also
    --------
    choose_lag : Makes it.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> choice = rs.choose_lag(system, fraction=0.8)
    >>> choice.error <= choice.target * (1 + 1e-9)
    True
    >>> choice.shortest < choice.lag
    True
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
        rows = [
            (str(order), lag, "chosen" if order == self.order else "")
            for order, lag in self.lags.items()
        ]
        caption = (
            "The shortest lag that meets the target for each order: an error of "
            f"${notation.number(self.error)}$, at most ${notation.number(self.target)}$ was asked "
            f"for. An exact delay would take ${notation.number(self.shortest)}$ s."
        )
        return Table(("order", "lag (s)", ""), rows, caption).html()


@one_thread
def best_lag(
    system: UncertainSystem,
    order: int,
    design: str | Family = "classical",
    criterion: str = "nominal",
) -> tuple[float, float]:
    """Find the lag with the least smoothed error for an order of the delay's model.

    Parameters
    ----------
    system : UncertainSystem
    order : int
        Of the delay's Pade model, at least one.
    design
        As in `lag_sweep`.
    criterion : {"nominal", "worst"}
        The error without uncertainty, or under the worst constant one.

    Returns
    -------
    lag, error : float
        In seconds, and the mean square error in the squared unit of w.

    Raises
    ------
    InfeasibleDesignError
        Where there is no design, or smoothing gains nothing.
    ValueError, TypeError
        For an argument that is not as described.

    See Also
    --------
    lag_sweep : Errors for many lags and orders.
    choose_lag : The shortest lag that meets a target.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> lag, error = rs.best_lag(system, order=2)
    >>> round(lag, 3), round(error, 4)
    (0.18, 0.0522)
    """
    error = _error_of_lag(system, design, criterion)
    order = validation.integer("order", order, low=1)
    longest = _longest_lag(system)
    of_lag = partial(error, order=order)
    return _least(of_lag, *_on_a_grid(of_lag, _SHORTEST_LAG * longest, 2 * longest))


@one_thread
def choose_lag(
    system: UncertainSystem,
    target: float | None = None,
    *,
    fraction: float | None = None,
    design: str | Family = "classical",
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
    target : float, optional
        The mean square error to meet, in the squared unit of w.
    fraction : float, optional
        In its place: the share, between zero and one, of the possible gain from the exact optimal
        filtered error to that of two-sided smoothing.
    design
        As in `lag_sweep`.
    criterion : {"nominal", "worst"}
        Whether the error without uncertainty is to meet the target, or that under the worst
        constant one.
    max_order : int
        The highest order to try.
    slack : float
        How much longer than the shortest the lag may be, relatively, for a lower order.

    Returns
    -------
    LagChoice
        With lag and order zero where the filter meets the target.

    Raises
    ------
    InfeasibleDesignError
        Where no order up to `max_order` meets the target, or there is no design.
    ValueError, TypeError
        For a target that no smoother can meet, or another argument that is not as described.

    See Also
    --------
    lag_sweep : Errors for many lags and orders.
    best_lag : The lag with the least error.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> choice = rs.choose_lag(system, fraction=0.9)
    >>> round(choice.lag, 3), choice.order
    (0.12, 2)
    """
    error = _error_of_lag(system, design, criterion)
    max_order = validation.integer("max_order", max_order, low=1)
    slack = validation.real("slack", slack, low=0.0)
    target = _target(system, target, fraction)
    filtered = error(0.0, order=0)
    if filtered <= target:
        return LagChoice(0.0, 0, filtered, target, 0.0, {0: 0.0})
    longest, shortest = _longest_lag(system), 0.0
    if optimal_error(system, 0.0) > target:
        shortest = _crossing(partial(optimal_error, system), target, 0.0, longest)
    lags, least = {}, math.inf
    for order in range(1, max_order + 1):
        lags[order], lowest = _shortest_lag(
            partial(error, order=order), target, max(shortest, _SHORTEST_LAG * longest), 2 * longest
        )
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
    order = next(order for order, lag in lags.items() if lag <= (1.0 + slack) * best)
    lag = lags[order]
    return LagChoice(lag, order, error(lag, order=order), target, shortest, lags)


def _target(system: UncertainSystem, target: float | None, fraction: float | None) -> float:
    """Return the mean square error to meet; refuse what no smoother meets."""
    if (target is None) == (fraction is None):
        raise ValueError("choose_lag takes either a target or a fraction of the possible gain")
    filtering, two_sided = optimal_error(system, 0.0), optimal_error(system, math.inf)
    if fraction is not None:
        fraction = validation.real("fraction", fraction, low=0.0, high=1.0, high_open=True)
        target = filtering - fraction * (filtering - two_sided)
    target = validation.positive("target", target)
    if not target > two_sided + _LEAST_GAIN * (filtering - two_sided):
        raise ValueError(
            f"target must be above {two_sided:.6g}, the error of two-sided smoothing, which no lag "
            f"reaches, got {target:.6g}; filtering has {filtering:.6g}"
        )
    return target


def _error_of_lag(
    system: UncertainSystem, design: str | Family, criterion: str
) -> Callable[[float, int], float]:
    """Return the smoothed mean square error as a function of lag and order."""
    validation.instance("system", system, UncertainSystem)
    criterion = validation.choice("criterion", criterion, CRITERIA)
    make = family(system, design)

    def error(lag: float, order: int) -> float:
        smoother = make(system, lag, order)
        if criterion == "worst":
            return worst_case(smoother, loop="real").mean_square
        nominal = smoother.plant.structured_delta()
        return float(np.trace(error_covariance(smoother, nominal, loop="real")))

    return error


def _longest_lag(system: UncertainSystem) -> float:
    """Return a lag beyond which the exact optimum gains next to nothing, up to a factor of two."""
    filtering, two_sided = optimal_error(system, 0.0), optimal_error(system, math.inf)
    if not two_sided < (1.0 - _LEAST_GAIN) * filtering:
        raise InfeasibleDesignError(
            "Smoothing", f"it gains nothing: the error is {filtering:.6g} with any lag"
        )
    lag = 1.0 / np.abs(baselines.kalman_bucy(system).poles).max()
    while optimal_error(system, lag) - two_sided > _LEAST_GAIN * (filtering - two_sided):
        lag *= 2.0
    return lag


def _on_a_grid(error: Callable[[float], float], low: float, high: float) -> tuple[np.ndarray, ...]:
    """Return lags from low to high, evenly spaced in their logarithm, and their errors."""
    lags = np.geomspace(low, high, 2 + int(math.log(high / low) / math.log(_LAG_RATIO)))
    return lags, np.array([error(lag) for lag in lags])


def _least(
    error: Callable[[float], float], lags: np.ndarray, errors: np.ndarray
) -> tuple[float, float]:
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


def _shortest_lag(
    error: Callable[[float], float], target: float, low: float, high: float
) -> tuple[float, float]:
    """Return the shortest lag that meets the target, or infinity, and the least error found."""
    lags, errors = _on_a_grid(error, low, high)
    if not (errors <= target).any():
        lag, least = _least(error, lags, errors)
        if least > target:
            return math.inf, least
        after = np.searchsorted(lags, lag)
        lags, errors = np.insert(lags, after, lag), np.insert(errors, after, least)
    first = int((errors <= target).argmax())
    if first == 0:
        return float(lags[0]), float(errors.min())
    return _crossing(error, target, lags[first - 1], lags[first]), float(errors.min())


def _crossing(error: Callable[[float], float], target: float, low: float, high: float) -> float:
    """Return the lag between two at which the error falls to the target."""

    def excess(lag: float) -> float:
        return 1.0 - target / error(lag)  # an error may be infinite

    return float(brentq(excess, low, high, xtol=1e-12 * high, rtol=1e-12))
