"""The figures of what the paper leaves open, and of a system of one's own."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robsmooth.analysis.lag import LagSweep
from robsmooth.homodyne.comparison import Compared
from robsmooth.paper.figures import style
from robsmooth.simulation.statistics import SamplePaths


def side_by_side(compared: Mapping[str, Compared], slopes: Sequence[float], limit: float) -> Figure:
    """Draw the errors of estimators in rows; those beyond the limit (rad^2) are said to be."""
    figure, axes = plt.subplots(figsize=(3.4, 1.1 + 0.36 * len(compared)))
    legend = {}
    for row, case in zip(style.label_rows(axes, compared), compared.values(), strict=True):
        if case.at[0] > limit:
            text = f"off the scale: {case.at[0]:.2f}"
            axes.annotate(text, (limit, row), ha="right", va="center", color="0.3")
            continue
        allowed = case.allowed.mean_square
        axes.plot([min(case.at), allowed], [row, row], "-", color="0.8", linewidth=2.5, zorder=1)
        for number, (value, marker) in enumerate(zip(case.at, "o^s", strict=False)):
            (drawn,) = axes.plot(value, row, marker, color=f"C{number}", markersize=4, ls="none")
            legend[rf"$\Delta_2 = {slopes[number]:g}$"] = drawn
        (legend["worst allowed"],) = axes.plot(allowed, row, "k|", markersize=8, ls="none")
        (legend["with the sine"],) = axes.plot(case.exact, row, "kx", ls="none")
    axes.set(xlabel=r"mean square error (rad$^2$)", xlim=(0.03, limit))
    return style.with_legend(figure, 3, handles=legend.values(), labels=legend.keys())


def lag_and_order(sweeps: Mapping[str, LagSweep], lag: float) -> Figure:
    """Draw smoothed errors of designs against the lag, for each order; `lag` (s) is marked."""
    options = {"squeeze": False, "sharex": True, "sharey": "col"}
    figure, panels = plt.subplots(len(sweeps), 2, figsize=(3.4, 1.4 + 1.4 * len(sweeps)), **options)
    for (left, right), (name, sweep) in zip(panels, sweeps.items(), strict=True):
        lags = 1e6 * sweep.lags
        style.plot_curves(left, lags, dict(zip(sweep.orders, sweep.nominal, strict=True)))
        style.plot_curves(right, lags, dict(zip(sweep.orders, sweep.worst, strict=True)))
        left.fill_between(lags, 0.0, sweep.optimal, color="0.85", lw=0, label="below the optimum")
        dots = style.MARK | {"linestyle": (0, (1, 1)), "color": "0.2"}
        left.axhline(sweep.two_sided, label="two-sided optimum", **dots)
        for axes in (left, right):
            axes.axvline(1e6 * lag, label=f"lag {1e6 * lag:.3g} µs", **style.MARK)
            axes.set(xscale="log")
        left.set(ylabel=name)
    figure.supylabel(r"mean square error (rad$^2$)")
    low, high = sweep.two_sided, sweep.filtering
    panels[0, 0].set(title="no uncertainty", ylim=(0.9 * low, 1.25 * high))
    panels[0, 1].set(title="worst constant", ylim=(1.4 * low, 2.2 * high))
    every = 1e6 * np.concatenate([sweep.lags for sweep in sweeps.values()])
    for first, last in zip(panels[0], panels[-1], strict=True):
        first.locator_params(axis="y", nbins=4)
        last.set(xlabel="lag (µs)", xlim=(every.min(), every.max()))
        style.label_ticks(last.xaxis, (0.3, 1, 3, 10, 30))
    handles, labels = panels[0, 0].get_legend_handles_labels()
    return style.with_legend(figure, handles=handles, labels=labels)


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
