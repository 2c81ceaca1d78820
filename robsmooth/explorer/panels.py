"""The four panels of the explorer: one figure, of which what the settings change is drawn again.

Axes, labels and legends are kept as pixels. The axes never change: errors are relative.
"""

import io
import math
import textwrap
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist, setp
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from PIL import Image

import robsmooth as rs
from robsmooth.explorer import snapshot as model
from robsmooth.explorer.snapshot import SHOWN, SLOPES, STEP, Settings, Snapshot
from robsmooth.paper.figures import TRUTH, styles, use_style

NO_DESIGN = "No design."
_SIZE, _RESOLUTION = (7.0, 4.5), 130  # inches, and pixels of an inch on the screen
_WIDTH = 26  # letters of a sentence in a panel
_ERROR = "mean square error\n(Kalman filter's = 1)"

# What changes in a panel, from the bottom up, and how what it shows and the snapshot change it.
Changing = tuple[list[Artist], Callable[[Any, Snapshot], None]]


class Panels:
    """The figure, of the width of a page, its panels, and the background."""

    def __init__(self):
        with mpl.rc_context():
            use_style()
            self.figure = Figure(figsize=_SIZE, dpi=_RESOLUTION)
            canvas = FigureCanvasAgg(self.figure)
            axes = self.figure.subplots(2, 2).flat
            panels = map(_Panel, axes, _PANELS.values())
            self._panels = dict(zip(_PANELS, panels, strict=True))
            canvas.draw()
            self.figure.set_layout_engine("none")  # it has done its work: nothing moves any more
        self._background = canvas.copy_from_bbox(self.figure.bbox)

    def update(self, snapshot: Snapshot) -> None:
        """Set the data of all panels; a sentence takes the place of those that there are not."""
        shown, said = vars(snapshot), set()
        for name, panel in self._panels.items():
            sentence = shown[name] if isinstance(shown[name], str) else ""
            if not sentence:
                panel.update(shown[name], snapshot)
            again = sentence == snapshot.estimator and sentence in said
            panel.set_message(NO_DESIGN if again else sentence)
            said.add(sentence)

    def png(self) -> bytes:
        """Return the figure as it is now."""
        canvas = self.figure.canvas
        canvas.restore_region(self._background)
        for panel in self._panels.values():
            panel.draw()
        target = io.BytesIO()
        pixels = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        pixels.save(target, "png", compress_level=1)  # half of a drawing's time is spent here
        return target.getvalue()


class _Panel:
    """Axes with what changes in them, or with a sentence in its place."""

    def __init__(self, axes: Axes, make: Callable[[Axes], Changing]):
        self.axes, (self.artists, self.update) = axes, make(axes)
        cover = Rectangle((0.01, 0.01), 0.99, 1.0, transform=axes.transAxes, facecolor="w")
        self.message = axes.text(0.5, 0.5, "", transform=axes.transAxes, ha="center", va="center")
        self.instead = (axes.add_patch(cover), self.message)
        setp((*self.artists, *self.instead), animated=True, in_layout=False)

    def set_message(self, sentence: str) -> None:
        self.message.set_text(textwrap.fill(sentence, _WIDTH))
        setp(self.artists, visible=not sentence)
        setp(self.instead, visible=bool(sentence))

    def draw(self) -> None:
        for artist in (*self.artists, *self.instead):
            self.axes.draw_artist(artist)


def _colour(number: int) -> str:
    """Return a colour of the style; "C0" and so on would be looked up again at each drawing."""
    return mpl.rcParams["axes.prop_cycle"].by_key()["color"][number]


def _line(axes: Axes, *form: str, **style) -> Line2D:
    return axes.plot([], [], *form, **style)[0]


def _curves(axes: Axes, *names: str) -> list[Line2D]:
    pairs = zip(names, styles(names), strict=True)
    return [_line(axes, label=name, **style) for name, style in pairs]


def _legend(axes: Axes, place: str, **options) -> None:
    """Draw a legend, within the axes: they are narrow."""
    options = {"handlelength": 1.8, "columnspacing": 0.8, "borderaxespad": 0.2} | options
    axes.legend(loc=place, **options).set_in_layout(False)


def _sector(axes: Axes) -> Changing:
    error = np.linspace(-np.pi, np.pi, 181)
    axes.plot(error, np.sin(error), color="k", linestyle="-", label="sine")
    style = {"color": _colour(3), "alpha": 0.4, "linewidth": 0, "label": "its sector"}
    (sector,) = axes.fill(*np.zeros((2, 4)), **style)
    (density,) = axes.fill(*np.zeros((2, 3)), color="0.75", linewidth=0, label="errors")
    style = {"color": "0.4", "linestyle": "--", "linewidth": 0.8}
    ends = [axes.axvline(0.0, ymax=ymax, **style) for ymax in (0.5, 1.0)]  # one is below the legend
    _legend(axes, "upper left")
    axes.set(title="the sine and its sector", xlim=(-np.pi, np.pi), ylim=(-2.0, 2.0))
    axes.set(xlabel="phase error (rad)", ylabel="detector's signal")

    def update(settings: Settings, snapshot: Snapshot) -> None:
        parameters = settings.parameters
        low, high = parameters.lower_slope, parameters.beta
        edge = error[[0, -1, -1, 0]]
        sector.set_xy(np.column_stack([edge, edge * [low, low, high, high]]))
        reach = parameters.sector_range()
        for end, place in zip(ends, (-reach, reach), strict=True):
            end.set_xdata([place, place])
        predicted = snapshot.predicted
        variance = 0.0 if isinstance(predicted, str) else predicted.own.filtered
        bell = np.exp(-(error**2) / (2.0 * variance)) if variance else 0.0 * error
        density.set_xy(np.column_stack([error, 0.9 * bell - 2.0]))

    return [density, sector, *ends], update


def _sweep(axes: Axes) -> Changing:
    filtered, smoothed, classical = _curves(axes, "filtered", "smoothed", "classical smoother")
    optimum = _line(axes, "k*", markersize=6, clip_on=False, label="optimum at this lag")
    _legend(axes, "upper right")
    axes.set(title="error against uncertainty", ylabel=_ERROR, ylim=(0.0, 3.0))
    axes.set(xlabel=r"uncertainty $\Delta_2$ (most: $-1$)", xlim=(-1.0, 0.0), xticks=[-1, -0.5, 0])

    def update(sweeps: model.Pair, snapshot: Snapshot) -> None:
        one = snapshot.filtering
        filtered.set_data(SLOPES, sweeps.own.filtered / one)
        smoothed.set_data(SLOPES, sweeps.own.smoothed / one)
        classical.set_data(SLOPES, sweeps.classical.smoothed / one)
        optimum.set_data([0.0], [snapshot.optimum / one])

    return [classical, filtered, smoothed, optimum], update


def _judged(axes: Axes) -> Changing:
    style = {"color": _colour(4), "marker": "D", "markersize": 6, "markerfacecolor": "none"}
    classical = _line(axes, linestyle=":", label="classical smoother", **style)
    own = _line(axes, color="k", linestyle=":", marker="o", markersize=3, label="this design")
    guarantee = _line(axes, color="k", linestyle="-", label="the paper's bound 2V")
    _legend(axes, "upper left")
    axes.set(title="the errors of a design", ylabel=_ERROR, yscale="log")
    axes.set(xlim=(-0.5, 3.5), ylim=(0.3, 30.0), xlabel="of the error that is kept low")
    places = np.arange(4)
    axes.set_xticks(places, ["nominal", "worst constant", "certified", "with the sine"])
    axes.set_yticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
    axes.minorticks_off()

    def update(judged: model.Pair, snapshot: Snapshot) -> None:
        one, cost = snapshot.filtering, snapshot.settings.cost
        unknown = isinstance(snapshot.predicted, str)
        loops = (None, None) if unknown else snapshot.predicted
        for line, each, loop in zip((own, classical), judged, loops, strict=True):
            errors = np.array([*vars(each).values(), getattr(loop, cost, math.nan)])
            line.set_data(places, errors / one)  # one that is infinite is absent
        robust = isinstance(snapshot.estimator, rs.RobustSmoother)
        level = snapshot.estimator.mean_square_bound if robust else math.nan
        guarantee.set_data([-0.5, 3.5], np.full(2, level / one))

    return [guarantee, classical, own], update


def _path(axes: Axes) -> Changing:
    phase = _line(axes, label="true", **TRUTH)
    filtered, smoothed = _curves(axes, "filtered", "smoothed")
    _legend(axes, "upper left", ncols=2)
    axes.set(title="a path and its estimates", xlabel="time (µs)", ylabel="phase (rad)")
    axes.set(xlim=(0.0, 1e6 * STEP * SHOWN), ylim=(-3.0, 3.0))

    def update(path: model.Path, snapshot: Snapshot) -> None:
        phase.set_data(1e6 * path.time, path.phase)
        filtered.set_data(1e6 * path.time, path.filtered)
        smoothed.set_data(1e6 * (path.time - snapshot.settings.lag), path.smoothed)

    return [phase, filtered, smoothed], update


# By what each shows of a snapshot.
_PANELS = {"settings": _sector, "sweeps": _sweep, "judged": _judged, "path": _path}
