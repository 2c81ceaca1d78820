"""What the panels show as sentences and as a table, and the settings as code."""

import math
from collections.abc import Mapping

import robsmooth as rs
from robsmooth._support.tables import Table
from robsmooth.explorer import snapshot as model
from robsmooth.explorer.snapshot import RUNS, SLOPES, Settings, Snapshot, simulate, take_snapshot


def code(settings: Settings) -> str:
    """Return code that finds the numbers on the panels by the public API, or raises why not."""
    p, low, high = settings.parameters, float(SLOPES[0]), float(SLOPES[-1])
    return f"""\
import numpy as np
import robsmooth as rs

parameters = rs.homodyne.HomodyneParameters(
    lam={p.lam!r}, kappa={p.kappa!r}, alpha={p.alpha!r}, beta={p.beta!r}, gamma={p.gamma!r}
)
system = parameters.uncertain_system()
{_design(settings)}

slopes = np.linspace({low!r}, {high!r}, {len(SLOPES)})
filtered = rs.delta_sweep(smoother, slopes, "filtered", loop="real")[:, 0, 0]
smoothed = rs.delta_sweep(smoother, slopes, "smoothed", loop="real")[:, 0, 0]
simulated = rs.monte_carlo(parameters, smoother, runs={RUNS})

print(smoother)
print("without uncertainty: filtered", filtered[-1], "smoothed", smoothed[-1])
print("at the sector's edge: filtered", filtered[0], "smoothed", smoothed[0])
print(simulated)
"""


def _design(settings: Settings) -> str:
    lag, order, cost = settings.lag, settings.order, settings.cost
    if settings.design == "classical":
        return f"smoother = rs.baselines.fixed_lag_smoother(system, {lag!r}, {order}, copies=True)"
    tau, multipliers = model.robust_arguments(settings)
    remark = f'tau is the best; rs.minimize_bound(plant, cost="{cost}") searches for all of them'
    if settings.design == "by hand":
        remark = "the design at these values, or the limit where some of them are zero"
    return f"""\
plant = rs.augment(system, delay={lag!r}, order={order})
# {remark}
smoother = rs.limiting_smoother(
    plant, tau={tau!r}, multipliers={list(multipliers)}, cost="{cost}"
)"""


def summary(snapshot: Snapshot, simulated: rs.MonteCarloResult | str) -> str:
    """Return what there is to learn at these settings, a sentence or three."""
    if isinstance(snapshot.estimator, str):
        return f"There is no design. {snapshot.estimator}."
    return f"{_simulation(simulated)} {_guarantee(snapshot)}"


def _simulation(simulated: rs.MonteCarloResult | str) -> str:
    if isinstance(simulated, str):
        return simulated.removesuffix(".") + "."
    filtered, smoothed = (error.mean_square for error in simulated.in_lock())
    slipped = simulated.slipped_paths
    if slipped == RUNS:
        return "With its sine the loop loses lock: every simulated path slips by whole turns."
    saved = 1.0 - smoothed / filtered
    text = (
        f"With the sine in the loop, smoothing has a mean square error of {smoothed:.4f} rad², "
        f"{abs(saved):.0%} {'below' if saved >= 0 else 'above'} the filter's {filtered:.4f} rad²."
    )
    if simulated.slips:
        text += f" That is for paths in lock: {slipped} of {RUNS} slip by whole turns."
    return text


def _guarantee(snapshot: Snapshot) -> str:
    found, settings = snapshot.guarantee, snapshot.settings
    if isinstance(found, str):
        return f"{found}."
    if math.isinf(found.bound):
        return "This design comes with no guarantee."
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
    columns = ("settings", "filtered (rad²)", "smoothed (rad²)", "saved")
    columns += ("guaranteed below (rad²)", "paths that slip")
    rows = []
    for name, settings in cases.items():
        snapshot = take_snapshot(settings)
        simulated = simulate(snapshot)
        found = ["no design", "no design", None, None, None]
        if not isinstance(simulated, str):
            filtered, smoothed = (error.mean_square for error in simulated.in_lock())
            bound = snapshot.guarantee.bound if snapshot.guarantee.bound < math.inf else "none"
            slipped = f"{simulated.slipped_paths} of {RUNS}"
            found = [filtered, smoothed, f"{1 - smoothed / filtered:.0%}", bound, slipped]
        rows.append((name, *found))
    return Table(columns, rows, caption, digits=3)
