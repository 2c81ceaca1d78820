"""The figures of the bound V of the example, over tau and the multipliers."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.homodyne.certificate import scalar_bound
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import published
from robsmooth.paper.figures.axes import DOTTED, LOOSE, label_ticks
from robsmooth.paper.figures.maps import shade

_TAU = r"$\tau$ (rad$^2\,$µs)"
_PAIR = r"$\lambda_3 = \lambda_4$"
_INFIMUM = LOOSE | {"marker": "o", "color": "C1", "markeredgecolor": "w", "markersize": 7}


def bound_landscape(best: RobustSmoother) -> Figure:
    """Draw the example's bound around its best design: over tau, and over lambda_3 = lambda_4."""
    figure, (left, right) = plt.subplots(1, 2, sharey=True, figsize=(3.4, 2.4))
    taus = best.tau * np.linspace(0.6, 2.0, 57)
    left.plot(1e6 * taus, [_bound(best, tau, 1e-6) for tau in taus])
    left.plot(1e6 * best.tau, best.bound, "o", color="C1", label="least bound")
    left.axvline(1e6 * published.printed("tau"), label="printed", **DOTTED)
    left.set(xlabel=_TAU, ylabel="bound $V$ (rad$^2$)")
    vanishing = np.geomspace(1e-6, 2e-3, 60)
    values = np.array([_bound(best, best.tau, value) for value in vanishing])
    right.semilogx(vanishing, values)
    right.axhline(best.bound_infimum, color="k", linestyle="-.", linewidth=0.9, label="infimum")
    if np.isnan(values).any():
        edge = vanishing[np.isfinite(values)].max()
        right.axvline(edge, color="C1", linestyle="--", linewidth=0.9, label="no design beyond")
    right.set(xlabel=_PAIR, xlim=vanishing[[0, -1]])
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def two_landscapes(designs: Mapping[str, RobustSmoother], points: int = 25) -> Figure:
    """Draw the example's bound over tau and lambda_3 = lambda_4, a map for each cost.

    The designs are those with the least bounds, by the titles of the maps; each map has a number
    of points along each axis.
    """
    figure, panels = plt.subplots(1, len(designs), figsize=(3.4, 2.6), sharey=True)
    vanishing = np.geomspace(1e-6, 1e-2, points)
    best_taus = [best.limit.tau for best in designs.values()]
    taus = np.geomspace(0.4 * min(best_taus), 5.0 * max(best_taus), points)
    levels = [0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0]
    for axes, (title, best) in zip(panels, designs.items(), strict=True):
        bounds = np.array([[_bound(best, tau, value) for value in vanishing] for tau in taus])
        excess = 100.0 * (bounds / best.limit.bound - 1.0)
        shading = shade(axes, vanishing, 1e6 * taus, excess, levels, missing="no design")
        axes.plot(vanishing[0], 1e6 * best.limit.tau, label="infimum (at 0)", **_INFIMUM)
        axes.set(xscale="log", yscale="log", title=title, xlabel=_PAIR)
        label_ticks(axes.yaxis, (0.5, 1, 2, 5))
    panels[0].set(ylabel=_TAU)
    figure.colorbar(shading, ax=panels, label="bound above its infimum (%)", pad=0.02, format="%g")
    drawn = [artist for axes in panels for artist in (*axes.lines, *axes.patches)]
    handles = {artist.get_label(): artist for artist in drawn}.values()
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def all_designs(
    parameters: HomodyneParameters, limit: RobustSmoother, printed: tuple[float, float]
) -> Figure:
    """Draw the bound of the example with the filtered cost over p and tau, all else at its best.

    Two points are marked: the limit where the infimum is, and p and tau of the printed design.
    """
    p = np.linspace(0.2, 0.55, 281)
    tau = 1e-6 * np.geomspace(0.4, 10.0, 200)
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
    label_ticks(axes.yaxis, (0.5, 1, 2, 5, 10))
    figure.colorbar(shading, ax=axes, label="bound $V$ (rad$^2$)", pad=0.02, format="%g")
    figure.legend(handles=[*axes.lines, *axes.patches], loc="outside lower center", ncols=3)
    return figure


def _bound(best: RobustSmoother, tau: float, vanishing: float) -> float:
    """Return the bound V with lambda_3 = lambda_4, not a number where there is no design."""
    try:
        return published.design_near_edge(best, tau, vanishing).bound
    except InfeasibleDesignError:
        return np.nan
