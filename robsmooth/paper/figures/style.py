"""The style of the figures, common parts, and the saving of a figure."""

import textwrap
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from robsmooth._support import files
from robsmooth._support.plots import STYLE

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
