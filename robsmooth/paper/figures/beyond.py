"""The figures of what the paper leaves open."""

import textwrap
from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.style import MARK, TRUTH, styles
from robsmooth.analysis.lag import LagSweep
from robsmooth.analysis.worst_case import WorstDynamicCase
from robsmooth.estimators.smoother import RobustSmoother, design_smoother
from robsmooth.homodyne.certificate import scalar_bound
from robsmooth.homodyne.comparison import Compared
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.homodyne.study import Study
from robsmooth.paper.figures.maps import hatch, shade

_INFIMUM = {
    "marker": "o",
    "color": "C1",
    "markeredgecolor": "w",
    "markersize": 7,
    "linestyle": "none",
    "clip_on": False,
}


def where_smoothing_pays(study: Study, gamma: float, lag: float) -> Figure:
    """Draw what smoothing saves of the filtered error, over lag and noise, and for each order.

    Both errors of a ratio are of one loop: those of the designs of the loop with its sine, those of
    the optimal estimators of the linear one.

    Parameters
    ----------
    study : Study
    gamma : float
        Of the sector, one of the study's.
    lag : float
        To mark, s.
    """
    i = study.gammas.index(gamma)
    ratio = study.ratio[i]
    lags = 1e6 * np.array(study.lags)
    middle = int(np.argmin(np.abs(np.log(study.noises))))
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(3.4, 5.4), sharex=True)

    noises, saved = np.array(study.noises), 100 * (1 - ratio[:, -1])
    shading = shade(top, lags, noises, saved, np.arange(0, 61, 10), missing="no design or lock")
    hatch(top, lags, noises, -saved, "no gain", hatch="-----")
    there = ~np.isnan(saved).all(axis=1)
    best = lags[np.nanargmax(saved[there], axis=1)]
    points = {"linestyle": "none", "markeredgecolor": "k", "clip_on": False}
    top.plot(best, noises[there], "o", color="w", label="best lag", **points)
    star = {"markersize": 9, "label": "the paper's"} | points
    top.plot(1e6 * lag, noises[middle], "*", color="C1", **star)
    top.set(xscale="log", yscale="log", ylabel="shot noise / the paper's")
    ticks = [tick for tick in (0.1, 0.3, 1, 3, 10) if noises[0] <= tick <= noises[-1]]
    top.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    top.minorticks_off()
    figure.colorbar(shading, ax=top, label="saved by smoothing (%)", pad=0.02)

    best_ratio = study.optimal_ratio[i, middle, -1]
    bottom.plot(lags, best_ratio, label="both optimal, linear loop", **TRUTH)
    for order, look, values in zip(study.orders, styles(study.orders), ratio[middle], strict=True):
        bottom.plot(lags, values, label=f"order {order}", **look)
    bottom.axhline(1.0, color="k", linestyle="-", linewidth=0.6)
    bottom.axvline(1e6 * lag, **MARK)
    bottom.set(
        xlabel="lag (µs)", ylabel="smoothed / filtered error", ylim=(0.4, 1.6), xlim=lags[[0, -1]]
    )
    ticks = [tick for tick in (0.3, 1, 3, 10, 30) if lags[0] <= tick <= lags[-1]]
    bottom.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    bottom.minorticks_off()
    figure.legend(
        handles=[*top.patches, *top.lines, *bottom.get_legend_handles_labels()[0]],
        loc="outside lower center",
        ncols=2,
    )
    return figure


def side_by_side(compared: Mapping[str, Compared], slopes: Sequence[float], limit: float) -> Figure:
    r"""Draw the errors of the estimators in rows, from no uncertainty to the worst.

    Parameters
    ----------
    compared : mapping
        From the name of each estimator to its errors.
    slopes : sequence of float
        What the errors ``at`` are for.
    limit : float
        Of the axis, rad^2; estimators beyond it are said to be so.
    """
    figure, axes = plt.subplots(figsize=(3.4, 1.1 + 0.36 * len(compared)))
    rows = range(len(compared) - 1, -1, -1)
    legend = {}
    for row, case in zip(rows, compared.values(), strict=True):
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
    axes.set(
        yticks=list(rows),
        yticklabels=[textwrap.fill(name, 20) for name in compared],
        xlabel=r"mean square error (rad$^2$)",
        xlim=(0.03, limit),
        ylim=(-0.6, len(compared) - 0.4),
    )
    axes.grid(axis="y", visible=False)
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=3)
    return figure


def worst_spectra(found: WorstDynamicCase, slope: tuple[int, int]) -> Figure:
    """Draw the error's spectrum without uncertainty and for the worst, and the worst's phase.

    Parameters
    ----------
    found : WorstDynamicCase
    slope : (int, int)
        Row and column in Delta of the slope whose phase is drawn.
    """
    omega = found.frequencies
    shares = omega * found.spectra / np.pi  # of the mean square error, per logarithm of frequency
    shown = shares[2] > 0.1 * shares[2].max()
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(3.4, 3.8), sharex=True, height_ratios=(5, 4)
    )
    labels = ("no uncertainty", "worst constant", "worst at each frequency")
    for label, share in zip(labels, shares, strict=True):
        top.semilogx(omega[shown], share[shown], label=label)
    top.set(ylabel="share of the error\nper e-fold (rad$^2$)", ylim=(0, None))
    top.locator_params(axis="y", nbins=4)
    phase = np.degrees(np.unwrap(np.angle(found.Delta[shown][:, *slope])))
    bottom.semilogx(omega[shown], phase - 360.0 * np.round(phase[0] / 360.0))
    bottom.set(
        xlabel=r"angular frequency $\omega$ (rad/s)",
        ylabel="phase of the\nworst slope (°)",
        xlim=omega[shown][[0, -1]],
    )
    bottom.yaxis.set_major_locator(MultipleLocator(360))
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def lag_and_order(sweeps: Mapping[str, LagSweep], lag: float) -> Figure:
    """Draw smoothed errors against the lag for each order, without uncertainty and at worst.

    Parameters
    ----------
    sweeps : mapping
        From the name of each design to its errors, all for the same orders.
    lag : float
        To mark, s.
    """
    figure, panels = plt.subplots(
        len(sweeps), 2, figsize=(3.4, 1.4 + 1.4 * len(sweeps)), sharex=True, sharey="col"
    )
    for (left, right), (name, sweep) in zip(np.atleast_2d(panels), sweeps.items(), strict=True):
        lags = 1e6 * sweep.lags
        for order, look, nominal, worst in zip(
            sweep.orders, styles(sweep.orders), sweep.nominal, sweep.worst, strict=True
        ):
            left.plot(lags, nominal, label=f"order {order}", **look)
            right.plot(lags, worst, **look)
        left.fill_between(lags, 0.0, sweep.optimal, color="0.85", lw=0, label="below the optimum")
        dots = MARK | {"linestyle": (0, (1, 1)), "color": "0.2"}
        left.axhline(sweep.two_sided, label="two-sided optimum", **dots)
        for axes in (left, right):
            axes.axvline(1e6 * lag, label=f"lag {1e6 * lag:.3g} µs", **MARK)
            axes.set(xscale="log")
        left.set(ylabel=name)
    figure.supylabel(r"mean square error (rad$^2$)")
    first = np.atleast_2d(panels)[0]
    low, high = sweep.two_sided, sweep.filtering
    first[0].set(title="no uncertainty", ylim=(0.9 * low, 1.25 * high))
    first[1].set(title="worst constant", ylim=(1.4 * low, 2.2 * high))
    for axes in first:
        axes.locator_params(axis="y", nbins=4)
    every = 1e6 * np.concatenate([sweep.lags for sweep in sweeps.values()])
    ticks = [tick for tick in (0.3, 1, 3, 10, 30) if every.min() <= tick <= every.max()]
    for axes in np.atleast_2d(panels)[-1]:
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set(xlabel="lag (µs)", xlim=(every.min(), every.max()))
    handles, labels = first[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def two_landscapes(designs: Mapping[str, RobustSmoother], points: int = 25) -> Figure:
    r"""Draw the example's bound over tau and the multipliers that vanish, for each cost.

    Parameters
    ----------
    designs : mapping
        From a title to the design with the least bound.
    points : int
        Along each axis.
    """
    figure, panels = plt.subplots(1, len(designs), figsize=(3.4, 2.6), sharey=True)
    fractions = np.geomspace(1e-6, 1e-2, points)
    best_taus = [best.limit.tau for best in designs.values()]
    taus = np.geomspace(0.4 * min(best_taus), 5.0 * max(best_taus), points)
    for axes, (title, best) in zip(panels, designs.items(), strict=True):

        def excess(tau: float, fraction: float, best: RobustSmoother = best) -> float:
            multipliers = [1.0, 0.5 - fraction / 2, fraction, fraction]
            try:
                found = design_smoother(best.plant, tau, multipliers, best.cost)
            except InfeasibleDesignError:
                return np.nan
            return 100.0 * (found.bound / best.limit.bound - 1.0)

        values = np.array([[excess(tau, fraction) for fraction in fractions] for tau in taus])
        levels = [0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0]
        shading = shade(axes, fractions, 1e6 * taus, values, levels, missing="no design")
        axes.plot(fractions[0], 1e6 * best.limit.tau, label="infimum (at 0)", **_INFIMUM)
        axes.set(xscale="log", yscale="log", title=title, xlabel=r"$\lambda_3 = \lambda_4$")
        axes.set_yticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
        axes.minorticks_off()
    panels[0].set(ylabel=r"$\tau$ (rad$^2\,$µs)")
    figure.colorbar(shading, ax=panels, label="bound above its infimum (%)", pad=0.02, format="%g")
    drawn = [artist for axes in panels for artist in (*axes.lines, *axes.patches)]
    handles = {artist.get_label(): artist for artist in drawn}.values()
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def all_designs(
    parameters: HomodyneParameters, limit: RobustSmoother, printed: tuple[float, float]
) -> Figure:
    r"""Draw the bound of the example with the filtered cost over p and tau, all else at its best.

    Parameters
    ----------
    parameters : HomodyneParameters
    limit : RobustSmoother
        Where the infimum is.
    printed : (float, float)
        p and tau of the printed design, to mark.
    """
    p = np.linspace(0.2, 0.55, 281)
    tau = 1e-6 * np.geomspace(0.4, 10.0, 200)
    values = scalar_bound(parameters, p[None, :], tau[:, None])
    figure, axes = plt.subplots(figsize=(3.4, 2.8))
    levels = [0.12, 0.125, 0.13, 0.14, 0.16, 0.2, 0.3, 0.5]
    values[np.isinf(values)] = np.nan
    shading = shade(axes, p, 1e6 * tau, values, levels, missing="no design")
    axes.plot(limit.multipliers[1:3].sum(), 1e6 * limit.tau, label="infimum", **_INFIMUM)
    cross = {"markersize": 6, "markeredgecolor": "k", "linestyle": "none"}
    axes.plot(printed[0], 1e6 * printed[1], "X", color="w", label="printed", **cross)
    axes.set(
        xlabel=r"$p = \lambda_2 + \lambda_3$",
        ylabel=r"$\tau$ (rad$^2\,$µs)",
        yscale="log",
    )
    axes.locator_params(axis="x", nbins=5)
    axes.set_yticks([0.5, 1, 2, 5, 10], ["0.5", "1", "2", "5", "10"])
    axes.minorticks_off()
    figure.colorbar(shading, ax=axes, label="bound $V$ (rad$^2$)", pad=0.02, format="%g")
    figure.legend(handles=[*axes.lines, *axes.patches], loc="outside lower center", ncols=3)
    return figure
