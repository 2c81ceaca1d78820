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
from robsmooth.simulation.simulate import SimulationResult
from robsmooth.systems.augmented import augment


def refusals(attempts: Mapping[str, Callable[[], object]]) -> Table:
    """Return what each attempt is refused for.

    Parameters
    ----------
    attempts : mapping
        From what is wrong to a function that runs into it.
    """
    rows = []
    for name, attempt in attempts.items():
        try:
            attempt()
        except InfeasibleDesignError as error:
            rows.append((name, str(error)))
        else:
            rows.append((name, "not refused"))
    return Table(("what is wrong", "what the library says"), rows, "Refusals.")


def own_systems(results: Mapping[str, tuple[RobustSmoother, SimulationResult]]) -> Table:
    """Return simulated errors against what is predicted and what is guaranteed."""
    rows = []
    for name, (design, found) in results.items():
        predicted = error_covariance(
            design,
            found.equivalent_delta,
            copy_noise=False,
            allow_inadmissible=True,
            reference="system",
        )
        smoothed, filtered = found.smoothed, found.filtered
        rows.append(
            (
                name,
                f"{smoothed.mean_square:.3g} ± {smoothed.standard_error:.1g}",
                float(np.trace(predicted)),
                f"{filtered.mean_square:.3g} ± {filtered.standard_error:.1g}",
                f"{100 * (1 - smoothed.mean_square / filtered.mean_square):.0f}%",
                2.0 * design.bound,
                f"{100 * found.constraints.max():.0f}%",
                f"{100 * found.violated.max():.2g}%",
            )
        )
    return Table(
        columns=(
            "system",
            "smoothed error",
            "predicted",
            "filtered error",
            "saved",
            "$2V$",
            "constraints used",
            "time outside",
        ),
        rows=rows,
        caption=(
            "Mean square errors in the simulated nonlinear loop (± one standard error), against "
            "the prediction by equivalent slopes and the guarantee; how much of the energy that "
            "the constraints allow is used, and how long a nonlinearity is outside its slopes."
        ),
        digits=3,
    )


def in_units(units: Mapping[str, float]) -> Table:
    """Return the example's least bound and error in other units of time, given in seconds."""
    rows = []
    for name, unit in units.items():
        parameters = replace(
            PAPER, lam=PAPER.lam * unit, kappa=PAPER.kappa * unit, alpha=PAPER.alpha * unit**0.5
        )
        best = minimize_bound(augment(parameters.uncertain_system(), DELAY / unit, ORDER))
        edge = best.plant.structured_delta((), [-1.0])
        error = float(error_covariance(best.limit, edge)[0, 0])
        rows.append((name, best.bound_infimum, error, best.limit.tau * unit))
    return Table(
        columns=(
            "unit of time",
            "infimum of $V$ (rad²)",
            r"error at $\Delta_2 = -1$ (rad²)",
            r"$\tau$ (rad² s)",
        ),
        rows=rows,
        caption="The least bound of the example, searched anew in each unit of time.",
        digits=12,
    )
