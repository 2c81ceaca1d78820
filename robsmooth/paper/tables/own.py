"""Tables of a user's own system."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.tables import Table
from robsmooth.analysis.covariance import error_covariance
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.homodyne.parameters import PAPER
from robsmooth.paper.published import DELAY, ORDER
from robsmooth.paper.tables import cells
from robsmooth.simulation.statistics import SimulationResult
from robsmooth.systems.augmented import augment


def refusals(attempts: Mapping[str, Callable[[], object]]) -> Table:
    """Return what each attempt is refused for.

    Parameters
    ----------
    attempts : mapping
        From what is wrong to a function that runs into it.
    """
    records = []
    for name, attempt in attempts.items():
        words = "not refused"
        try:
            attempt()
        except InfeasibleDesignError as error:
            words = str(error)
        records.append({"what is wrong": name, "what the library says": words})
    return Table.of_records(records, "Refusals.")


def own_systems(results: Mapping[str, tuple[RobustSmoother, SimulationResult]]) -> Table:
    """Return simulated errors against what is predicted and what is guaranteed."""
    records = []
    for name, (design, found) in results.items():
        predicted = error_covariance(
            design,
            found.equivalent_delta,
            loop="real",
            allow_inadmissible=True,
            reference="system",
        )
        smoothed, filtered = found.smoothed, found.filtered
        records.append(
            {
                "system": name,
                "smoothed error": cells.estimate(smoothed, ".3g", ".1g"),
                "predicted": float(np.trace(predicted)),
                "filtered error": cells.estimate(filtered, ".3g", ".1g"),
                "saved": f"{1 - smoothed.mean_square / filtered.mean_square:.0%}",
                "$2V$": design.mean_square_bound,
                "constraints used": f"{found.constraints.max():.0%}",
                "time outside": f"{100 * found.violated.max():.2g}%",
            }
        )
    return Table.of_records(
        records,
        "Mean square errors in the simulated nonlinear loop (± one standard error), against "
        "the prediction by equivalent slopes and the guarantee; how much of the energy that "
        "the constraints allow is used, and how long a nonlinearity is outside its slopes.",
        digits=3,
    )


def in_units(units: Mapping[str, float]) -> Table:
    """Return the example's least bound and error in other units of time, given in seconds."""
    records = []
    for name, unit in units.items():
        parameters = replace(
            PAPER, lam=PAPER.lam * unit, kappa=PAPER.kappa * unit, alpha=PAPER.alpha * unit**0.5
        )
        best = minimize_bound(augment(parameters.uncertain_system(), DELAY / unit, ORDER))
        edge = best.plant.structured_delta((), [-1.0])
        records.append(
            {
                "unit of time": name,
                "infimum of $V$ (rad²)": best.bound_infimum,
                r"error at $\Delta_2 = -1$ (rad²)": float(error_covariance(best.limit, edge)[0, 0]),
                r"$\tau$ (rad² s)": best.limit.tau * unit,
            }
        )
    return Table.of_records(
        records, "The least bound of the example, searched anew in each unit of time.", digits=12
    )
