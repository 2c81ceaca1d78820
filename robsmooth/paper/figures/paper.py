"""The figures of the paper, and of what is said of it."""

import itertools
from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from robsmooth.homodyne.montecarlo import MeanSquare
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.paper.figures import style
from robsmooth.paper.predictions import ErrorsByMethod, NoisySimulation
from robsmooth.systems.delay import pade_delay


def sector(parameters: HomodyneParameters, variance: float) -> Figure:
    """Draw Fig. 3: the sine in its sector, and the Gaussian density of an error with a variance."""
    figure, (top, bottom) = style.stacked(4.2, (3, 1))
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
    slopes: Sequence[float],
    curves: Mapping[str, Sequence[float]],
    marks: Mapping[str, tuple[float, float]] | None = None,
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
    axes.set(xscale="log", yscale="log")
    style.plot_curves(axes, omega, {order: np.abs(of - exact) for order, of in models.items()})
    axes.axvline(bandwidth, label="bandwidth", **style.DOTTED)
    axes.set(xlabel=r"angular frequency $\omega$ (rad/s)", ylim=(1e-12, 4.0))
    axes.set(ylabel=r"$|H(i\omega) - e^{-i\omega\delta}|$")
    axes.set(xlim=(omega[0], 20 * bandwidth))  # beyond, all are as wrong as can be
    axes.legend(loc="lower right")
    return figure


def mean_squares(
    cases: Sequence[str], results: Mapping[str, list[MeanSquare]], printed: Mapping[str, float]
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


def loss_of_lock(sweep: Sequence[NoisySimulation]) -> Figure:
    """Draw the filtered errors and the rate of cycle slips against the phase noise."""
    figure, (top, bottom) = style.stacked(3.8, (3, 2))
    factors = [case.factor for case in sweep]
    errors = {
        "all runs": [case.simulated.filtered.mean_square for case in sweep],
        "runs in lock": [case.simulated.filtered_in_lock.mean_square for case in sweep],
        "moments": [case.moments for case in sweep],
        "statistical linearisation": [case.linearised for case in sweep],
    }
    looks = style.styles(errors, markers=True)
    for number, (look, label) in enumerate(zip(looks, errors, strict=True)):
        # all but the first lie on one another: each is seen through the next, which is smaller
        size = {"markersize": max(9 - 2 * number, 3) if number else 3, "markerfacecolor": "none"}
        top.loglog(factors, errors[label], label=label, **look | size)
    top.set(ylabel=r"filtered error (rad$^2$)")
    rates = [case.simulated.slip_rate or np.nan for case in sweep]  # zero has no logarithm
    bottom.loglog(factors, rates, "o-", markersize=3)
    bottom.set(xlabel="factor on the power of the phase noise", ylabel="cycle slips (1/s)")
    style.label_ticks(bottom.xaxis, (1, 2, 5, 10, 20, 50))
    return style.with_legend(figure)
