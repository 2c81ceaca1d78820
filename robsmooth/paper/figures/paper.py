"""The figures of the paper, and of what is said of it."""

import textwrap
from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.style import MARK, styles
from robsmooth.estimators.smoother import RobustSmoother, design_smoother
from robsmooth.homodyne.montecarlo import MeanSquare
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper import published
from robsmooth.systems.delay import pade_delay


def sector(parameters: HomodyneParameters, variance: float) -> Figure:
    r"""Draw Fig. 3: the sine of the phase error in its sector, and where the error lives.

    Parameters
    ----------
    parameters : HomodyneParameters
    variance : float
        Stationary variance of the error, rad^2, for the lower panel.
    """
    figure, (top, bottom) = plt.subplots(
        2, 1, sharex=True, figsize=(3.4, 4.2), height_ratios=(3, 1)
    )
    error = np.linspace(-np.pi, np.pi, 721)
    upper, lower = parameters.beta, parameters.lower_slope
    reach = parameters.sector_range()
    wide = parameters.sector_slope
    top.fill_between(
        error,
        lower * error,
        upper * error,
        color="C0",
        alpha=0.2,
        linewidth=0,
        label=rf"design's sector $[{lower:g},\,{upper:g}]$",
    )
    top.plot(error, np.sin(error), color="C1", linestyle="-", label=r"$\sin\mu_1$")
    top.plot(
        error,
        upper * error,
        color="0.4",
        linestyle=":",
        linewidth=0.9,
        label=rf"tangent, $\beta={upper:g}$",
    )
    top.plot(
        error,
        wide * error,
        color="C4",
        linestyle="--",
        linewidth=0.9,
        label=rf"$m=1-2\gamma={wide:.1f}$",
    )
    for end in (-reach, reach):
        for axes in (top, bottom):
            axes.axvline(end, color="C0", linestyle="-.", linewidth=0.8)
    top.annotate(
        f"{reach:.2f} rad",
        (reach, -1.55),
        xytext=(3, 0),
        textcoords="offset points",
        color="C0",
    )
    top.set(ylim=(-1.75, 1.75), ylabel=r"$y = f(\mu_1) + \beta\mu_1$")
    density = np.exp(-(error**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    bottom.fill_between(error, density, color="0.6", linewidth=0)
    bottom.set(
        xlabel=r"phase error $\mu_1 = \phi - \hat\phi$ (rad)",
        ylabel="density\n(1/rad)",
        xlim=(-np.pi, np.pi),
        ylim=(0, None),
    )
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def delta_sweep(
    slopes: Sequence[float],
    curves: Mapping[str, Sequence[float]],
    marks: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    r"""Draw error covariances against :math:`\Delta_2`, as Fig. 4.

    Parameters
    ----------
    slopes : (N,) sequence
        Values of :math:`\Delta_2`.
    curves : mapping
        From each label to its (N,) error covariances, rad^2.
    marks : mapping, optional
        From each label to a single point.
    """
    several = len(curves) > 2  # some of them may lie on one another: then markers take turns
    figure, axes = plt.subplots(figsize=(3.4, 3.1 if several else 2.6))
    for number, (label, look) in enumerate(zip(curves, styles(curves, several), strict=True)):
        turn = (0.2 * number / len(curves), 0.2)
        axes.plot(slopes, curves[label], label=label, markevery=turn, markerfacecolor="w", **look)
    for label, (slope, value) in (marks or {}).items():
        axes.plot(slope, value, "k*", markersize=7, clip_on=False, linestyle="none", label=label)
    axes.set(
        xlabel=r"measurement uncertainty $\Delta_2$",
        ylabel=r"error covariance (rad$^2$)",
        xlim=(min(slopes), max(slopes)),
        ylim=(0, None),
    )
    axes.locator_params(nbins=5)
    if several:
        figure.legend(loc="outside lower center", ncols=2)
    else:
        axes.legend()
    return figure


def delay_error(delay: float, orders: Sequence[int], bandwidth: float) -> Figure:
    """Draw how far Pade models of a delay are off, against frequency.

    Parameters
    ----------
    delay : float
        In seconds.
    orders : sequence of int
        One curve each.
    bandwidth : float
        Of the filter, rad/s, for a mark.
    """
    omega = np.geomspace(bandwidth / 10, bandwidth * 100, 400)
    exact = np.exp(-1j * omega * delay)
    figure, axes = plt.subplots()
    for order, look in zip(orders, styles(orders), strict=True):
        response = pade_delay(delay, order).response(omega)[:, 0, 0]
        axes.loglog(omega, np.abs(response - exact), label=f"order {order}", **look)
    axes.axvline(bandwidth, color="0.4", linestyle=":", linewidth=0.9, label="bandwidth")
    axes.set(
        xlabel=r"angular frequency $\omega$ (rad/s)",
        ylabel=r"$|H(i\omega) - e^{-i\omega\delta}|$",
        xlim=(omega[0], 20 * bandwidth),  # beyond, all are as wrong as can be
        ylim=(1e-12, 4.0),
    )
    axes.legend(loc="lower right")
    return figure


def bound_landscape(best: RobustSmoother) -> Figure:
    r"""Draw the bound of the example against tau, and against the multipliers that vanish.

    Parameters
    ----------
    best : RobustSmoother
        The design next to the infimum.
    """

    def bound(tau: float, small: float) -> float:
        try:
            multipliers = [1.0, 0.5 - small / 2, small, small]
            return design_smoother(best.plant, tau, multipliers, best.cost).bound
        except InfeasibleDesignError:
            return np.nan

    figure, (left, right) = plt.subplots(1, 2, sharey=True, figsize=(3.4, 2.4))
    tau = best.tau * np.linspace(0.6, 2.0, 57)
    left.plot(1e6 * tau, [bound(value, 1e-6) for value in tau])
    left.plot(1e6 * best.tau, best.bound, "o", color="C1", label="least bound")
    printed = published.printed("tau")
    left.axvline(1e6 * printed, color="0.4", linestyle=":", linewidth=0.9, label="printed")
    left.set(xlabel=r"$\tau$ (rad$^2\,$µs)", ylabel="bound $V$ (rad$^2$)")
    small = np.geomspace(1e-6, 2e-3, 60)
    values = np.array([bound(best.tau, value) for value in small])
    right.semilogx(small, values)
    right.axhline(best.bound_infimum, color="k", linestyle="-.", linewidth=0.9, label="infimum")
    if np.isnan(values).any():
        edge = small[np.isfinite(values)].max()
        right.axvline(edge, color="C1", linestyle="--", linewidth=0.9, label="no design beyond")
    right.set(xlabel=r"$\lambda_3 = \lambda_4$", xlim=small[[0, -1]])
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def mean_squares(
    cases: Sequence[str],
    results: Mapping[str, Sequence[MeanSquare]],
    printed: Mapping[str, float],
) -> Figure:
    """Draw simulated mean square errors with their intervals against what is printed.

    Parameters
    ----------
    cases : sequence of str
        Labels of the variants, one a row.
    results : mapping
        From each quantity, e.g. "NGCF, filtered", to its mean square error in every case.
    printed : mapping
        From the same quantities to the printed value, drawn as a line.
    """
    figure, axes = plt.subplots(figsize=(3.4, 0.9 + 0.36 * len(cases)))
    rows = np.arange(len(cases))[::-1]
    looks = styles([label.split(",")[0] for label in results], markers=True)
    for look, (label, values) in zip(looks, results.items(), strict=True):
        means = np.array([value.mean_square for value in values])
        errors = np.array([value.standard_error for value in values])
        points = look | {"linestyle": "none", "markersize": 3}
        axes.errorbar(means, rows, xerr=1.96 * errors, label=label, **points)
        if label in printed:
            axes.axvline(printed[label], color=look["color"], linestyle="--", linewidth=0.9)
            axes.annotate(
                f"printed {printed[label]:g}",
                (printed[label], 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(0, 1),
                textcoords="offset points",
                color=look["color"],
                ha="right" if printed[label] == min(printed.values()) else "left",
                va="bottom",
            )
    axes.set(
        yticks=rows,
        yticklabels=[textwrap.fill(case, 18) for case in cases],
        xlabel=r"mean square error (rad$^2$)",
        ylim=(-0.6, len(cases) - 0.4),
        xlim=(0, 1.3 * max(printed.values())),
    )
    axes.grid(axis="y", visible=False)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def routes(
    rows: Sequence[str],
    routes: Mapping[str, Sequence[MeanSquare]],
    reference: Sequence[float],
) -> Figure:
    """Draw how far several routes to the same errors are from a reference.

    Parameters
    ----------
    rows : sequence of str
        The errors, one a row.
    routes : mapping
        From each route's name to its mean square error in every row; 95% intervals are drawn.
    reference : sequence of float
        What to subtract and divide by, rad^2.
    """
    figure, axes = plt.subplots(figsize=(3.4, 1.0 + 0.34 * len(rows)))
    height = np.arange(len(rows))[::-1]
    axes.axvline(0.0, **MARK)
    looks = styles(routes, markers=True)
    for index, (look, (label, values)) in enumerate(zip(looks, routes.items(), strict=True)):
        value = np.array([value.mean_square for value in values]) / reference
        error = np.array([value.standard_error for value in values]) / reference
        axes.errorbar(
            100 * (value - 1),
            height + 0.2 * (1 - index),
            xerr=196 * error,
            label=label,
            **look | {"linestyle": "none", "markersize": 3},
        )
    axes.set(
        yticks=height,
        yticklabels=[textwrap.fill(row, 20) for row in rows],
        xlabel="difference from the moments (%)",
        ylim=(-0.6, len(rows) - 0.4),
    )
    axes.grid(axis="y", visible=False)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def loss_of_lock(
    factors: Sequence[float],
    errors: Mapping[str, Sequence[float]],
    slip_rates: Sequence[float],
) -> Figure:
    """Draw errors and the rate of cycle slips against the noise.

    Parameters
    ----------
    factors : sequence of float
        On the power of the phase noise.
    errors : mapping
        From each label to the mean square errors, rad^2; not a number where there is none.
    slip_rates : sequence of float
        1/s; zeros are left out.
    """
    figure, (top, bottom) = plt.subplots(
        2, 1, sharex=True, figsize=(3.4, 3.8), height_ratios=(3, 2)
    )
    looks = styles(errors, markers=True)
    for number, (look, label) in enumerate(zip(looks, errors, strict=True)):
        # all but the first lie on one another: each is seen through the next, which is smaller
        size = {"markersize": max(9 - 2 * number, 3) if number else 3, "markerfacecolor": "none"}
        top.loglog(factors, errors[label], label=label, **look | size)
    top.set(ylabel=r"filtered error (rad$^2$)")
    rates = np.array(slip_rates, dtype=float)
    rates[rates == 0.0] = np.nan
    bottom.loglog(factors, rates, "o-", markersize=3)
    bottom.set(xlabel="factor on the power of the phase noise", ylabel="cycle slips (1/s)")
    ticks = [factor for factor in (1, 2, 5, 10, 20, 50) if factor <= max(factors)]
    bottom.set_xticks(ticks, [f"{tick}" for tick in ticks])
    bottom.minorticks_off()
    figure.legend(loc="outside lower center", ncols=2)
    return figure
