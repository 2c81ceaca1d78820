"""The figures of the explorer, of a snapshot, with fixed axes."""

import io
import math
from dataclasses import replace

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import robsmooth as rs
from robsmooth._support.plots import STYLE, draw_curves
from robsmooth.explorer import snapshot
from robsmooth.explorer.snapshot import DELAYS, DESIGNS, SHOWN, STEP, Snapshot
from robsmooth.paper.figures.plots import DOTTED, draw_candidates

_ERROR = "error (rad$^2$; Kalman filter: 100%)"
_MOST = 2.0  # of the error axes, in units of the Kalman filter's error
# Fixed places: a layout engine takes as long as the drawing.
_PLACE = {"left": 0.17, "right": 0.96, "bottom": 0.19, "top": 0.83}
_IN_STYLE = mpl.rc_params_from_file(STYLE, use_default_template=False)


class Panel:
    """One of `PANELS`, which keeps its ticks and words: they take most of the time to draw."""

    def __init__(self, title: str):
        self._title, self._frame = title, None
        with mpl.rc_context(_IN_STYLE):
            self.figure = Figure(figsize=(4.0, 3.0), dpi=140, layout="none")
            self._axes = self.figure.subplots(gridspec_kw=_PLACE)
            self._canvas = FigureCanvasAgg(self.figure)

    def pixels(self, found: Snapshot) -> np.ndarray:
        """Return what there is to see, (height, width, 4)."""
        axes, canvas = self._axes, self._canvas
        for artist in (*axes.collections, *axes.lines, *axes.texts):
            artist.remove()
        with mpl.rc_context(_IN_STYLE):
            settings = PANELS[self._title](axes, found)
            moving = sorted((*axes.collections, *axes.lines, *axes.texts), key=lambda a: a.zorder)
            frame = settings, axes.get_legend_handles_labels()[1]
            if frame != self._frame:
                _head(axes, self._title, found.kalman, **settings)
                for artist in moving:
                    artist.set_animated(True)
                canvas.draw()
                self._frame, self._still = frame, canvas.copy_from_bbox(self.figure.bbox)
            canvas.restore_region(self._still)
            for artist in moving:
                axes.draw_artist(artist)
        return np.array(canvas.buffer_rgba())


def png(pixels: np.ndarray) -> bytes:
    """Return pixels as an image."""
    target = io.BytesIO()
    mpl.image.imsave(target, pixels, format="png", pil_kwargs={"compress_level": 1})
    return target.getvalue()


def _head(axes: Axes, title: str, kalman: float, errors: str = "", **settings) -> None:
    """Put a title, and below it a legend, above the axes; label an axis of errors, x or y."""
    axes.set(**settings)
    axes.set_title(title, loc="left", x=-0.2, pad=24, fontweight="bold")
    if axes.get_legend_handles_labels()[0]:
        place = {"loc": "lower left", "bbox_to_anchor": (-0.23, 1.01), "ncols": 4}
        look = {"columnspacing": 0.5, "handletextpad": 0.3, "handlelength": 1.5}
        axes.legend(fontsize=7, **place, **look)
    if errors:  # a few ticks, in rad^2 and relative to the Kalman filter's
        axis = {"x": axes.xaxis, "y": axes.yaxis}[errors]
        axes.locator_params(axis=errors, nbins=5)
        axis.set_major_formatter(
            lambda error, _: f"{error:.2g}\n{error / kalman:.0%}" if error else "0"
        )


# Each draws its curves, and returns the settings of the axes, which seldom change.


def _sector(axes: Axes, found: Snapshot) -> dict:
    parameters, error = found.settings.parameters, np.linspace(-np.pi, np.pi, 181)
    axes.plot(error, np.sin(error), color="k", linestyle="-", label="sine")
    low, high = parameters.lower_slope * error, parameters.beta * error
    axes.fill_between(error, low, high, color="C3", alpha=0.4, linewidth=0, label="its sector")
    density = np.exp(-(error**2) / (2.0 * found.own.with_sine.filtered))
    axes.fill_between(error, -2.0, 0.9 * density - 2.0, color="0.75", linewidth=0, label="errors")
    for side in (-1.0, 1.0):
        axes.axvline(side * parameters.sector_range(), color="0.4", linestyle="--", linewidth=0.8)
    words = {"xlabel": "phase error (rad)", "ylabel": "detector's signal"}
    return words | {"xlim": (-np.pi, np.pi), "ylim": (-2.0, 2.0)}


def _errors(axes: Axes, found: Snapshot) -> dict:
    chosen, errors = found.settings.design, {}
    for name in dict.fromkeys((*DESIGNS[:4], chosen)):
        row = errors[name + " ◂" * (name == chosen)] = {}
        if each := found.found.get(name):  # else it is being made, or does not exist
            values = (*vars(each.judged).values(), getattr(each.with_sine, found.settings.cost))
            names = ("nominal", "worst constant", "certified worst", "with the sine")
            row |= zip(names, values, strict=True)
    limits = (0.0, _MOST * found.kalman)
    draw_candidates(axes, errors, limits)
    label = f"{found.settings.cost} {_ERROR}"
    return {"errors": "x", "xlabel": label, "xlim": limits, "label": tuple(errors)}


def _delays(axes: Axes, found: Snapshot) -> dict:
    names = ("exact optimum", "classical smoother")
    certain = replace(found.settings.parameters, gamma=0.5)  # any: it does not matter here
    curves = snapshot.over_delays(certain, found.settings.order)
    draw_curves(axes, 1e6 * DELAYS, dict(zip(names, curves, strict=True)))
    delay, smoothed = 1e6 * found.settings.delay, found.own.with_sine.smoothed
    axes.plot(delay, smoothed, "ko", label="this design", clip_on=False)
    axes.axvline(delay, **DOTTED)
    limits = {"xlim": (0.0, 1e6 * DELAYS[-1]), "ylim": (0.0, 1.6 * found.kalman)}
    return {"errors": "y", "ylabel": _ERROR, "xlabel": "delay (µs)", **limits}


def _path(axes: Axes, found: Snapshot) -> dict:
    time, path = 1e6 * STEP * np.arange(1, SHOWN + 1), snapshot.sample_path(found.own.estimator)
    times = time - 1e6 * found.settings.delay * np.array([[0.0], [0.0], [1.0]])
    draw_curves(axes, times, dict(zip(("true", "filtered", "smoothed"), path, strict=True)))
    most = max(3, math.ceil(np.abs(path).max()))
    words = {"xlabel": "time (µs)", "ylabel": "phase (rad)"}
    return words | {"xlim": (0.0, time[-1]), "ylim": (-most, most)}


def _sweep(axes: Axes, found: Snapshot) -> dict:
    estimator = found.own.estimator
    for output in ("filtered", "smoothed"):
        rs.delta_sweep(estimator, np.linspace(-1.0, 0.0, 21), output, loop="real").plot(axes)
    guarantees = {"certified worst": found.own.judged.certified}
    if isinstance(estimator, rs.RobustSmoother):
        guarantees["paper's 2V"] = estimator.mean_square_bound
    for dashes, (name, value) in zip((":", "-"), guarantees.items(), strict=False):
        if math.isfinite(value):  # else it is being computed, or there is none
            axes.axhline(value, color="k", linestyle=dashes, linewidth=0.9, label=name)
    most = 1.1 * max(line.get_ydata()[0] for line in axes.lines)
    return {"errors": "y", "ylabel": _ERROR, "xlim": (-1.0, 0.0), "ylim": (0.0, most)}


def _poles(axes: Axes, found: Snapshot) -> dict:
    poles = 1e-6 * found.own.estimator.poles
    axes.plot(poles.real, poles.imag, "kx")
    axes.axvline(0.0, **DOTTED)
    most, of = 1.1 * np.abs(poles).max(), "{} part ($10^6$ rad/s)".format
    limits = {"xlim": (-most, 0.1 * most), "ylim": (-most, most)}
    return {"xlabel": of("real"), "ylabel": of("imaginary"), **limits}


JUDGED = "errors of all designs"  # the one that changes once they are judged
OVERVIEW = {
    "the sine and its sector": _sector,
    JUDGED: _errors,
    "what waiting buys": _delays,
    "a path and its estimates": _path,
}
THEORY = {"error against uncertainty": _sweep, "poles of the estimator": _poles}
PANELS = {**OVERVIEW, **THEORY}
