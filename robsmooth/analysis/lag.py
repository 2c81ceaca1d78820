"""Lag and order: what waiting longer and a better model of the delay gain, and which to choose.

With an exact delay, waiting longer never hurts: the exact optimum falls from the filtered error at
lag zero to that of two-sided smoothing. With a delay model of finite order there is a best lag. Too
long a lag for its order is worse than none, because the estimate then is one of something else than
the signal a lag ago.

All errors here are those of a real loop, without the fictitious noise of the copies.
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

DESIGNS = ("classical", "filtered cost", "smoothed cost")
CRITERIA = ("nominal", "worst")
_SATURATED = 1e-6  # of the gain from filtering to two-sided smoothing: what is left beyond is idle
_BRIEFEST = 1e-3  # of the longest lag that is worth a look: lags are tried from here
_GROWTH = 1.5  # between lags that are tried
_TOLERANCE = 1e-4  # of the best lag's logarithm; the error's is of the order of its square


@dataclass(frozen=True, eq=False)
class LagSweep:
    """Smoothed errors against lag and order.

    All are mean squares, traces of the covariances, in the squared unit of w.

    Attributes
    ----------
    lags : (L,) array
        In seconds.
    orders : (O,) array
        Of the delay's Pade model.
    nominal : (O, L) array
        Without uncertainty.
    worst : (O, L) array
        Under the worst constant uncertainty; infinity where that makes the loop unstable.
    optimal : (L,) array
        The exact optimum for each lag: no linear smoother's nominal error is lower.
    filtering, two_sided : float
        The exact optimum for lag zero, and for an infinite one.
    """

    lags: NDArray[np.float64]
    orders: NDArray[np.int_]
    nominal: Matrix
    worst: Matrix
    optimal: NDArray[np.float64]
    filtering: float
    two_sided: float

    def __post_init__(self) -> None:
        for value in (self.lags, self.orders, self.nominal, self.worst, self.optimal):
            frozen(value)

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
        rows = []
        for i, order in enumerate(self.orders):
            nominal, worst = self.nominal[i].argmin(), self.worst[i].argmin()
            rows.append(
                (
                    str(order),
                    float(self.nominal[i, nominal]),
                    float(self.lags[nominal]),
                    f"{100 * self.gain[i, nominal]:.0f}%",
                    float(self.worst[i, worst]),
                    float(self.lags[worst]),
                )
            )
        columns = ("order", "nominal error", "at lag (s)", "gain", "worst error", "at lag (s)")
        caption = (
            f"Least smoothed errors over {len(self.lags)} lags, in the squared unit of $w$, and "
            "the share of the possible gain: filtering has "
            f"${notation.number(self.filtering)}$, two-sided smoothing "
            f"${notation.number(self.two_sided)}$."
        )
        return Table(columns, rows, caption).html()


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
def lag_sweep(
    system: UncertainSystem,
    lags: Sequence[float] | NDArray[np.float64],
    orders: Sequence[int] | NDArray[np.int_],
    design: str | Family = "classical",
    *,
    progress: bool = False,
) -> LagSweep:
    """Find the nominal and the worst smoothed error for each lag and order.

    Parameters
    ----------
    system : UncertainSystem
    lags : sequence of float
        In seconds, not negative.
    orders : sequence of int
        Of the delay's Pade model.
    design : {"classical", "filtered cost", "smoothed cost"} or callable
        The fixed-lag smoother of the nominal system, which runs copies of the nonlinearities; or
        the robust smoother with the least bound on the filtered or on the smoothed error. (The
        search of the first of these does not depend on lag and order; that of the other does, and
        takes its time for each.) Or a function that makes an `Estimator` of system, lag and order.
    progress : bool
        Show a progress bar.

    Returns
    -------
    LagSweep

    Raises
    ------
    InfeasibleDesignError
        Where there is no design.
    ValueError, TypeError
        For an argument that is not as described.
    """
    validation.instance("system", system, UncertainSystem)
    lags = np.array([validation.real("lags", lag, low=0.0) for lag in lags])
    orders = np.array([validation.integer("orders", order, low=1) for order in orders], dtype=int)
    for name, axis in (("lags", lags), ("orders", orders)):
        if not axis.size:
            raise ValueError(f"{name} must have at least one value")
    validation.boolean("progress", progress)
    make = _family(system, design)
    grid = [(lag, int(order)) for order in orders for lag in lags]
    cases = [
        worst_case(make(system, lag, order), copy_noise=False)
        for lag, order in progress_bar(grid, unit="design", shown=progress)
    ]
    shape = len(orders), len(lags)
    return LagSweep(
        lags=lags,
        orders=orders,
        nominal=np.reshape([case.nominal for case in cases], shape),
        worst=np.reshape([case.mean_square for case in cases], shape),
        optimal=np.array([_optimum(system, lag) for lag in lags]),
        filtering=_optimum(system, 0.0),
        two_sided=_optimum(system, math.inf),
    )


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
    """
    error = _error(system, design, criterion)
    order = validation.integer("order", order, low=1)
    longest = _longest(system)
    of_lag = partial(error, order=order)
    return _refine(of_lag, *_scan(of_lag, _BRIEFEST * longest, 2 * longest))


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
    """
    error = _error(system, design, criterion)
    max_order = validation.integer("max_order", max_order, low=1)
    slack = validation.real("slack", slack, low=0.0)
    target = _target(system, target, fraction)
    filtered = error(0.0, order=0)
    if filtered <= target:
        return LagChoice(0.0, 0, filtered, target, 0.0, {0: 0.0})
    longest, shortest = _longest(system), 0.0
    if _optimum(system, 0.0) > target:
        shortest = _meeting(partial(_optimum, system), target, 0.0, longest)
    lags, least = {}, math.inf
    for order in range(1, max_order + 1):
        lags[order], lowest = _shortest(
            partial(error, order=order), target, max(shortest, _BRIEFEST * longest), 2 * longest
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


def _optimum(system: UncertainSystem, lag: float) -> float:
    return float(np.trace(baselines.optimal_fixed_lag_error(system, lag)))


def _target(system: UncertainSystem, target: float | None, fraction: float | None) -> float:
    """Return the mean square error to meet; refuse what no smoother meets."""
    if (target is None) == (fraction is None):
        raise ValueError("choose_lag takes either a target or a fraction of the possible gain")
    filtering, two_sided = _optimum(system, 0.0), _optimum(system, math.inf)
    if fraction is not None:
        fraction = validation.real("fraction", fraction, low=0.0, high=1.0, high_open=True)
        target = filtering - fraction * (filtering - two_sided)
    target = validation.positive("target", target)
    if not target > two_sided + _SATURATED * (filtering - two_sided):
        raise ValueError(
            f"target must be above {two_sided:.6g}, the error of two-sided smoothing, which no lag "
            f"reaches, got {target:.6g}; filtering has {filtering:.6g}"
        )
    return target


def _family(system: UncertainSystem, design: str | Family) -> Family:
    """Return the function that makes the estimator of a lag and an order."""
    if callable(design):
        return design
    if validation.choice("design", design, DESIGNS) == "classical":
        return partial(baselines.fixed_lag_smoother, copies=True)
    if design == "smoothed cost":
        return lambda system, lag, order: minimize_bound(augment(system, lag, order), "smoothed")
    best = minimize_bound(augment(system, 0.0, 0))  # is the best for all lags and orders
    return lambda system, lag, order: design_smoother(
        augment(system, lag, order), best.tau, best.multipliers
    )


def _error(
    system: UncertainSystem, design: str | Family, criterion: str
) -> Callable[[float, int], float]:
    """Return the smoothed mean square error as a function of lag and order."""
    validation.instance("system", system, UncertainSystem)
    criterion = validation.choice("criterion", criterion, CRITERIA)
    make = _family(system, design)

    def error(lag: float, order: int) -> float:
        smoother = make(system, lag, order)
        if criterion == "worst":
            return worst_case(smoother, copy_noise=False).mean_square
        nominal = smoother.plant.structured_delta()
        return float(np.trace(error_covariance(smoother, nominal, copy_noise=False)))

    return error


def _longest(system: UncertainSystem) -> float:
    """Return a lag beyond which the exact optimum gains next to nothing, up to a factor of two."""
    filtering, two_sided = _optimum(system, 0.0), _optimum(system, math.inf)
    if not two_sided < (1.0 - _SATURATED) * filtering:
        raise InfeasibleDesignError(
            "Smoothing", f"it gains nothing: the error is {filtering:.6g} with any lag"
        )
    lag = 1.0 / np.abs(baselines.kalman_bucy(system).poles).max()
    while _optimum(system, lag) - two_sided > _SATURATED * (filtering - two_sided):
        lag *= 2.0
    return lag


def _scan(error: Callable[[float], float], low: float, high: float) -> tuple[np.ndarray, ...]:
    """Return lags from low to high, evenly spaced in their logarithm, and their errors."""
    lags = np.geomspace(low, high, 2 + int(math.log(high / low) / math.log(_GROWTH)))
    return lags, np.array([error(lag) for lag in lags])


def _refine(
    error: Callable[[float], float], lags: np.ndarray, errors: np.ndarray
) -> tuple[float, float]:
    """Return the lag of the least error, and that error, between the best lag's neighbours."""
    best = int(errors.argmin())
    result = minimize_scalar(
        lambda logarithm: -1.0 / error(math.exp(logarithm)),  # an error may be infinite
        bounds=np.log([lags[max(best - 1, 0)], lags[min(best + 1, len(lags) - 1)]]),
        method="bounded",
        options={"xatol": _TOLERANCE},
    )
    lag, least = math.exp(result.x), float(-1.0 / result.fun)
    return (lag, least) if least < errors[best] else (float(lags[best]), float(errors[best]))


def _shortest(
    error: Callable[[float], float], target: float, low: float, high: float
) -> tuple[float, float]:
    """Return the shortest lag that meets the target, or infinity, and the least error found."""
    lags, errors = _scan(error, low, high)
    if not (errors <= target).any():
        lag, least = _refine(error, lags, errors)
        if least > target:
            return math.inf, least
        after = np.searchsorted(lags, lag)
        lags, errors = np.insert(lags, after, lag), np.insert(errors, after, least)
    first = int((errors <= target).argmax())
    if first == 0:
        return float(lags[0]), float(errors.min())
    return _meeting(error, target, lags[first - 1], lags[first]), float(errors.min())


def _meeting(error: Callable[[float], float], target: float, low: float, high: float) -> float:
    """Return the lag between two at which the error falls to the target."""

    def excess(lag: float) -> float:
        return 1.0 - target / error(lag)  # an error may be infinite

    return float(brentq(excess, low, high, xtol=1e-12 * high, rtol=1e-12))
