"""Maps: numbers on a grid as shades, and hatched where there are none."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
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

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.homodyne.certificate import scalar_bound
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.homodyne.study import Study
from robsmooth.paper import published
from robsmooth.paper.figures import style

Array = NDArray[np.float64]

_TAU, _PAIR = r"$\tau$ (rad$^2\,$µs)", r"$\lambda_3 = \lambda_4$"
_INFIMUM = style.LOOSE | {"marker": "o", "color": "C1", "markeredgecolor": "w", "markersize": 7}


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


def bound_landscape(best: RobustSmoother) -> Figure:
    """Draw the example's bound around its best design: over tau, and over lambda_3 = lambda_4."""
    figure, (left, right) = plt.subplots(1, 2, sharey=True, figsize=(3.4, 2.4))
    taus, vanishing = best.tau * np.linspace(0.6, 2.0, 57), np.geomspace(1e-6, 2e-3, 60)
    left.plot(1e6 * taus, _bounds(best, taus, [1e-6])[:, 0])
    left.plot(1e6 * best.tau, best.bound, "o", color="C1", label="least bound")
    left.axvline(1e6 * published.printed("tau"), label="printed", **style.DOTTED)
    left.set(xlabel=_TAU, ylabel="bound $V$ (rad$^2$)")
    (values,) = _bounds(best, [best.tau], vanishing)
    right.semilogx(vanishing, values)
    right.axhline(best.bound_infimum, color="k", linestyle="-.", linewidth=0.9, label="infimum")
    if np.isnan(values).any():
        edge = vanishing[np.isfinite(values)].max()
        right.axvline(edge, color="C1", linestyle="--", linewidth=0.9, label="no design beyond")
    right.set(xlabel=_PAIR, xlim=vanishing[[0, -1]])
    return style.with_legend(figure)


def two_landscapes(designs: Mapping[str, RobustSmoother], points: int = 25) -> Figure:
    """Draw the example's bound over tau and lambda_3 = lambda_4, a map for each best design."""
    figure, panels = plt.subplots(1, len(designs), figsize=(3.4, 2.6), sharey=True)
    vanishing = np.geomspace(1e-6, 1e-2, points)
    best_taus = [best.limit.tau for best in designs.values()]
    taus = np.geomspace(0.4 * min(best_taus), 5.0 * max(best_taus), points)
    levels = [0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0]
    for axes, (title, best) in zip(panels, designs.items(), strict=True):
        excess = 100.0 * (_bounds(best, taus, vanishing) / best.limit.bound - 1.0)
        shading = shade(axes, vanishing, 1e6 * taus, excess, levels, missing="no design")
        axes.plot(vanishing[0], 1e6 * best.limit.tau, label="infimum (at 0)", **_INFIMUM)
        axes.set(xscale="log", yscale="log", title=title, xlabel=_PAIR)
        style.label_ticks(axes.yaxis, (0.5, 1, 2, 5))
    panels[0].set(ylabel=_TAU)
    figure.colorbar(shading, ax=panels, label="bound above its infimum (%)", pad=0.02, format="%g")
    drawn = [artist for axes in panels for artist in (*axes.lines, *axes.patches)]
    handles = {artist.get_label(): artist for artist in drawn}.values()
    return style.with_legend(figure, handles=handles)


def all_designs(
    parameters: HomodyneParameters, limit: RobustSmoother, printed: tuple[float, float]
) -> Figure:
    """Draw the bound for the filtered cost over p and tau; the printed ones are marked."""
    p, tau = np.linspace(0.2, 0.55, 281), 1e-6 * np.geomspace(0.4, 10.0, 200)
    values = scalar_bound(parameters, p[None, :], tau[:, None])
    values[np.isinf(values)] = np.nan
    figure, axes = plt.subplots(figsize=(3.4, 2.8))
    levels = [0.12, 0.125, 0.13, 0.14, 0.16, 0.2, 0.3, 0.5]
    shading = shade(axes, p, 1e6 * tau, values, levels, missing="no design")
    axes.plot(limit.multipliers[1:3].sum(), 1e6 * limit.tau, label="infimum", **_INFIMUM)
    cross = {"color": "w", "markersize": 6, "markeredgecolor": "k", "linestyle": "none"}
    axes.plot(printed[0], 1e6 * printed[1], "X", label="printed", **cross)
    axes.set(xlabel=r"$p = \lambda_2 + \lambda_3$", ylabel=_TAU, yscale="log")
    axes.locator_params(axis="x", nbins=5)
    style.label_ticks(axes.yaxis, (0.5, 1, 2, 5, 10))
    figure.colorbar(shading, ax=axes, label="bound $V$ (rad$^2$)", pad=0.02, format="%g")
    return style.with_legend(figure, 3, handles=[*axes.lines, *axes.patches])


def _bounds(best: RobustSmoother, taus: Sequence[float], vanishing: Sequence[float]) -> Array:
    """Return V for each tau and lambda_3 = lambda_4, not a number where there is no design."""
    bounds = np.full((len(taus), len(vanishing)), np.nan)
    for i, j in np.ndindex(bounds.shape):
        with suppress(InfeasibleDesignError):
            bounds[i, j] = published.design_near_edge(best, taus[i], vanishing[j]).bound
    return bounds


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
