"""The figures of the notebooks."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from robsmooth.homodyne.montecarlo import MeanSquare
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.homodyne.study import Study
from robsmooth.paper.figures import style
from robsmooth.paper.predictions import ErrorsByMethod
from robsmooth.simulation.statistics import SamplePaths
from robsmooth.systems.delay import pade_delay

Array = NDArray[np.float64]
Errors = Mapping[str, float]


def sector(parameters: HomodyneParameters, variance: float) -> Figure:
    """Draw Fig. 3: the sine in its sector, and the Gaussian density of an error with a variance."""
    figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(3.4, 4.2), height_ratios=(3, 1))
    error = np.linspace(-np.pi, np.pi, 721)
    upper, lower, wide = parameters.beta, parameters.lower_slope, parameters.sector_slope
    label = rf"design's sector $[{lower:g},\,{upper:g}]$"
    band = {"color": "C0", "alpha": 0.2, "linewidth": 0, "label": label}
    top.fill_between(error, lower * error, upper * error, **band)
    top.plot(error, np.sin(error), color="C1", linestyle="-", label=r"$\sin\mu_1$")
    top.plot(error, upper * error, label=rf"tangent, $\beta={upper:g}$", **style.DOTTED)
    dashed = {"color": "C4", "linestyle": "--", "linewidth": 0.9}
    top.plot(error, wide * error, label=rf"$m=1-2\gamma={wide:.1f}$", **dashed)
    reach = parameters.sector_range()
    for axes, end in itertools.product((top, bottom), (-reach, reach)):
        axes.axvline(end, color="C0", linestyle="-.", linewidth=0.8)
    beside = {"xytext": (3, 0), "textcoords": "offset points", "color": "C0"}
    top.annotate(f"{reach:.2f} rad", (reach, -1.55), **beside)
    top.set(ylim=(-1.75, 1.75), ylabel=r"$y = f(\mu_1) + \beta\mu_1$")
    density = np.exp(-(error**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    bottom.fill_between(error, density, color="0.6", linewidth=0)
    bottom.set(xlabel=r"phase error $\mu_1 = \phi - \hat\phi$ (rad)", ylabel="density\n(1/rad)")
    bottom.set(xlim=(-np.pi, np.pi), ylim=(0, None))
    return style.with_legend(figure)


def delta_sweep(
    slopes: Array, curves: Mapping[str, Array], marks: Mapping[str, Any] | None = None
) -> Figure:
    """Draw error covariances (rad^2) at the slopes Delta_2, as Fig. 4, and mark some points."""
    several = len(curves) > 2  # some of them may lie on one another: then markers take turns
    figure, axes = plt.subplots(figsize=(3.4, 3.1 if several else 2.6))
    for number, (label, look) in enumerate(zip(curves, style.styles(curves, several), strict=True)):
        turn = (0.2 * number / len(curves), 0.2)
        axes.plot(slopes, curves[label], label=label, markevery=turn, markerfacecolor="w", **look)
    for label, (slope, value) in (marks or {}).items():
        axes.plot(slope, value, "k*", markersize=7, label=label, **style.LOOSE)
    axes.set(xlabel=r"measurement uncertainty $\Delta_2$", xlim=(min(slopes), max(slopes)))
    axes.set(ylabel=r"error covariance (rad$^2$)", ylim=(0, None))
    axes.locator_params(nbins=5)
    if several:
        return style.with_legend(figure)
    axes.legend()
    return figure


def delay_error(delay: float, orders: Sequence[int], bandwidth: float) -> Figure:
    """Draw how far Pade models of a delay (s) are off, and mark the filter's bandwidth (rad/s)."""
    omega = np.geomspace(bandwidth / 10, bandwidth * 100, 400)
    exact = np.exp(-1j * omega * delay)
    models = {order: pade_delay(delay, order).response(omega)[:, 0, 0] for order in orders}
    figure, axes = plt.subplots()
    axes.set(xscale="log", yscale="log", ylabel=r"$|H(i\omega) - e^{-i\omega\delta}|$")
    style.plot_curves(axes, omega, {order: np.abs(of - exact) for order, of in models.items()})
    axes.axvline(bandwidth, label="bandwidth", **style.DOTTED)
    axes.set(xlabel=r"angular frequency $\omega$ (rad/s)", ylim=(1e-12, 4.0))
    axes.set(xlim=(omega[0], 20 * bandwidth))  # beyond, all are as wrong as can be
    axes.legend(loc="lower right")
    return figure


def mean_squares(
    cases: Sequence[str], results: Mapping[str, list[MeanSquare]], printed: Errors
) -> Figure:
    """Draw each quantity's simulated errors, a row for each case, and the printed as lines."""
    figure, axes = plt.subplots(figsize=(3.4, 0.9 + 0.36 * len(cases)))
    heights = style.label_rows(axes, cases, width=18)
    looks = style.styles([label.split(",")[0] for label in results], markers=True)
    above = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "va": "bottom"}
    for look, (label, values) in zip(looks, results.items(), strict=True):
        style.plot_intervals(axes, values, heights, label=label, **look)
        if label in printed:
            value, color = printed[label], look["color"]
            axes.axvline(value, color=color, linestyle="--", linewidth=0.9)
            side = "right" if value == min(printed.values()) else "left"
            text = {"text": f"printed {value:g}", "ha": side, "color": color}
            axes.annotate(xy=(value, 1.0), xytext=(0, 1), **text, **above)
    axes.set(xlabel=r"mean square error (rad$^2$)", xlim=(0, 1.3 * max(printed.values())))
    return style.with_legend(figure)


def errors_by_method(found: ErrorsByMethod) -> Figure:
    """Draw how far the methods are from the moments for each error, with 95% intervals."""
    figure, axes = plt.subplots(figsize=(3.4, 1.0 + 0.34 * len(found)))
    heights = style.label_rows(axes, found)
    axes.axvline(0.0, **style.MARK)
    methods = [method for method in next(iter(found.values())) if method != "moments"]
    looks = style.styles(methods, markers=True)
    for number, (look, method) in enumerate(zip(looks, methods, strict=True)):
        relative = []
        for by_method in found.values():
            value, exact = by_method[method], by_method["moments"].mean_square
            difference = value.mean_square / exact - 1
            relative.append(MeanSquare(100 * difference, 100 * value.standard_error / exact))
        style.plot_intervals(axes, relative, heights + 0.2 * (1 - number), label=method, **look)
    axes.set(xlabel="difference from the moments (%)")
    return style.with_legend(figure)


def loss_of_lock(sweep: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the filtered errors and the rate of cycle slips against the phase noise."""
    figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(3.4, 3.8), height_ratios=(3, 2))
    factors, simulated = ([case[name] for case in sweep] for name in ("factor", "simulated"))
    errors = {
        "all runs": [each.filtered.mean_square for each in simulated],
        "runs in lock": [each.filtered_in_lock.mean_square for each in simulated],
    }
    for method in ("moments", "statistical linearisation"):
        errors[method] = [case[method] for case in sweep]
    looks = style.styles(errors, markers=True)
    for number, (look, label) in enumerate(zip(looks, errors, strict=True)):
        # all but the first lie on one another: each is seen through the next, which is smaller
        size = {"markersize": max(9 - 2 * number, 3) if number else 3, "markerfacecolor": "none"}
        top.loglog(factors, errors[label], label=label, **look | size)
    top.set(ylabel=r"filtered error (rad$^2$)")
    rates = [each.slip_rate or np.nan for each in simulated]  # zero has no logarithm
    bottom.loglog(factors, rates, "o-", markersize=3)
    bottom.set(xlabel="factor on the power of the phase noise", ylabel="cycle slips (1/s)")
    style.label_ticks(bottom.xaxis, (1, 2, 5, 10, 20, 50))
    return style.with_legend(figure)


def candidates(
    errors: Mapping[str, Errors], floors: Errors, unit: str, limits: tuple[float, float]
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


def where_robustness_pays(maps: Mapping[str, tuple[Array, Array, Array]]) -> Figure:
    """Draw, for each family, its sizes (N,), noises (M,) and ratios of certified errors (M, N)."""
    rows = (len(maps) + 1) // 2
    figure, panels = plt.subplots(rows, 2, figsize=(3.4, 0.5 + 1.7 * rows), sharey=True)
    levels = [1.0, 1.1, 2.0, 10.0, 100.0, 1000.0]
    for axes, (title, (sizes, noises, ratios)) in zip(panels.flat, maps.items(), strict=True):
        gains = np.log(np.maximum(ratios, 1.0))  # a little less comes of the model of the delay
        shading = shade(axes, 100.0 * sizes, noises, gains, np.log(levels), "no guarantee")
        axes.set(xscale="log", yscale="log", title=title)
        style.label_ticks(axes.xaxis, (1, 2, 5, 10, 20, 50))
    figure.supxlabel("uncertainty (%)")
    figure.supylabel("measurement noise / signal")
    bar = figure.colorbar(shading, ax=panels, label="certified error, classical / minimax")
    bar.set_ticks(np.log(levels), labels=[f"{level:g}" for level in levels])
    return figure


def where_smoothing_pays(study: Study, gamma: float, lag: float) -> Figure:
    """Draw what smoothing saves of the filtered error, over lag and noise, and for each order.

    Both errors of a ratio are of one loop: with its sine for designs, linear for the optimum.
    """
    i = study.gammas.index(gamma)
    ratio = study.ratio[i]
    lags, noises = 1e6 * np.array(study.lags), np.array(study.noises)
    middle = int(np.argmin(np.abs(np.log(noises))))
    figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(3.4, 5.4))

    saved = 100 * (1 - ratio[:, -1])
    shading = shade(top, lags, noises, saved, np.arange(0, 61, 10), missing="no design or lock")
    hatch(top, lags, noises, -saved, "no gain", hatch="-----")
    there = ~np.isnan(saved).all(axis=1)
    best = lags[np.nanargmax(saved[there], axis=1)]
    points = style.LOOSE | {"markeredgecolor": "k"}
    top.plot(best, noises[there], "o", color="w", label="best lag", **points)
    star = points | {"color": "C1", "markersize": 9, "label": "the paper's"}
    top.plot(1e6 * lag, noises[middle], "*", **star)
    top.set(xscale="log", yscale="log", ylabel="shot noise / the paper's")
    style.label_ticks(top.yaxis, (0.1, 0.3, 1, 3, 10))
    figure.colorbar(shading, ax=top, label="saved by smoothing (%)", pad=0.02)

    optimal = study.optimal_ratio[i, middle, -1]
    bottom.plot(lags, optimal, label="both optimal, linear loop", **style.TRUTH)
    style.plot_curves(bottom, lags, dict(zip(study.orders, ratio[middle], strict=True)))
    bottom.axhline(1.0, color="k", linestyle="-", linewidth=0.6)
    bottom.axvline(1e6 * lag, **style.MARK)
    bottom.set(xlabel="lag (µs)", ylabel="smoothed / filtered error")
    bottom.set(ylim=(0.4, 1.6), xlim=lags[[0, -1]])
    style.label_ticks(bottom.xaxis, (0.3, 1, 3, 10, 30))
    handles = [*top.patches, *top.lines, *bottom.get_legend_handles_labels()[0]]
    return style.with_legend(figure, handles=handles)


def sample_path(paths: SamplePaths, unit: str, scale: float, quantity: str) -> Figure:
    """Draw the first output of the first path, and its estimates; a second has `scale` units."""
    figure, axes = plt.subplots(figsize=(3.4, 2.4))
    time = scale * paths.time
    axes.plot(time, paths.w[0, :, 0], label="true", **style.TRUTH)
    style.plot_curves(axes, time, {"filtered": paths.filtered[0, :, 0]})
    style.plot_curves(axes, time - scale * paths.delay, {"smoothed": paths.smoothed[0, :, 0]})
    axes.set(xlabel=f"time ({unit})", ylabel=quantity, xlim=(0.0, time[-1]))
    return style.with_legend(figure, 3)


def gap(record: SamplePaths, estimates: Array, missing: slice) -> Figure:
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


def smoother_response(omega: Array, response: NDArray[np.complexfloating], delay: float) -> Figure:
    """Draw a smoother's response at the frequencies omega (rad/s) beside that of its delay (s)."""
    figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(3.4, 3.0))
    top.loglog(omega, np.ones_like(omega), label="pure delay", **style.TRUTH)
    style.plot_curves(top, omega, {"smoother": np.abs(response)})
    top.set(ylabel="magnitude", ylim=(1e-2, 3.0))
    top.legend(loc="lower left")
    bottom.plot(omega, np.degrees(-omega * delay), **style.TRUTH)
    style.plot_curves(bottom, omega, {"smoother": np.degrees(np.unwrap(np.angle(response)))})
    bottom.set(ylabel="phase (°)", yticks=np.arange(-360, 1, 90), ylim=(-400.0, 20.0))
    bottom.set(xlabel=r"angular frequency $\omega$ (rad/s)", xlim=omega[[0, -1]])
    return figure


def shade(
    axes: Axes, x: Array, y: Array, values: Array, levels: Sequence[float], missing: str
) -> ContourSet:
    """Shade (M, N) values over (N,) x and (M,) y from the least values of the shades.

    What is not a number is hatched, with the label `missing`.
    """
    norm = BoundaryNorm(levels, 256, extend="max")
    shading = axes.contourf(x, y, _spread(values), levels, norm=norm, extend="max")
    hatch(axes, x, y, np.isnan(values) - 0.5, missing, zorder=1.5)  # on what is spread
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    axes.grid(visible=False)
    return shading


def hatch(axes: Axes, x: Array, y: Array, excess: Array, label: str, **look: Any) -> None:
    """Hatch where (M, N) numbers for (N,) x and (M,) y are above zero; they are interpolated."""
    most = np.nanmax(excess, initial=0.0)
    if most > 0.0:
        region = axes.contourf(x, y, _spread(excess), [0.0, 2.0 * most])
        (path,) = region.get_paths()
        region.remove()
        axes.add_patch(PathPatch(path, label=label, **style.NOWHERE | look))


def _spread(values: Array) -> Array:
    """Return values on a grid, and beside them, where there is none, the nearest one."""
    distance, nearest = distance_transform_edt(np.isnan(values), return_indices=True)
    return np.where(distance < 2.0, values[tuple(nearest)], np.nan)
