"""The figures of the explorer, of a snapshot with fixed axes, or of a sentence."""

import io
import textwrap
from collections.abc import Callable

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure

import robsmooth as rs
from robsmooth._support.plots import draw_curves
from robsmooth.explorer.snapshot import DESIGNS, LAGS, SHOWN, STEP, Snapshot
from robsmooth.paper.figures import use_style
from robsmooth.paper.figures.plots import DOTTED, draw_candidates

_ERROR = "error (rad$^2$; Kalman filter: 100%)"
_MOST = 2.0  # of the error axes, in units of the Kalman filter's error
# Fixed places: a layout engine takes as long as the drawing.
_PLACES = {"left": 0.1, "right": 0.985, "bottom": 0.095, "top": 0.92, "wspace": 0.42, "hspace": 0.6}


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
    panels = figure.subplots(2, 2, gridspec_kw=_PLACES).flat
    for axes, panel in zip(panels, (_sector, _errors, _lags, _path), strict=True):
        panel(axes, found)
    return figure


def theory(found: Snapshot | str) -> Figure:
    """Draw the error of the chosen design over the slope, with its guarantees, and its poles."""
    figure = Figure(figsize=(7.0, 2.9), dpi=130, layout="none")
    if isinstance(found, str):
        return figure
    sweep, poles = figure.subplots(1, 2, gridspec_kw=_PLACES | {"top": 0.83, "bottom": 0.19})
    estimator = found.own.estimator
    for output in ("filtered", "smoothed"):
        rs.delta_sweep(estimator, np.linspace(-1.0, 0.0, 21), output, loop="real").plot(sweep)
    guarantees = {f"certified, {found.settings.cost}": found.own.judged.certified}
    if isinstance(estimator, rs.RobustSmoother):
        guarantees["the paper's bound 2V"] = estimator.mean_square_bound
    for dashes, (name, value) in zip((":", "-"), guarantees.items(), strict=False):
        sweep.axhline(value, color="k", linestyle=dashes, linewidth=0.9, label=name)
    _head(sweep, "error against uncertainty", xlim=(-1.0, 0.0), ylim=(0.0, None))
    _in_both_units(sweep.yaxis, found)
    poles.plot(1e-6 * estimator.poles.real, 1e-6 * estimator.poles.imag, "kx")
    poles.axvline(0.0, **DOTTED)
    of = "{} part ($10^6$ rad/s)".format
    _head(poles, "poles of the estimator", xlabel=of("real"), ylabel=of("imaginary"))
    return figure


def _head(axes: Axes, title: str, left: float = 0.0, **settings) -> None:
    """Put a title, and below it a legend, above the axes; the settings are of the axes."""
    axes.set(**settings)
    axes.set_title(title, loc="left", x=left, pad=20, fontweight="bold")
    if axes.get_legend_handles_labels()[0]:
        place = {"loc": "lower left", "bbox_to_anchor": (left - 0.03, 0.98), "ncols": 4}
        axes.legend(**place, fontsize=7, columnspacing=0.6, handletextpad=0.3)


def _in_both_units(axis: Axis, found: Snapshot) -> None:
    """Label an axis of errors, and a few ticks in rad^2 and relative to the Kalman filter's."""
    axis.axes.locator_params(axis=axis.axis_name, nbins=5)
    axis.set_label_text(_ERROR)
    axis.set_major_formatter(lambda error, _: f"{error:.2g}\n{error / found.optimum[0]:.0%}")


def _sector(axes: Axes, found: Snapshot) -> None:
    parameters, error = found.settings.parameters, np.linspace(-np.pi, np.pi, 181)
    axes.plot(error, np.sin(error), color="k", linestyle="-", label="sine")
    low, high = parameters.lower_slope * error, parameters.beta * error
    axes.fill_between(error, low, high, color="C3", alpha=0.4, linewidth=0, label="its sector")
    density = np.exp(-(error**2) / (2.0 * found.own.with_sine.filtered))
    axes.fill_between(error, -2.0, 0.9 * density - 2.0, color="0.75", linewidth=0, label="errors")
    reach = parameters.sector_range()
    axes.vlines([-reach, reach], -2.0, [0.0, 2.0], color="0.4", linestyle="--", linewidth=0.8)
    axes.set(xlabel="phase error (rad)", ylabel="detector's signal")
    _head(axes, "the sine and its sector", xlim=(-np.pi, np.pi), ylim=(-2.0, 2.0))


def _errors(axes: Axes, found: Snapshot) -> None:
    chosen, errors = found.settings.design, {}
    for name in dict.fromkeys((*DESIGNS[:4], chosen)):
        row = errors[name + " ◂" * (name == chosen)] = {}
        if each := found.found.get(name):  # else it is being made, or does not exist
            values = (*vars(each.judged).values(), getattr(each.with_sine, found.settings.cost))
            names = ("nominal", "worst constant", "certified", "with the sine")
            row |= zip(names, values, strict=True)
    draw_candidates(axes, errors, (0.0, _MOST * found.optimum[0]))
    _in_both_units(axes.xaxis, found)
    _head(axes, f"{found.settings.cost} errors of all designs", left=-0.4)


def _lags(axes: Axes, found: Snapshot) -> None:
    curves = {"exact optimum": found.optimum, "classical smoother": found.modelled}
    draw_curves(axes, 1e6 * LAGS, curves)
    lag, smoothed = 1e6 * found.settings.lag, found.own.with_sine.smoothed
    axes.plot(lag, smoothed, "ko", label="this design", clip_on=False)
    axes.axvline(lag, **DOTTED)
    limits = {"xlim": (0.0, 1e6 * LAGS[-1]), "ylim": (0.0, 1.6 * found.optimum[0])}
    _head(axes, "what waiting buys", xlabel="lag (µs)", **limits)
    _in_both_units(axes.yaxis, found)


def _path(axes: Axes, found: Snapshot) -> None:
    time = 1e6 * STEP * np.arange(1, SHOWN + 1)
    times = time - 1e6 * found.settings.lag * np.array([[0.0], [0.0], [1.0]])
    draw_curves(axes, times, dict(zip(("true", "filtered", "smoothed"), found.path, strict=True)))
    axes.set(xlabel="time (µs)", ylabel="phase (rad)")
    _head(axes, "a path and its estimates", xlim=(0.0, time[-1]), ylim=(-3.0, 3.0))
