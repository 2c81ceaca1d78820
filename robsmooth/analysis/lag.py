"""Lag and order: what waiting longer and a better model of the delay gain.

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

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.progress import progress_bar
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix, frozen
from robsmooth.analysis.worst_case import worst_case
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import design_smoother
from robsmooth.systems.augmented import augment
from robsmooth.systems.system import UncertainSystem

Family = Callable[[UncertainSystem, float, int], Estimator]

DESIGNS = ("classical", "filtered cost", "smoothed cost")


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

    See Also
    --------
    lag_sweep : Makes it.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> sweep = rs.lag_sweep(system, lags=[0.1, 0.3], orders=[2])
    >>> sweep.gain.round(2)
    array([[0.86, 0.86]])
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

    See Also
    --------
    choose_lag : The lag and the order that meet a target.
    best_lag : The lag with the least error.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> sweep = rs.lag_sweep(system, lags=[0.1, 0.3], orders=[1, 2])
    >>> sweep.nominal.round(4)
    array([[0.0565, 0.0683],
           [0.0555, 0.0554]])
    """
    validation.instance("system", system, UncertainSystem)
    lags = np.array([validation.real("lags", lag, low=0.0) for lag in lags])
    orders = np.array([validation.integer("orders", order, low=1) for order in orders], dtype=int)
    for name, axis in (("lags", lags), ("orders", orders)):
        if not axis.size:
            raise ValueError(f"{name} must have at least one value")
    validation.boolean("progress", progress)
    make = family(system, design)
    grid = [(lag, int(order)) for order in orders for lag in lags]
    cases = [
        worst_case(make(system, lag, order), loop="real")
        for lag, order in progress_bar(grid, unit="design", shown=progress)
    ]
    shape = len(orders), len(lags)
    return LagSweep(
        lags=lags,
        orders=orders,
        nominal=np.reshape([case.nominal for case in cases], shape),
        worst=np.reshape([case.mean_square for case in cases], shape),
        optimal=np.array([optimal_error(system, lag) for lag in lags]),
        filtering=optimal_error(system, 0.0),
        two_sided=optimal_error(system, math.inf),
    )


def optimal_error(system: UncertainSystem, lag: float) -> float:
    """Return the least mean square error of any linear smoother with an exact lag."""
    return float(np.trace(baselines.optimal_fixed_lag_error(system, lag)))


def family(system: UncertainSystem, design: str | Family) -> Family:
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
