"""The figures of the explorer, of a snapshot with fixed axes, or of a sentence."""

import io
import textwrap
from collections.abc import Callable

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import robsmooth as rs
from robsmooth._support.plots import draw_curves
from robsmooth.explorer.snapshot import DESIGNS, LAGS, SHOWN, STEP, Snapshot
from robsmooth.paper.figures import use_style
from robsmooth.paper.figures.plots import DOTTED, draw_candidates

_ERROR = r"mean square error (rad$^2$)"
_RELATIVE = "relative to the Kalman filter's"
_MOST = 2.0  # of the error axes, in units of the Kalman filter's error
# Fixed places: a layout engine takes as long as the drawing.
_PLACES = {"left": 0.085, "right": 0.925, "bottom": 0.08, "top": 0.88, "wspace": 0.5}


def png(found: Snapshot | str, draw: Callable[[Snapshot | str], Figure]) -> bytes:
    """Return a figure as an image."""
    with mpl.rc_context():
        use_style()
        target = io.BytesIO()
        draw(found).savefig(target, format="png", dpi="figure")
        return target.getvalue()


def overview(found: Snapshot | str) -> Figure:
    """Draw the sine, the errors of all designs, the error over the lag, and a path."""
    figure = Figure(figsize=(7.0, 5.4), dpi=130, layout="none")
    if isinstance(found, str):
        figure.text(0.5, 0.5, textwrap.fill(found, 90), ha="center", va="center")
        return figure
    panels = figure.subplots(2, 2, gridspec_kw={**_PLACES, "hspace": 0.68}).flat
    for axes, panel in zip(panels, (_sector, _errors, _lags, _path), strict=True):
        panel(axes, found)
    return figure


def theory(found: Snapshot | str) -> Figure:
    """Draw the error of the chosen design over the slope, with its guarantees, and its poles."""
    figure = Figure(figsize=(7.0, 2.9), dpi=130, layout="none")
    if isinstance(found, str):
        return figure
    sweep, poles = figure.subplots(1, 2, gridspec_kw={**_PLACES, "top": 0.8, "bottom": 0.17})
    estimator, slopes = found.own.estimator, np.linspace(-1.0, 0.0, 21)
    curves = {
        output: rs.delta_sweep(estimator, slopes, output, loop="real").mean_square
        for output in ("filtered", "smoothed")
    }
    draw_curves(sweep, slopes, curves)
    guarantees = {f"certified, {found.settings.cost}": found.own.judged.certified}
    if isinstance(estimator, rs.RobustSmoother):
        guarantees["the paper's bound 2V"] = estimator.mean_square_bound
    for dashes, (name, value) in zip((":", "-"), guarantees.items(), strict=False):
        sweep.axhline(value, color="k", linestyle=dashes, linewidth=0.9, label=name)
    sweep.set(xlabel=r"uncertainty $\Delta_2$", ylabel=_ERROR, xlim=(-1.0, 0.0))
    sweep.set(ylim=(0.0, _MOST * found.filtering))
    _head(sweep, "error against uncertainty")
    poles.plot(1e-6 * estimator.poles.real, 1e-6 * estimator.poles.imag, "kx")
    poles.axvline(0.0, **DOTTED)
    poles.set(xlabel=r"real part ($10^6$ rad/s)", ylabel=r"imaginary part ($10^6$ rad/s)")
    _head(poles, "poles of the estimator")
    return figure


def _head(axes: Axes, title: str, **legend) -> None:
    """Put a title, and below it a legend, above the axes."""
    axes.set_title(title, loc="left", pad=20, fontweight="bold")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower left", bbox_to_anchor=(-0.03, 0.98), ncols=4, fontsize=7, **legend)


def _sector(axes: Axes, found: Snapshot) -> None:
    parameters, error = found.settings.parameters, np.linspace(-np.pi, np.pi, 181)
    axes.plot(error, np.sin(error), color="k", linestyle="-", label="sine")
    low, high = parameters.lower_slope * error, parameters.beta * error
    axes.fill_between(error, low, high, color="C3", alpha=0.4, linewidth=0, label="its sector")
    density = np.exp(-(error**2) / (2.0 * found.own.with_sine.filtered))
    axes.fill_between(error, -2.0, 0.9 * density - 2.0, color="0.75", linewidth=0, label="errors")
    reach = parameters.sector_range()
    axes.vlines([-reach, reach], -2.0, [0.0, 2.0], color="0.4", linestyle="--", linewidth=0.8)
    axes.set(xlim=(-np.pi, np.pi), ylim=(-2.0, 2.0))
    axes.set(xlabel="phase error (rad)", ylabel="detector's signal")
    _head(axes, "the sine and its sector")


def _errors(axes: Axes, found: Snapshot) -> None:
    cost, chosen, errors = found.settings.cost, found.settings.design, {}
    for name in dict.fromkeys((*DESIGNS[:4], chosen)):
        row = errors[name + " ◂" * (name == chosen)] = {}
        if each := found.found.get(name):  # else it is being made
            row |= {"nominal": each.judged.nominal, "worst constant": each.judged.worst_constant}
            row |= {"certified": each.judged.certified}
            row["with the sine"] = getattr(each.with_sine, cost)
    legend = draw_candidates(axes, errors, (0.0, _MOST * found.filtering))
    axes.secondary_xaxis("top", functions=_relative(found))
    axes.locator_params(axis="x", nbins=5)
    axes.set(xlabel=f"{cost} {_ERROR}")
    axes.set_title("errors of all designs", loc="left", x=-0.4, pad=34, fontweight="bold")
    place = {"loc": "lower left", "bbox_to_anchor": (-0.44, 1.09), "ncols": 4, "fontsize": 7}
    spaces = {"columnspacing": 0.5, "handletextpad": 0.0}
    axes.legend(legend.values(), legend.keys(), **place, **spaces)


def _lags(axes: Axes, found: Snapshot) -> None:
    curves = {"exact optimum": found.optimum, "classical smoother": found.modelled}
    draw_curves(axes, 1e6 * LAGS, curves)
    lag, smoothed = 1e6 * found.settings.lag, found.own.with_sine.smoothed
    axes.plot(lag, smoothed, "ko", label="this design", clip_on=False)
    axes.axvline(lag, **DOTTED)
    axes.secondary_yaxis("right", functions=_relative(found)).set_ylabel(_RELATIVE)
    axes.set(xlabel="lag (µs)", ylabel=_ERROR)
    axes.set(xlim=(0.0, 1e6 * LAGS[-1]), ylim=(0.0, 1.6 * found.filtering))
    _head(axes, "what waiting buys", columnspacing=0.6, handletextpad=0.3)


def _relative(found: Snapshot) -> tuple[Callable, Callable]:
    unit = found.filtering
    return (lambda error: error / unit), (lambda ratio: ratio * unit)


def _path(axes: Axes, found: Snapshot) -> None:
    time = 1e6 * STEP * np.arange(1, SHOWN + 1)
    times = time - 1e6 * found.settings.lag * np.array([[0.0], [0.0], [1.0]])
    draw_curves(axes, times, dict(zip(("true", "filtered", "smoothed"), found.path, strict=True)))
    axes.set(xlabel="time (µs)", ylabel="phase (rad)")
    axes.set(xlim=(0.0, time[-1]), ylim=(-3.0, 3.0))
    _head(axes, "a path and its estimates")
