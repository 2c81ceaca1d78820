"""What the panels show as sentences and as a table, and the settings as code."""

import math
from collections.abc import Mapping

from robsmooth._support.tables import Table
from robsmooth.explorer.settings import Settings
from robsmooth.explorer.snapshot import (
    RUNS,
    SLOPES,
    Snapshot,
    robust_arguments,
    simulate,
    take_snapshot,
)
from robsmooth.homodyne.montecarlo import MonteCarloResult

_CODE = """\
import numpy as np
import robsmooth as rs

parameters = rs.homodyne.HomodyneParameters(
    lam={p.lam!r}, kappa={p.kappa!r}, alpha={p.alpha!r}, beta={p.beta!r}, gamma={p.gamma!r}
)
system = parameters.uncertain_system()
{design}
slopes = np.linspace({low!r}, {high!r}, {points})
filtered = rs.delta_sweep(smoother, slopes, "filtered", loop="real")[:, 0, 0]
smoothed = rs.delta_sweep(smoother, slopes, "smoothed", loop="real")[:, 0, 0]
simulated = rs.monte_carlo(parameters, smoother, runs={runs})

print(smoother)
print("without uncertainty: filtered", filtered[-1], "smoothed", smoothed[-1])
print("at the sector's edge: filtered", filtered[0], "smoothed", smoothed[0])
print(simulated)
"""
_CLASSICAL = "smoother = rs.baselines.fixed_lag_smoother(system, {lag!r}, {order}, copies=True)\n"
_ROBUST = """\
plant = rs.augment(system, delay={lag!r}, order={order})
# {remark}
smoother = rs.limiting_smoother(
    plant, tau={tau!r}, multipliers={multipliers}, cost="{cost}"
)
"""
_SEARCHED = 'tau is the best; rs.minimize_bound(plant, cost="{cost}") searches for all of them'
_GIVEN = "the design at these values, or the limit where some of them are zero"


def code(settings: Settings) -> str:
    """Return code that finds the numbers on the panels by the public API.

    Where there is no design it raises what says so.
    """
    if settings.design == "classical":
        design = _CLASSICAL.format(lag=settings.lag, order=settings.order)
    else:
        tau, multipliers = robust_arguments(settings)
        remark = _GIVEN if settings.design == "by hand" else _SEARCHED.format(cost=settings.cost)
        design = _ROBUST.format(
            lag=settings.lag,
            order=settings.order,
            remark=remark,
            tau=tau,
            multipliers=list(multipliers),
            cost=settings.cost,
        )
    return _CODE.format(
        p=settings.parameters,
        design=design,
        low=float(SLOPES[0]),
        high=float(SLOPES[-1]),
        points=len(SLOPES),
        runs=RUNS,
    )


def summary(snapshot: Snapshot, simulated: MonteCarloResult | str) -> str:
    """Return what there is to learn at these settings, a sentence or three."""
    if isinstance(snapshot.estimator, str):
        return f"There is no design. {snapshot.estimator}."
    return " ".join((_simulation(simulated), _guarantee(snapshot)))


def _simulation(simulated: MonteCarloResult | str) -> str:
    if isinstance(simulated, str):
        return simulated.removesuffix(".") + "."
    filtered, smoothed = (error.mean_square for error in simulated.in_lock())
    if simulated.slipped_paths == RUNS:
        return "With its sine the loop loses lock: every simulated path slips by whole turns."
    saved = 1.0 - smoothed / filtered
    text = (
        f"With the sine in the loop, smoothing has a mean square error of {smoothed:.4f} rad², "
        f"{abs(saved):.0%} {'below' if saved >= 0 else 'above'} the filter's {filtered:.4f} rad²."
    )
    if simulated.slips:
        text += (
            f" That is for paths in lock: {simulated.slipped_paths} of {RUNS} slip by whole turns."
        )
    return text


def _guarantee(snapshot: Snapshot) -> str:
    found = snapshot.guarantee
    if isinstance(found, str):
        return f"{found}."
    if math.isinf(found.bound):
        return "This design comes with no guarantee."
    settings = snapshot.settings
    text = (
        f"Guaranteed, for every uncertainty in the sector: a {settings.cost} error below "
        f"{found.bound:.4f} rad²; the largest in the panel is {found.errors.max():.4f} rad²."
    )
    prior = settings.kappa / (2.0 * settings.lam)  # the phase's own variance
    if found.bound >= prior:
        text += f" That is no better than not to measure at all, {prior:.4f} rad²."
    return text


def experiments(cases: Mapping[str, Settings], caption: str) -> Table:
    """Return what the panels show in several cases, one a row."""
    rows: list[tuple] = []
    for name, settings in cases.items():
        snapshot = take_snapshot(settings)
        simulated = simulate(snapshot)
        if isinstance(simulated, str):
            rows.append((name, "no design", "no design", None, None, None))
            continue
        filtered, smoothed = (error.mean_square for error in simulated.in_lock())
        bound = snapshot.guarantee.bound
        rows.append(
            (
                name,
                filtered,
                smoothed,
                f"{100 * (1 - smoothed / filtered):.0f}%",
                bound if math.isfinite(bound) else "none",
                f"{simulated.slipped_paths} of {RUNS}",
            )
        )
    columns = (
        "settings",
        "filtered (rad²)",
        "smoothed (rad²)",
        "saved",
        "guaranteed below (rad²)",
        "paths that slip",
    )
    return Table(columns, rows, caption, digits=3)
