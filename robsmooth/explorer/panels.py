"""The six panels of the explorer: one figure, drawn once, of which only the data are drawn again.

Axes, labels and legends are the background. It is kept as pixels, and what depends on the settings
is drawn on top. The axes never change: errors are relative to the Kalman-Bucy filter's.
"""

import io
import math
import textwrap
from collections.abc import Callable, Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from robsmooth.explorer.snapshot import ADMISSIBLE, RUNS, SHOWN, SLOPES, STEP, Snapshot
from robsmooth.homodyne.montecarlo import MonteCarloResult
from robsmooth.paper.figures import TRUTH, styles, use_style

PREPARING = (
    "The simulation is being prepared. For an order that is new on this computer that takes some "
    "seconds, once."
)
NO_DESIGN = "No design."
_SIZE, _RESOLUTION = (7.0, 4.5), 130  # inches, and pixels of an inch on the screen
_WIDTH = 26  # letters of a sentence in a panel
_ERROR = "mean square error\n(Kalman filter's = 1)"
_FASTEST = 200.0  # 1/us, the largest pole shown

Update = Callable[[Snapshot, MonteCarloResult | str], str | None]


class Panels:
    """The figure, its panels, and the background.

    Attributes
    ----------
    figure : Figure
        Of the width of a page.
    """

    def __init__(self):
        with mpl.rc_context():
            use_style()
            self.figure = Figure(figsize=_SIZE, dpi=_RESOLUTION)
            canvas = FigureCanvasAgg(self.figure)
            axes = self.figure.subplots(2, 3)
            makers = (_sector, _sweep, _poles, _guarantee, _path, _simulation)
            self._panels = [
                _Panel(each, make) for each, make in zip(axes.flat, makers, strict=True)
            ]
            canvas.draw()
            self.figure.set_layout_engine("none")  # it has done its work: nothing moves any more
        self._background = canvas.copy_from_bbox(self.figure.bbox)

    def update(self, snapshot: Snapshot, simulated: MonteCarloResult | str) -> None:
        """Set the data of all panels; a sentence takes the place of those that there are not."""
        shown: set[str] = set()
        for panel in self._panels:
            sentence = panel.update(snapshot, simulated)
            no_design = sentence == snapshot.estimator
            panel.set_message(NO_DESIGN if no_design and sentence in shown else sentence)
            shown.add(sentence)

    def png(self) -> bytes:
        """Return the figure as it is now."""
        canvas = self.figure.canvas
        canvas.restore_region(self._background)
        for panel in self._panels:
            panel.draw()
        target = io.BytesIO()
        pixels = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        pixels.save(target, "png", compress_level=1)  # half of a drawing's time is spent here
        return target.getvalue()


class _Panel:
    """Axes with what changes in them, or with a sentence in its place."""

    def __init__(self, axes: Axes, make: Callable[[Axes, list[Artist]], Update]):
        self.axes, self.artists = axes, []
        self.update = make(axes, self.artists)
        cover = Rectangle((0.01, 0.01), 0.99, 1.0, transform=axes.transAxes, facecolor="w")
        self.message = axes.text(0.5, 0.5, "", transform=axes.transAxes, ha="center", va="center")
        self.instead = (axes.add_patch(cover), self.message)
        for artist in (*self.artists, *self.instead):
            artist.set(animated=True, in_layout=False)

    def set_message(self, sentence: str | None) -> None:
        self.message.set_text(textwrap.fill(sentence or "", _WIDTH))
        for artist in self.artists:
            artist.set_visible(not sentence)
        for artist in self.instead:
            artist.set_visible(bool(sentence))

    def draw(self) -> None:
        for artist in (*self.artists, *self.instead):
            self.axes.draw_artist(artist)


def _colour(number: int) -> str:
    """Return a colour of the style; "C0" and so on would be looked up again at each drawing."""
    return mpl.rcParams["axes.prop_cycle"].by_key()["color"][number]


def _legend(axes: Axes, lines: Mapping[str, Artist], place: str, **options) -> None:
    """Draw a legend, within the axes: they are narrow."""
    options = {"handlelength": 1.8, "columnspacing": 0.8, "borderaxespad": 0.2} | options
    axes.legend(lines.values(), lines.keys(), loc=place, **options).set_in_layout(False)


# --- what each panel shows: the axes, and how settings change it ----------------------------------


def _sector(axes: Axes, changing: list[Artist]) -> Update:
    error = np.linspace(-np.pi, np.pi, 181)
    (sector,) = axes.fill(*np.zeros((2, 4)), color=_colour(3), alpha=0.4, linewidth=0)
    (density,) = axes.fill(*np.zeros((2, 3)), color="0.75", linewidth=0)
    (sine,) = axes.plot(error, np.sin(error), color="k", linestyle="-")
    ends = [  # the left one ends below the legend
        axes.axvline(0.0, ymax=ymax, color="0.4", linestyle="--", linewidth=0.8)
        for ymax in (0.5, 1.0)
    ]
    changing += [density, sector, *ends]
    _legend(axes, {"sine": sine, "its sector": sector, "errors": density}, "upper left")
    axes.set(
        title="the sine and its sector", xlabel="phase error (rad)", ylabel="detector's signal"
    )
    axes.set(xlim=(-np.pi, np.pi), ylim=(-2.0, 2.0))

    def update(snapshot: Snapshot, _: MonteCarloResult | str) -> None:
        low, high = snapshot.parameters.lower_slope, snapshot.parameters.beta
        edge = error[[0, -1, -1, 0]]
        sector.set_xy(np.column_stack([edge, edge * [low, low, high, high]]))
        reach = snapshot.parameters.sector_range()
        for end, place in zip(ends, (-reach, reach), strict=True):
            end.set_xdata([place, place])
        predicted = snapshot.predicted
        variance = math.inf if isinstance(predicted, str) else predicted.filtered
        bell = np.exp(-(error**2) / (2.0 * variance)) if math.isfinite(variance) else 0.0 * error
        density.set_xy(np.column_stack([error, 0.9 * bell - 2.0]))

    return update


def _sweep(axes: Axes, changing: list[Artist]) -> Update:
    names = ("filtered", "smoothed", "classical smoother")
    filtered, smoothed, classical = (axes.plot([], [], **style)[0] for style in styles(names))
    (optimum,) = axes.plot([], [], "k*", markersize=6, clip_on=False)
    changing += [classical, filtered, smoothed, optimum]
    labels = (*names, "optimum at this lag")
    lines = (filtered, smoothed, classical, optimum)
    _legend(axes, dict(zip(labels, lines, strict=True)), "upper right")
    axes.set(title="error against uncertainty", ylabel=_ERROR)
    axes.set(xlabel=r"uncertainty $\Delta_2$ (most: $-1$)", xlim=(-1.0, 0.0), ylim=(0.0, 3.0))
    axes.set_xticks([-1.0, -0.5, 0.0])

    def update(snapshot: Snapshot, _: MonteCarloResult | str) -> str | None:
        if isinstance(snapshot.sweep, str):
            return snapshot.sweep
        one = snapshot.filtering
        filtered.set_data(SLOPES, snapshot.sweep.filtered / one)
        smoothed.set_data(SLOPES, snapshot.sweep.smoothed / one)
        if isinstance(snapshot.classical, str):
            classical.set_data([], [])
        else:
            classical.set_data(SLOPES, snapshot.classical.smoothed / one)
        optimum.set_data([0.0], [snapshot.optimum / one])
        return None

    return update


def _poles(axes: Axes, changing: list[Artist]) -> Update:
    (tangent,) = axes.plot([], [], "x", color=_colour(0), markersize=5)
    (edge,) = axes.plot([], [], "o", color=_colour(1), markersize=4, markerfacecolor="none")
    changing += [edge, tangent]
    _legend(axes, {"no uncertainty": tangent, "sector's edge": edge}, "upper left")
    axes.set_xscale("symlog", linthresh=0.01)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set(title="poles of the estimator", ylabel="imaginary part (1/µs)")
    axes.set(xlabel="real part (1/µs)", xlim=(-_FASTEST, 0.0), ylim=(-_FASTEST, _FASTEST))
    axes.set_xticks([-100, -1, -0.01], ["$-100$", "$-1$", "$-0.01$"])
    axes.set_yticks([-100, -1, 0, 1, 100], ["$-100$", "$-1$", "0", "1", "100"])
    axes.minorticks_off()

    def update(snapshot: Snapshot, _: MonteCarloResult | str) -> str | None:
        if isinstance(snapshot.poles, str):
            return snapshot.poles
        for line, poles in zip((tangent, edge), 1e-6 * snapshot.poles, strict=True):
            line.set_data(poles.real, poles.imag)
        return None

    return update


def _guarantee(axes: Axes, changing: list[Artist]) -> Update:
    (bound,) = axes.plot([-1.0, 1.0], [1.0, 1.0], color="k", linestyle="-")
    (error,) = axes.plot([], [], color=_colour(4), linestyle="-.")
    changing += [error, bound]
    _legend(axes, {"bound": bound, "what it bounds": error}, "upper right")
    axes.set(title="bound against covariance", ylabel=_ERROR, yscale="log")
    axes.set(xlabel=r"uncertainty $\Delta_2$", xlim=(-1.0, 1.0), ylim=(0.3, 30.0))
    axes.set_yticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
    axes.minorticks_off()

    def update(snapshot: Snapshot, _: MonteCarloResult | str) -> str | None:
        if isinstance(snapshot.guarantee, str):
            return snapshot.guarantee
        level = snapshot.guarantee.bound / snapshot.filtering
        bound.set_ydata([level, level] if math.isfinite(level) else [])
        bound.set_xdata([-1.0, 1.0] if math.isfinite(level) else [])
        error.set_data(ADMISSIBLE, snapshot.guarantee.errors / snapshot.filtering)
        return None

    return update


def _path(axes: Axes, changing: list[Artist]) -> Update:
    (phase,) = axes.plot([], [], **TRUTH)
    filtered, smoothed = (
        axes.plot([], [], **style)[0] for style in styles(("filtered", "smoothed"))
    )
    changing += [phase, filtered, smoothed]
    lines = {"true": phase, "filtered": filtered, "smoothed": smoothed}
    _legend(axes, lines, "upper left", ncols=2)
    axes.set(title="a path and its estimates", xlabel="time (µs)", ylabel="phase (rad)")
    axes.set(xlim=(0.0, 1e6 * STEP * SHOWN), ylim=(-3.0, 3.0))

    def update(snapshot: Snapshot, _: MonteCarloResult | str) -> str | None:
        path = snapshot.path
        if isinstance(path, str):
            return path
        time = 1e6 * path.time
        phase.set_data(time, path.phase)
        filtered.set_data(time, path.filtered)
        smoothed.set_data(time - 1e6 * snapshot.settings.lag, path.smoothed)
        return None

    return update


def _simulation(axes: Axes, changing: list[Artist]) -> Update:
    (nominal,) = axes.plot([], [], "k_", markersize=16)
    (fitted,) = axes.plot([], [], "o", color=_colour(4), markersize=8, markerfacecolor="none")
    (points,) = axes.plot([], [], "o", color=_colour(1), markersize=3)
    intervals = [axes.plot([], [], color=_colour(1), linestyle="-")[0] for _ in range(2)]
    numbers = [axes.text(place, 0.05, "", ha="center") for place in (0.0, 1.0)]
    slips = axes.text(0.5, 1.4, "", ha="center")
    changing += [nominal, fitted, *intervals, points, *numbers, slips]
    lines = {"line, no uncertainty": nominal, "line, fitted": fitted, "simulated": points}
    _legend(axes, lines, "upper left", handlelength=1.4)
    axes.set(title="Monte Carlo, with the sine", ylabel=_ERROR)
    axes.set(xlim=(-0.6, 1.6), ylim=(0.0, 2.5))
    axes.set_xticks([0, 1], ["filtered", "smoothed"])
    axes.set_xlabel("numbers: rad², ± 95%")

    def update(snapshot: Snapshot, simulated: MonteCarloResult | str) -> str | None:
        if isinstance(simulated, str):
            return simulated
        one, sweep, theory = snapshot.filtering, snapshot.sweep, snapshot.predicted
        means = simulated.in_lock()
        values = np.array([mean.mean_square for mean in means]) / one
        points.set_data([0, 1], values)
        for place, (line, text, mean) in enumerate(zip(intervals, numbers, means, strict=True)):
            half = 1.96 * mean.standard_error
            line.set_data([place, place], np.array([-half, half]) / one + values[place])
            text.set_text(f"{mean.mean_square:.5f}\n± {half:.5f}")
        known = () if isinstance(sweep, str) else (sweep.filtered[-1], sweep.smoothed[-1])
        nominal.set_data(range(len(known)), np.array(known) / one)
        known = () if isinstance(theory, str) else (theory.filtered, theory.smoothed)
        fitted.set_data(range(len(known)), np.array(known) / one)
        slips.set_text(f"{simulated.slipped_paths} of {RUNS} paths slip" * (simulated.slips > 0))
        return None

    return update
