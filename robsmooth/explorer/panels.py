"""The six panels of the explorer: one figure, of which what the settings change is drawn again.

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
from robsmooth.explorer.snapshot import RUNS, SHOWN, SLOPES, STEP, Settings, Snapshot
from robsmooth.paper.figures import TRUTH, styles, use_style

NO_DESIGN = "No design."
_SIZE, _RESOLUTION = (7.0, 4.5), 130  # inches, and pixels of an inch on the screen
_WIDTH = 26  # letters of a sentence in a panel
_ERROR = "mean square error\n(Kalman filter's = 1)"
_FASTEST = 200.0  # 1/us, the largest pole shown

# What changes in a panel, from the bottom up, and how what it shows and the snapshot change it.
Changing = tuple[list[Artist], Callable[[Any, Snapshot], None]]


class Panels:
    """The figure, of the width of a page, its panels, and the background."""

    def __init__(self):
        with mpl.rc_context():
            use_style()
            self.figure = Figure(figsize=_SIZE, dpi=_RESOLUTION)
            canvas = FigureCanvasAgg(self.figure)
            axes = self.figure.subplots(2, 3).flat
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
        variance = getattr(snapshot.predicted, "filtered", math.inf)
        bell = np.exp(-(error**2) / (2.0 * variance)) if math.isfinite(variance) else 0.0 * error
        density.set_xy(np.column_stack([error, 0.9 * bell - 2.0]))

    return [density, sector, *ends], update


def _sweep(axes: Axes) -> Changing:
    filtered, smoothed, classical = _curves(axes, "filtered", "smoothed", "classical smoother")
    optimum = _line(axes, "k*", markersize=6, clip_on=False, label="optimum at this lag")
    _legend(axes, "upper right")
    axes.set(title="error against uncertainty", ylabel=_ERROR, ylim=(0.0, 3.0))
    axes.set(xlabel=r"uncertainty $\Delta_2$ (most: $-1$)", xlim=(-1.0, 0.0), xticks=[-1, -0.5, 0])

    def update(sweep: model.Sweep, snapshot: Snapshot) -> None:
        one, other = snapshot.filtering, snapshot.classical
        filtered.set_data(SLOPES, sweep.filtered / one)
        smoothed.set_data(SLOPES, sweep.smoothed / one)
        classical.set_data(SLOPES, getattr(other, "smoothed", np.nan * SLOPES) / one)
        optimum.set_data([0.0], [snapshot.optimum / one])

    return [classical, filtered, smoothed, optimum], update


def _poles(axes: Axes) -> Changing:
    tangent = _line(axes, "x", color=_colour(0), markersize=5, label="no uncertainty")
    style = {"color": _colour(1), "markersize": 4, "markerfacecolor": "none"}
    edge = _line(axes, "o", **style, label="sector's edge")
    _legend(axes, "upper left")
    axes.set_xscale("symlog", linthresh=0.01)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set(title="poles of the estimator", ylabel="imaginary part (1/µs)")
    axes.set(xlabel="real part (1/µs)", xlim=(-_FASTEST, 0.0), ylim=(-_FASTEST, _FASTEST))
    axes.set_xticks([-100, -1, -0.01], ["$-100$", "$-1$", "$-0.01$"])
    axes.set_yticks([-100, -1, 0, 1, 100], ["$-100$", "$-1$", "0", "1", "100"])
    axes.minorticks_off()

    def update(poles: np.ndarray, _: Snapshot) -> None:
        for line, each in zip((tangent, edge), 1e-6 * poles, strict=True):
            line.set_data(each.real, each.imag)

    return [edge, tangent], update


def _judged(axes: Axes) -> Changing:
    style = {"color": _colour(4), "marker": "D", "markersize": 6, "markerfacecolor": "none"}
    classical = _line(axes, linestyle=":", label="classical smoother", **style)
    own = _line(axes, color="k", linestyle=":", marker="o", markersize=3, label="this design")
    guarantee = _line(axes, color="k", linestyle="-", label="the paper's bound 2V")
    _legend(axes, "upper left")
    axes.set(title="the three errors of a design", ylabel=_ERROR, yscale="log")
    axes.set(xlim=(-0.5, 2.5), ylim=(0.3, 30.0), xlabel="of the error that is kept low")
    axes.set_xticks([0, 1, 2], ["nominal", "constant", "certified"])
    axes.set_yticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
    axes.minorticks_off()

    def update(judged: model.Judged, snapshot: Snapshot) -> None:
        for line, judgement in zip((own, classical), judged, strict=True):
            errors = np.array(list(vars(judgement).values()))
            line.set_data([0, 1, 2], errors / snapshot.filtering)  # one that is infinite is absent
        robust = isinstance(snapshot.estimator, rs.RobustSmoother)
        level = snapshot.estimator.mean_square_bound if robust else math.nan
        guarantee.set_data([-0.5, 2.5], np.full(2, level / snapshot.filtering))

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


def _simulation(axes: Axes) -> Changing:
    nominal = _line(axes, "k_", markersize=16, label="line, no uncertainty")
    style = {"color": _colour(4), "markersize": 8, "markerfacecolor": "none"}
    fitted = _line(axes, "o", **style, label="line, fitted")
    points = _line(axes, "o", color=_colour(1), markersize=3, label="simulated")
    intervals = [_line(axes, color=_colour(1), linestyle="-") for _ in range(2)]
    numbers = [axes.text(place, 0.05, "", ha="center") for place in (0.0, 1.0)]
    slips = axes.text(0.5, 1.4, "", ha="center")
    _legend(axes, "upper left", handlelength=1.4)
    axes.set(title="Monte Carlo, with the sine", ylabel=_ERROR)
    axes.set(xlim=(-0.6, 1.6), ylim=(0.0, 2.5), xlabel="numbers: rad², ± 95%")
    axes.set_xticks([0, 1], ["filtered", "smoothed"])

    def update(simulated: rs.MonteCarloResult, snapshot: Snapshot) -> None:
        one, means = snapshot.filtering, simulated.in_lock()
        points.set_data([0, 1], [mean.mean_square / one for mean in means])
        for place, (line, text, mean) in enumerate(zip(intervals, numbers, means, strict=True)):
            half = 1.96 * mean.standard_error
            ends = mean.mean_square - half, mean.mean_square + half
            line.set_data([place, place], [end / one for end in ends])
            text.set_text(f"{mean.mean_square:.5f}\n± {half:.5f}")
        for line, found in ((nominal, snapshot.sweep), (fitted, snapshot.predicted)):
            known = [getattr(found, name, math.nan) for name in ("filtered", "smoothed")]
            line.set_data([0, 1], [np.ravel(value)[-1] / one for value in known])  # without Delta
        slips.set_text(f"{simulated.slipped_paths} of {RUNS} paths slip" * (simulated.slips > 0))

    return [nominal, fitted, *intervals, points, *numbers, slips], update


# By what each shows of a snapshot, or the simulation.
_PANELS = {"settings": _sector, "sweep": _sweep, "poles": _poles}
_PANELS |= {"judged": _judged, "path": _path, "simulated": _simulation}
