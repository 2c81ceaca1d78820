"""The figures of what the paper leaves open."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from robsmooth.analysis.lag import LagSweep
from robsmooth.analysis.worst_case import WorstDynamicCase
from robsmooth.homodyne.comparison import Compared
from robsmooth.homodyne.study import Study
from robsmooth.paper.figures.axes import LOOSE, label_rows, label_ticks, plot_curves, stacked
from robsmooth.paper.figures.maps import hatch, shade
from robsmooth.paper.figures.style import MARK, TRUTH

_LAGS = (0.3, 1, 3, 10, 30)  # µs, to label


def where_smoothing_pays(study: Study, gamma: float, lag: float) -> Figure:
    """Draw what smoothing saves of the filtered error, over lag and noise, and for each order.

    Both errors of a ratio are of one loop: those of the designs of the loop with its sine, those of
    the optimal estimators of the linear one. `gamma` is one of the study's; `lag` (s) is marked.
    """
    i = study.gammas.index(gamma)
    ratio = study.ratio[i]
    lags, noises = 1e6 * np.array(study.lags), np.array(study.noises)
    middle = int(np.argmin(np.abs(np.log(noises))))
    figure, (top, bottom) = stacked(5.4, (1, 1))

    saved = 100 * (1 - ratio[:, -1])
    shading = shade(top, lags, noises, saved, np.arange(0, 61, 10), missing="no design or lock")
    hatch(top, lags, noises, -saved, "no gain", hatch="-----")
    there = ~np.isnan(saved).all(axis=1)
    best = lags[np.nanargmax(saved[there], axis=1)]
    points = LOOSE | {"markeredgecolor": "k"}
    top.plot(best, noises[there], "o", color="w", label="best lag", **points)
    star = points | {"color": "C1", "markersize": 9, "label": "the paper's"}
    top.plot(1e6 * lag, noises[middle], "*", **star)
    top.set(xscale="log", yscale="log", ylabel="shot noise / the paper's")
    label_ticks(top.yaxis, (0.1, 0.3, 1, 3, 10))
    figure.colorbar(shading, ax=top, label="saved by smoothing (%)", pad=0.02)

    optimal = study.optimal_ratio[i, middle, -1]
    bottom.plot(lags, optimal, label="both optimal, linear loop", **TRUTH)
    plot_curves(bottom, lags, dict(zip(study.orders, ratio[middle], strict=True)))
    bottom.axhline(1.0, color="k", linestyle="-", linewidth=0.6)
    bottom.axvline(1e6 * lag, **MARK)
    bottom.set(xlabel="lag (µs)", ylabel="smoothed / filtered error")
    bottom.set(ylim=(0.4, 1.6), xlim=lags[[0, -1]])
    label_ticks(bottom.xaxis, _LAGS)
    handles = [*top.patches, *top.lines, *bottom.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def side_by_side(compared: Mapping[str, Compared], slopes: Sequence[float], limit: float) -> Figure:
    """Draw the errors of the named estimators in rows, from no uncertainty to the worst.

    The errors `at` are for the slopes. Estimators beyond the limit of the axis, in rad^2, are said
    to be so.
    """
    figure, axes = plt.subplots(figsize=(3.4, 1.1 + 0.36 * len(compared)))
    legend = {}
    for row, case in zip(label_rows(axes, compared), compared.values(), strict=True):
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
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=3)
    return figure


def worst_spectra(found: WorstDynamicCase, slope: tuple[int, int]) -> Figure:
    """Draw the error's spectrum without uncertainty and for the worst, and the worst's phase.

    The phase is that of one slope, in this row and column of Delta.
    """
    shares = found.frequencies * found.spectra / np.pi  # of the error, per logarithm of frequency
    shown = shares[2] > 0.1 * shares[2].max()
    omega = found.frequencies[shown]
    figure, (top, bottom) = stacked(3.8, (5, 4))
    labels = ("no uncertainty", "worst constant", "worst at each frequency")
    for label, share in zip(labels, shares, strict=True):
        top.semilogx(omega, share[shown], label=label)
    top.set(ylabel="share of the error\nper e-fold (rad$^2$)", ylim=(0, None))
    top.locator_params(axis="y", nbins=4)
    phase = np.degrees(np.unwrap(np.angle(found.Delta[shown][:, *slope])))
    bottom.semilogx(omega, phase - 360.0 * np.round(phase[0] / 360.0))
    bottom.set(xlabel=r"angular frequency $\omega$ (rad/s)", xlim=omega[[0, -1]])
    bottom.set(ylabel="phase of the\nworst slope (°)")
    bottom.yaxis.set_major_locator(MultipleLocator(360))
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def lag_and_order(sweeps: Mapping[str, LagSweep], lag: float) -> Figure:
    """Draw smoothed errors against the lag for each order, without uncertainty and at worst.

    The sweeps are those of the named designs, all for the same orders; `lag` (s) is marked.
    """
    shape = {"nrows": len(sweeps), "ncols": 2, "squeeze": False}
    size = (3.4, 1.4 + 1.4 * len(sweeps))
    figure, panels = plt.subplots(**shape, figsize=size, sharex=True, sharey="col")
    for (left, right), (name, sweep) in zip(panels, sweeps.items(), strict=True):
        lags = 1e6 * sweep.lags
        plot_curves(left, lags, dict(zip(sweep.orders, sweep.nominal, strict=True)))
        plot_curves(right, lags, dict(zip(sweep.orders, sweep.worst, strict=True)))
        left.fill_between(lags, 0.0, sweep.optimal, color="0.85", lw=0, label="below the optimum")
        dots = MARK | {"linestyle": (0, (1, 1)), "color": "0.2"}
        left.axhline(sweep.two_sided, label="two-sided optimum", **dots)
        for axes in (left, right):
            axes.axvline(1e6 * lag, label=f"lag {1e6 * lag:.3g} µs", **MARK)
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
        label_ticks(last.xaxis, _LAGS)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure
