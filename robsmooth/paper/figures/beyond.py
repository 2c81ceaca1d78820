"""The figures of what the paper leaves open, and of a system of one's own."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robsmooth.paper.figures import style
from robsmooth.simulation.statistics import SamplePaths


def candidates(
    errors: Mapping[str, Mapping[str, float]],
    floors: Mapping[str, float],
    unit: str,
    limits: tuple[float, float],
) -> Figure:
    """Draw errors of estimators in rows, by their names; those beyond the limits as numbers.

    The floors are lines, in the order of their names.
    """
    figure, axes = plt.subplots(figsize=(3.4, 1.3 + 0.34 * len(errors)))
    legend = {}
    for row, each in zip(style.label_rows(axes, errors), errors.values(), strict=True):
        seen = [min(value, limits[1]) for value in each.values()]
        axes.plot([min(seen), max(seen)], [row, row], "-", color="0.85", linewidth=2.5, zorder=1)
        for number, (name, value) in enumerate(each.items()):
            look = style.LOOSE | {"marker": "o^|x"[number], "color": ("C0", "C1", "k", "k")[number]}
            if value <= limits[1]:
                (legend[name],) = axes.plot(value, row, **look)
            else:
                axes.annotate(f"{value:.3g} →", (limits[1], row + 0.2), ha="right", color="0.3")
    for dashes, (name, floor) in zip(("-", "--", ":"), floors.items(), strict=False):
        legend[name] = axes.axvline(floor, color="0.45", linestyle=dashes, linewidth=0.9, zorder=0)
    axes.set(xlabel=f"mean square error ({unit})", xlim=limits)
    return style.with_legend(figure, 2, handles=legend.values(), labels=legend.keys())


def sample_path(paths: SamplePaths, unit: str, scale: float, quantity: str) -> Figure:
    """Draw the first output of the first path, and its estimates; a second has `scale` units."""
    figure, axes = plt.subplots(figsize=(3.4, 2.4))
    time = scale * paths.time
    axes.plot(time, paths.w[0, :, 0], label="true", **style.TRUTH)
    style.plot_curves(axes, time, {"filtered": paths.filtered[0, :, 0]})
    style.plot_curves(axes, time - scale * paths.delay, {"smoothed": paths.smoothed[0, :, 0]})
    axes.set(xlabel=f"time ({unit})", ylabel=quantity, xlim=(0.0, time[-1]))
    return style.with_legend(figure, 3)


def gap(record: SamplePaths, estimates: NDArray[np.float64], missing: slice) -> Figure:
    """Draw the first output of a record around the measurements that its estimates (N, m) miss."""
    around = slice(max(missing.start - 600, 0), missing.stop + 600)
    figure, axes = plt.subplots(figsize=(3.4, 2.2))
    time = record.time[around]
    ends = record.time[[missing.start, missing.stop]] - record.step
    axes.axvspan(*ends, label="no measurement", **style.NOWHERE)
    axes.plot(time, record.w[0, around, 0], label="true", **style.TRUTH)
    style.plot_curves(axes, time - record.delay, {"smoothed": estimates[around, 0]})
    axes.set(xlabel="time (s)", ylabel="angle (rad)", xlim=time[[0, -1]])
    return style.with_legend(figure, 3)


def smoother_response(
    omega: NDArray[np.float64], response: NDArray[np.complexfloating], delay: float
) -> Figure:
    """Draw a smoother's response at the frequencies omega (rad/s) beside that of its delay (s)."""
    figure, (top, bottom) = style.stacked(3.0, (1, 1))
    top.loglog(omega, np.ones_like(omega), label="pure delay", **style.TRUTH)
    style.plot_curves(top, omega, {"smoother": np.abs(response)})
    top.set(ylabel="magnitude", ylim=(1e-2, 3.0))
    top.legend(loc="lower left")
    bottom.plot(omega, np.degrees(-omega * delay), **style.TRUTH)
    style.plot_curves(bottom, omega, {"smoother": np.degrees(np.unwrap(np.angle(response)))})
    bottom.set(ylabel="phase (°)", yticks=np.arange(-360, 1, 90), ylim=(-400.0, 20.0))
    bottom.set(xlabel=r"angular frequency $\omega$ (rad/s)", xlim=omega[[0, -1]])
    return figure
