"""What the panels show as sentences, and the settings as code."""

import math

import robsmooth as rs
from robsmooth.explorer import snapshot as model
from robsmooth.explorer.snapshot import SLOPES, Settings, Snapshot

JUDGING = "The certified worst error is being prepared."


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
plant = rs.augment(system, delay={settings.lag!r}, order={settings.order})
{_design(settings)}

slopes = np.linspace({low!r}, {high!r}, {len(SLOPES)})
filtered = rs.delta_sweep(smoother, slopes, "filtered", loop="real")[:, 0, 0]
smoothed = rs.delta_sweep(smoother, slopes, "smoothed", loop="real")[:, 0, 0]
judged = rs.judge(smoother, "{settings.cost}")
with_sine = rs.statistical_linearisation(parameters, smoother)

print(smoother)
print("from the sector's edge to no uncertainty: filtered", filtered, "smoothed", smoothed)
print(judged)
print(with_sine)
"""


def _design(settings: Settings) -> str:
    cost = settings.cost
    match settings.design:
        case "minimax":
            return f'smoother = rs.minimax_smoother(plant, "{cost}")'
        case "classical":
            arguments = f"system, {settings.lag!r}, {settings.order}, copies=True"
            return f"smoother = rs.baselines.fixed_lag_smoother({arguments})"
        case "tuned classical":
            return f'smoother = rs.baselines.tuned_fixed_lag_smoother(plant, output="{cost}")'
        case "robust":
            remark = f'tau is the best; rs.minimize_bound(plant, "{cost}") searches for all of them'
        case _:
            remark = "the design at these values, or the limit where some of them are zero"
    tau, multipliers = model.robust_arguments(settings)
    return f"""\
# {remark}
smoother = rs.limiting_smoother(
    plant, tau={tau!r}, multipliers={list(multipliers)}, cost="{cost}"
)"""


def summary(snapshot: Snapshot) -> str:
    """Return what there is to learn at these settings, a sentence or three."""
    if isinstance(snapshot.estimator, str):
        return f"There is no design. {snapshot.estimator}."
    return f"{_with_the_sine(snapshot)} {_certificate(snapshot)}"


def _with_the_sine(snapshot: Snapshot) -> str:
    if isinstance(snapshot.predicted, str):
        return snapshot.predicted.removesuffix(".") + "."
    loop, reach = snapshot.predicted.own, snapshot.settings.parameters.sector_range()
    outside = 1.0 - rs.homodyne.fraction_inside(reach, loop.filtered)
    return (
        f"With the sine in the loop, smoothing has a mean square error of {loop.smoothed:.4f} "
        f"rad², {_compared(loop.smoothed, loop.filtered)} the filter's {loop.filtered:.4f} rad². "
        f"The sine is outside its sector for a share of {outside:.0e} of the time."
    )


def _certificate(snapshot: Snapshot) -> str:
    settings = snapshot.settings
    if isinstance(snapshot.judged, str):
        return f"{snapshot.judged}."
    own, classical = (judgement.certified for judgement in snapshot.judged)
    if math.isnan(own):
        return JUDGING
    if math.isinf(own):
        return "Nothing is certified: uncertainty in the sector could make the error unbounded."
    text = f"Certified, for every uncertainty in the sector: a {settings.cost} error of at most "
    text += f"{own:.4f} rad²"
    if settings.design != "classical":
        text += f", {_compared(own, classical)} that of the classical smoother"
    prior = settings.kappa / (2.0 * settings.lam)  # the phase's own variance
    if own >= prior:
        text += f"; not to measure at all is as good, {prior:.4f} rad²"
    return f"{text}."


def _compared(error: float, other: float) -> str:
    share = f"{abs(1.0 - error / other):.1%}"
    return (
        "no better than" if share == "0.0%" else f"{share} {'below' if error < other else 'above'}"
    )
