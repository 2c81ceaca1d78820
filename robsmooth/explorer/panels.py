"""The figure of the explorer: four panels of a snapshot with fixed axes, or a sentence."""

import io
import textwrap

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import robsmooth as rs
from robsmooth._support.plots import draw_curves
from robsmooth.explorer.snapshot import SHOWN, SLOPES, STEP, Snapshot
from robsmooth.paper.figures import use_style
from robsmooth.paper.figures.plots import label_ticks

_ERROR = "mean square error\n(Kalman filter's = 1)"
# Fixed places: a layout engine takes as long as the drawing.
_PLACES = {"left": 0.09, "right": 0.985, "bottom": 0.09, "top": 0.95, "wspace": 0.24, "hspace": 0.4}


def png(found: Snapshot | str) -> bytes:
    """Return the figure as an image."""
    with mpl.rc_context():
        use_style()
        target = io.BytesIO()
        draw(found).savefig(target, format="png", dpi="figure")
        return target.getvalue()


def draw(found: Snapshot | str) -> Figure:
    """Draw the panels, or the sentence on why there are none."""
    figure = Figure(figsize=(7.0, 4.5), dpi=130, layout="none")
    if isinstance(found, str):
        figure.text(0.5, 0.5, textwrap.fill(found, 90), ha="center", va="center")
        return figure
    panels = figure.subplots(2, 2, gridspec_kw=_PLACES).flat
    for axes, panel in zip(panels, (_sector, _sweep, _errors, _path), strict=True):
        panel(axes, found)
    return figure


def _sector(axes: Axes, found: Snapshot) -> None:
    parameters, error = found.settings.parameters, np.linspace(-np.pi, np.pi, 181)
    axes.plot(error, np.sin(error), color="k", linestyle="-", label="sine")
    low, high = parameters.lower_slope * error, parameters.beta * error
    axes.fill_between(error, low, high, color="C3", alpha=0.4, linewidth=0, label="its sector")
    density = np.exp(-(error**2) / (2.0 * found.own.with_sine.filtered))
    axes.fill_between(error, -2.0, 0.9 * density - 2.0, color="0.75", linewidth=0, label="errors")
    reach = parameters.sector_range()
    axes.vlines([-reach, reach], -2.0, [0.0, 2.0], color="0.4", linestyle="--", linewidth=0.8)
    axes.set(title="the sine and its sector", xlim=(-np.pi, np.pi), ylim=(-2.0, 2.0))
    axes.set(xlabel="phase error (rad)", ylabel="detector's signal")
    axes.legend(loc="upper left")


def _sweep(axes: Axes, found: Snapshot) -> None:
    errors = {"filtered": found.own.filtered, "smoothed": found.own.smoothed}
    errors["classical smoother"] = found.classical.smoothed
    draw_curves(axes, SLOPES, {name: each / found.filtering for name, each in errors.items()})
    star = {"markersize": 6, "clip_on": False, "label": "optimum at this lag"}
    axes.plot(0.0, found.optimum / found.filtering, "k*", **star)
    axes.set(title="error against uncertainty", ylabel=_ERROR, ylim=(0.0, 3.0))
    axes.set(xlabel=r"uncertainty $\Delta_2$ (most: $-1$)", xlim=(-1.0, 0.0), xticks=[-1, -0.5, 0])
    axes.legend(loc="upper right")


def _errors(axes: Axes, found: Snapshot) -> None:
    large = {"marker": "D", "markersize": 6, "markerfacecolor": "none"}
    small = {"color": "k", "marker": "o", "markersize": 3}
    both = {"classical smoother": (found.classical, large), "this design": (found.own, small)}
    for label, (each, look) in both.items():
        errors = [*vars(each.judged).values(), getattr(each.with_sine, found.settings.cost)]
        relative = np.array(errors) / found.filtering  # infinite ones are not drawn
        axes.plot(relative, label=label, **{"color": "C4", "linestyle": ":"} | look)
    if isinstance(found.own.estimator, rs.RobustSmoother):
        bound = found.own.estimator.mean_square_bound / found.filtering
        axes.axhline(bound, color="k", linestyle="-", label="the paper's bound 2V")
    axes.set(title="the errors of a design", ylabel=_ERROR, yscale="log")
    axes.set(xlim=(-0.5, 3.5), ylim=(0.3, 30.0), xlabel="of the error that is kept low")
    axes.set_xticks(range(4), ["nominal", "worst constant", "certified", "with the sine"])
    label_ticks(axes.yaxis, (0.3, 1, 3, 10, 30))
    axes.legend(loc="upper left")


def _path(axes: Axes, found: Snapshot) -> None:
    time = 1e6 * STEP * np.arange(1, SHOWN + 1)
    times = time - 1e6 * found.settings.lag * np.array([[0.0], [0.0], [1.0]])
    draw_curves(axes, times, dict(zip(("true", "filtered", "smoothed"), found.path, strict=True)))
    axes.set(title="a path and its estimates", xlabel="time (µs)", ylabel="phase (rad)")
    axes.set(xlim=(0.0, time[-1]), ylim=(-3.0, 3.0))
    axes.legend(loc="upper left", ncols=2)
