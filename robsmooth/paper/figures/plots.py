"""The figures of the notebooks, their style, and the saving of a figure."""

import itertools
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import BoundaryNorm
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from robsmooth._support import files
from robsmooth._support.plots import STYLE, styles
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.simulation.statistics import MeanSquare

Array = NDArray[np.float64]
Errors = Mapping[str, float]

# No file has a date or a release: equal figures are equal bytes.
FORMATS = {
    "pdf": {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
}

DOTTED = {"color": "0.4", "linestyle": ":", "linewidth": 0.9}  # a line to compare with
LOOSE = {"linestyle": "none", "clip_on": False}  # points, not clipped at the edge of the axes
# Where a map has no value: hatched, because its colours are shades of grey in print.
NOWHERE = {"facecolor": "w", "edgecolor": "0.55", "hatch": "/////", "linewidth": 0.0}


def use_style() -> None:
    """Set matplotlib to the style of all figures."""
    plt.style.use(STYLE)


def label_ticks(axis: Axis, ticks: Sequence[float], unit: float = 1.0) -> None:
    """Label these ticks of a logarithmic axis in a unit, without powers of ten."""
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(lambda tick, _: f"{tick / unit:g}")
    axis.axes.minorticks_off()


def label_rows(axes: Axes, labels: Collection[str], width: int = 20) -> NDArray[np.int64]:
    """Give each label a row of the axes, from the top, and return the rows' heights."""
    heights = np.arange(len(labels))[::-1]
    texts = [textwrap.fill(label, width) for label in labels]
    axes.set(yticks=heights, yticklabels=texts, ylim=(-0.6, len(labels) - 0.4))
    axes.grid(axis="y", visible=False)
    return heights


def with_legend(figure: Figure, **of: Any) -> Figure:
    """Return the figure with a legend below its panels."""
    figure.legend(loc="outside lower center", ncols=2, **of)
    return figure


def save_figure(figure: Figure, directory: Path | str, name: str) -> None:
    """Write a figure as `name`.pdf, .svg and .png."""
    for suffix, metadata in FORMATS.items():
        path = Path(directory) / f"{name}.{suffix}"
        with files.atomic_path(path) as temporary, mpl.rc_context({"svg.hashsalt": name}):
            figure.savefig(temporary, format=suffix, metadata=metadata)


def sector(parameters: HomodyneParameters, variance: float) -> Figure:
    """Draw Fig. 3: the sine in its sector, and the Gaussian density of the error."""
    figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(3.4, 4.2), height_ratios=(3, 1))
    error = np.linspace(-np.pi, np.pi, 721)
    upper, lower, wide = parameters.beta, parameters.lower_slope, parameters.sector_slope
    label = rf"sector $[{lower:g},\,{upper:g}]$"
    top.fill_between(error, lower * error, upper * error, color="C0", alpha=0.2, lw=0, label=label)
    top.plot(error, np.sin(error), color="C1", linestyle="-", label=r"$\sin e$")
    top.plot(error, upper * error, label=rf"tangent, $\beta={upper:g}$", **DOTTED)
    top.plot(error, wide * error, "C4--", lw=0.9, label=rf"$m=1-2\gamma={wide:.1f}$")
    reach, lipschitz = parameters.sector_range(), parameters.lipschitz_range
    for axes, sign in itertools.product((bottom, top), (-1, 1)):
        side = axes.axvline(sign * reach, color="C0", linestyle="-.", linewidth=0.8)
        limit = axes.axvline(sign * lipschitz, color="k", linestyle=(0, (3, 3)), linewidth=0.8)
    side.set_label(f"sector to {reach:.2f} rad")
    limit.set_label(f"Lipschitz to {lipschitz:.3f} rad")
    top.set(ylim=(-1.75, 1.75), ylabel=r"$\sin e = \beta e + f(e)$")
    density = np.exp(-(error**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    bottom.fill_between(error, density, color="0.6", linewidth=0)
    bottom.set(xlabel=r"phase error $e = \phi - \hat\phi$ (rad)", ylabel="density\n(1/rad)")
    bottom.set(xlim=(-np.pi, np.pi), ylim=(0, None))
    return with_legend(figure)


def mean_squares(
    cases: Sequence[str], results: Mapping[str, list[MeanSquare]], printed: Errors
) -> Figure:
    """Draw each quantity's simulated errors, a row for each case, and the printed as lines."""
    figure, axes = plt.subplots(figsize=(3.4, 0.9 + 0.36 * len(cases)))
    heights = label_rows(axes, cases, width=18)
    looks = styles(label.split(",")[0] for label in results)
    above = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "va": "bottom"}
    for marker, look, (label, values) in zip("os", looks, results.items(), strict=False):
        means, color = [value.mean_square for value in values], look["color"]
        axes.plot(means, heights, marker, color=color, markersize=3, label=label)
        value = printed[label]
        axes.axvline(value, color=color, linestyle="--", linewidth=0.9)
        side = "right" if value == min(printed.values()) else "left"
        text = {"text": f"printed {value:g}", "ha": side, "color": color}
        axes.annotate(xy=(value, 1.0), xytext=(0, 1), **text, **above)
    axes.set(xlabel=r"mean square error (rad$^2$)", xlim=(0, 1.3 * max(printed.values())))
    return with_legend(figure)


def candidates(
    errors: Mapping[str, Errors], floors: Errors, unit: str, limits: tuple[float, float]
) -> Figure:
    """Draw estimators' errors in rows, those beyond the limits as numbers, and floors as lines."""
    figure, axes = plt.subplots(figsize=(3.4, 1.3 + 0.34 * len(errors)))
    draw_candidates(axes, errors, limits)
    for dashes, (name, floor) in zip(("-", "--", ":"), floors.items(), strict=False):
        axes.axvline(floor, color="0.45", linestyle=dashes, linewidth=0.9, zorder=0, label=name)
    axes.set(xlabel=f"mean square error ({unit})")
    return with_legend(figure)


def draw_candidates(axes: Axes, errors: Mapping[str, Errors], limits: tuple[float, float]) -> None:
    """Draw a row for each estimator, of the errors that are known, with labels for a legend."""
    heights, kinds = label_rows(axes, errors), [*dict.fromkeys(itertools.chain(*errors.values()))]
    found = np.array([[each.get(kind, np.nan) for kind in kinds] for each in errors.values()])
    shown = {"color": "0.85", "linestyle": "-", "linewidth": 2.5, "zorder": 1}
    axes.plot(np.minimum(found, limits[1]).T, np.tile(heights, (len(kinds), 1)), **shown)
    looks = zip("o^|x", ("C0", "C1", "k", "k"), kinds, found.T, strict=False)
    for marker, color, kind, values in looks:
        values = np.where(values > limits[1], np.nan, values)
        axes.plot(values, heights, marker=marker, color=color, label=kind, **LOOSE)
    for height, values in zip(heights, found, strict=True):
        if beyond := ", ".join(f"{value:.3g}" for value in values if value > limits[1]):
            axes.annotate(f"{beyond} →", (limits[1], height + 0.2), ha="right", color="0.3")
    axes.set(xlim=limits)


def shade(
    axes: Axes, x: Array, y: Array, values: Array, levels: Sequence[float], missing: str
) -> ContourSet:
    """Shade (M, N) values over (N,) x and (M,) y by levels; hatch NaN with the label `missing`."""
    norm = BoundaryNorm(levels, 256, extend="max")
    shading = axes.contourf(x, y, _spread(values), levels, norm=norm, extend="max")
    hatch(axes, x, y, np.isnan(values) - 0.5, missing, zorder=1.5)  # above the spread values
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    axes.grid(visible=False)
    return shading


def hatch(axes: Axes, x: Array, y: Array, excess: Array, label: str, **look: Any) -> None:
    """Hatch where (M, N) numbers for (N,) x and (M,) y, interpolated, are above zero."""
    most = np.nanmax(excess, initial=0.0)
    if most > 0.0:
        region = axes.contourf(x, y, _spread(excess), [0.0, 2.0 * most])
        (path,) = region.get_paths()
        region.remove()
        axes.add_patch(PathPatch(path, label=label, **NOWHERE | look))


def _spread(values: Array) -> Array:
    """Return values on a grid; NaN beside a value becomes that value."""
    distance, nearest = distance_transform_edt(np.isnan(values), return_indices=True)
    return np.where(distance < 2.0, values[tuple(nearest)], np.nan)
