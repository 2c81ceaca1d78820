"""Maps: numbers on a grid as shades, and hatched where there are none."""

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

from robsmooth.homodyne.study import Study
from robsmooth.paper.figures import style

Array = NDArray[np.float64]


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
    figure, (top, bottom) = style.stacked(5.4, (1, 1))

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
