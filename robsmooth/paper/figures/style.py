"""The style of the figures, what several of them draw alike, and the one way to save one."""

import itertools
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from numpy.typing import ArrayLike, NDArray

from robsmooth._support import files

# The formats of a file. Nothing in it says when, or by which release, it was made: equal figures
# are equal bytes.
FORMATS = {
    "pdf": {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
}

# What is drawn in several figures looks the same in all of them: its place in the style's cycle.
_PLACES: dict[str | int, int] = {  # a number is the order of a delay's model
    # solid blue, and broken red, as the paper has them
    **dict.fromkeys(("filtered", "NGCF", 1), 0),
    **dict.fromkeys(("smoothed", "smoother", "robust smoother", 2), 1),
    **dict.fromkeys(("classical smoother", 4), 2),
    3: 4,
}

# The truth under its estimates, or an ideal: a band, pale enough not to be taken for one of them.
TRUTH = {"color": "0.78", "linestyle": "-", "linewidth": 2.5}
DOTTED = {"color": "0.4", "linestyle": ":", "linewidth": 0.9}  # a line to compare with
LOOSE = {"linestyle": "none", "clip_on": False}  # points, whole even at the edge of the axes
# Where a map has no value. A shade of grey would be that of one of its colours in print.
NOWHERE = {"facecolor": "w", "edgecolor": "0.55", "hatch": "/////", "linewidth": 0.0}


def use_style() -> None:
    """Set matplotlib to the style of all figures."""
    plt.style.use("robsmooth.paper.figures.robsmooth")


def styles(names: Iterable[str | int]) -> list[dict[str, Any]]:
    """Return the colour and dashes of each estimate or order.

    Names without a place in the cycle get what is left of it in turn.
    """
    properties = mpl.rcParams["axes.prop_cycle"]
    cycle = [look | {"color": mpl.colors.to_hex(look["color"])} for look in properties]
    others = itertools.cycle(set(range(len(cycle))) - set(_PLACES.values()))
    return [cycle[_PLACES[name] if name in _PLACES else next(others)] for name in names]


def label_ticks(axis: Axis, ticks: Sequence[float]) -> None:
    """Label these ticks of a logarithmic axis, as numbers without powers."""
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter("{x:g}")
    axis.axes.minorticks_off()


def label_rows(axes: Axes, labels: Collection[str], width: int = 20) -> NDArray[np.int64]:
    """Give each label a row of the axes, from the top, and return the rows' heights."""
    heights = np.arange(len(labels))[::-1]
    texts = [textwrap.fill(label, width) for label in labels]
    axes.set(yticks=heights, yticklabels=texts, ylim=(-0.6, len(labels) - 0.4))
    axes.grid(axis="y", visible=False)
    return heights


def plot_curves(axes: Axes, x: ArrayLike, curves: Mapping[str | int, ArrayLike]) -> None:
    """Plot curves in the styles of their names; a number is the order of a delay's model."""
    for name, style in zip(curves, styles(curves), strict=True):
        label = name if isinstance(name, str) else f"order {name}"
        axes.plot(x, curves[name], label=label, **style)


def with_legend(figure: Figure, columns: int = 2, **of: Any) -> Figure:
    """Return the figure with a legend below its panels, of all that has a label or of handles."""
    figure.legend(loc="outside lower center", ncols=columns, **of)
    return figure


def save_figure(figure: Figure, directory: Path | str, name: str) -> None:
    """Write a figure as `name`.pdf, .svg and .png, byte for byte the same for the same figure."""
    for suffix, metadata in FORMATS.items():
        path = Path(directory) / f"{name}.{suffix}"
        with files.atomic_path(path) as temporary, mpl.rc_context({"svg.hashsalt": name}):
            figure.savefig(temporary, format=suffix, metadata=metadata)
