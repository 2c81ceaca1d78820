"""A parameter study: lag, order, sector and noise, each design with covariance and simulation.

Where the cost is on the filtered error, the best tau and multipliers depend neither on the lag nor
on the order of its model. So there is one search for each sector and noise, a *column*, and then a
design for each lag and order. A checkpoint holds columns.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from operator import itemgetter
from warnings import catch_warnings

import numpy as np
from numpy.typing import NDArray

from robsmooth._support import cluster, plots, tables, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.checkpoint import open_journal
from robsmooth._support.errors import InfeasibleDesignError, UnstableLoopError
from robsmooth._support.progress import progress_bar
from robsmooth._support.validation import Frozen, shown
from robsmooth.analysis.covariance import delta_sweep
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.smoother import design_smoother
from robsmooth.homodyne.montecarlo import LossOfLockWarning, monte_carlo
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.simulation.groups import checked_seed
from robsmooth.systems.augmented import augment
from robsmooth.systems.delay import checked_order

Axis = Sequence[float] | NDArray[np.float64]

AXES = ("gammas", "noises", "orders", "lags")
QUANTITIES = ("bound", "nominal", "edge", "optimal", "optimal_filtered")  # of the linear loop
QUANTITIES += ("filtered", "filtered_error", "smoothed", "smoothed_error", "slip_rate")


@dataclass(frozen=True, eq=False)
class Study(Frozen):
    """The results of `parameter_study`, an array for each quantity.

    Attributes
    ----------
    gammas, noises, orders, lags : tuples, the axes of the arrays, in this order; lags in s
    quantities : dict of str to (gammas, noises, orders, lags) array
        Mean square errors, rad^2. "bound": on the filtered one. Linear loop: smoothed, "nominal"
        for the sine's tangent and "edge" at the sector's edge; "optimal", "optimal_filtered" for
        the tangent. Nonlinear loop, paths in lock: "filtered", "smoothed", with the standard errors
        "filtered_error", "smoothed_error". "slip_rate": 1/s. NaN without a design or path in lock.
    failures : dict of (gamma, noise) to str, why there is no design
    """

    gammas: tuple[float, ...]
    noises: tuple[float, ...]
    orders: tuple[int, ...]
    lags: tuple[float, ...]
    quantities: Mapping[str, NDArray[np.float64]]
    failures: Mapping[tuple[float, float], str]

    @property
    def ratio(self) -> NDArray[np.float64]:
        """Smoothed over filtered mean square error in the nonlinear loop."""
        return self.quantities["smoothed"] / self.quantities["filtered"]

    @property
    def optimal_ratio(self) -> NDArray[np.float64]:
        """The same for the optimal estimators in the linear loop."""
        return self.quantities["optimal"] / self.quantities["optimal_filtered"]

    def __repr__(self) -> str:
        sizes = " x ".join(f"{len(getattr(self, name))} {name}" for name in AXES)
        designs = np.isfinite(self.quantities["bound"]).sum()
        return f"Study({sizes}: {designs} designs, {len(self.failures)} columns without)"

    def to_frame(self) -> "tables.DataFrame":
        """Return the quantities as a pandas data frame, with a row for each point of the grid."""
        return tables.data_frame({name[:-1]: getattr(self, name) for name in AXES}, self.quantities)

    def plot(
        self, ax: "plots.Axes | None" = None, gamma: float | None = None, noise: float | None = None
    ) -> "plots.Axes":
        """Draw `ratio` over the delay, by default at mid-grid; matplotlib is needed."""
        at = [("gamma", gamma, self.gammas), ("noise", noise, self.noises)]
        i, j = (
            len(axis) // 2 if value is None else axis.index(validation.choice(name, value, axis))
            for name, value, axis in at
        )
        curves = {"both optimal, linear loop": self.optimal_ratio[i, j, -1]}
        curves |= zip(self.orders, self.ratio[i, j], strict=True)
        labels = {"xlabel": "delay (s)", "ylabel": "smoothed / filtered error"}
        return plots.draw_curves(ax, self.lags, curves, **labels)


def parameter_study(
    parameters: HomodyneParameters,
    lags: Axis,
    orders: Sequence[int] | NDArray[np.int_],
    gammas: Axis,
    noises: Axis,
    *,
    runs: int = 256,
    seed: int = 0,
    client: "cluster.Client | None" = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = False,
) -> Study:
    """Design the paper's smoother over a grid, and find the errors of each, linear and nonlinear.

    Parameters
    ----------
    parameters : HomodyneParameters, the loop in the middle of the grid
    lags, orders, gammas : sequences of float, int, float
        Of the smoother, s; of the delay's Pade model; half widths of the sector.
    noises : sequence of float
        Power of the shot noise relative to that of `parameters`; alpha is divided by its root.
    runs, seed, client, checkpoint, progress : as in `monte_carlo`, which has the exceptions, too

    Examples
    --------
    >>> study = rs.parameter_study(
    ...     rs.homodyne.PAPER, lags=[3.1e-6], orders=[2], gammas=[0.4], noises=[1.0], runs=64
    ... )
    >>> study.ratio.round(2)  # of the smoothed and the filtered mean square error
    array([[[[0.59]]]])
    """
    validation.instance("parameters", parameters, HomodyneParameters)
    gammas, noises, orders, lags = map(validation.sequence, AXES, (gammas, noises, orders, lags))
    lags = tuple(validation.positive("lags", lag) for lag in lags)
    orders = tuple(checked_order("orders", order) for order in orders)
    gammas = tuple(replace(parameters, gamma=gamma).gamma for gamma in gammas)
    noises = tuple(validation.positive("noises", noise) for noise in noises)
    axes = dict(zip(AXES, (gammas, noises, orders, lags), strict=True))
    for name, axis in axes.items():
        if not axis or len(set(axis)) < len(axis):
            raise ValueError(f"{name} must be one or more different values, got {shown(axis)}")
    runs, seed = validation.integer("runs", runs, low=2), checked_seed(seed)
    validation.boolean("progress", progress)

    study = {**axes, "parameters": vars(parameters), "runs": runs, "seed": seed}
    columns = list(product(gammas, noises))
    changes = ({"gamma": g, "alpha": parameters.alpha / s**0.5} for g, s in columns)
    loops = [(number, replace(parameters, **each)) for number, each in enumerate(changes)]
    compute = partial(_column, lags=lags, orders=orders, runs=runs, seed=seed)
    with open_journal(checkpoint, {"study": study, "software": cluster.software()}) as journal:
        results = list(journal.records()) if journal else []
        done = [result["column"] for result in results]
        missing = (loop for loop in loops if loop[0] not in done)
        computed = cluster.in_order(compute, missing, client)
        # columns of a former run count as progress, not for the rate
        extent = {"total": len(loops), "initial": len(results), "unit": "column"}
        for result in progress_bar(computed, **extent, shown=progress):
            if journal:
                journal.append(result)
            results.append(result)
    results.sort(key=itemgetter("column"))

    nothing, shape = [{}] * (len(orders) * len(lags)), tuple(map(len, axes.values()))
    points = [point for result in results for point in result.get("points", nothing)]
    values = {name: [point.get(name, np.nan) for point in points] for name in QUANTITIES}
    quantities = {name: np.reshape(each, shape) for name, each in values.items()}
    found = zip(columns, results, strict=True)
    failures = {column: result["failure"] for column, result in found if "failure" in result}
    return Study(gammas, noises, orders, lags, quantities, failures)


@one_thread
def _column(
    column: int, loop: HomodyneParameters, lags: Axis, orders: Axis, runs: int, seed: int
) -> dict:
    """Search for tau and the multipliers, then design and measure for each order and lag."""
    system = loop.uncertain_system()
    try:
        best = minimize_bound(augment(system, 0.0, 0))
    except InfeasibleDesignError as error:
        return {"column": column, "failure": str(error)}
    points, optimal = [], baselines.optimal_fixed_lag_error
    optimum = {"optimal_filtered": optimal(system, 0.0).item()}
    for order, lag in product(orders, lags):
        smoother = design_smoother(augment(system, lag, order), best.tau, best.multipliers)
        optimum["optimal"] = optimal(system, lag).item()
        points.append(_measure(loop, smoother, runs, seed) | optimum)
    return {"column": column, "points": points}


def _measure(loop: HomodyneParameters, smoother, runs: int, seed: int) -> dict[str, float]:
    nominal, edge = delta_sweep(smoother, (0.0, -1.0), "smoothed", loop="real")[:, 0, 0].tolist()
    found = {"bound": smoother.mean_square_bound, "nominal": nominal, "edge": edge}
    try:
        # slips are a result here
        with catch_warnings(action="ignore", category=LossOfLockWarning):
            result = monte_carlo(loop, smoother, runs=runs, seed=seed)
    except UnstableLoopError:
        return found
    for name in ("filtered", "smoothed"):
        error = getattr(result, f"{name}_in_lock" if result.slips else name)
        found |= {name: error.mean_square, f"{name}_error": error.standard_error}
    return found | {"slip_rate": result.slip_rate}
