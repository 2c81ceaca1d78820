"""The style of the figures, and the one way to save one."""

import itertools
from collections.abc import Iterable
from importlib.resources import as_file
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from robsmooth._support import files

FORMATS = ("pdf", "svg", "png")
# Nothing in a file says when, or by which release, it was made: equal figures are equal bytes.
_METADATA = {
    "pdf": {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
}

_MARKERS = "os^Dvp"
# What is drawn in several figures looks the same in all of them: its place in the style's cycle.
_CYCLE_POSITIONS: dict[str | int, int] = {
    "filtered": 0,
    "NGCF": 0,  # solid blue and broken red, as the paper has them
    "smoothed": 1,
    "smoother": 1,
    "robust smoother": 1,
    "smoother, as printed": 1,
    "classical smoother": 2,
    "Kalman-Bucy filter": 3,
    "cost: smoothed": 4,
    "cost: filtered": 5,
    "smoother, corrected": 5,  # the same design
    **{1: 0, 2: 1, 4: 2, 8: 3, 3: 4},  # orders of the model of a delay
}

# The truth under its estimates, or an ideal: a band, pale enough not to be taken for one of them.
TRUTH = {"color": "0.78", "linestyle": "-", "linewidth": 2.5}
# A place on an axis.
MARK = {"color": "0.6", "linestyle": "-", "linewidth": 0.8}
# Where a map has no value. A shade of grey would be that of one of its colours in print.
NOWHERE = {"facecolor": "w", "edgecolor": "0.55", "hatch": "/////", "linewidth": 0.0}


def use_style() -> None:
    """Set matplotlib to the style of all figures."""
    with as_file(package_files("robsmooth.paper.figures") / "robsmooth.mplstyle") as path:
        plt.style.use(path)


def styles(names: Iterable[str | int], markers: bool = False) -> list[dict[str, Any]]:
    """Return how to draw the curves of the given names: the colour and dashes of each.

    Estimators, estimates and orders that are in several figures look the same in all of them; other
    names get what is left of the cycle.

    Parameters
    ----------
    names : iterable of str or int
        Of estimators or estimates, or orders of the model of a delay.
    markers : bool
        Whether each has a marker too.
    """
    cycle = [
        style | {"color": mpl.colors.to_hex(style["color"])}
        for style in mpl.rcParams["axes.prop_cycle"]
    ]
    if markers:
        cycle = [style | {"marker": mark} for style, mark in zip(cycle, _MARKERS, strict=False)]
    positions = [_CYCLE_POSITIONS.get(name) for name in names]
    free = [position for position in range(len(cycle)) if position not in positions]
    others = itertools.cycle(free or [0])
    return [cycle[next(others) if position is None else position] for position in positions]


def save_figure(figure: Figure, directory: Path | str, name: str) -> None:
    """Write a figure as PDF, SVG and PNG, byte for byte the same for the same figure.

    Parameters
    ----------
    figure : Figure
    directory : path
        Made where missing.
    name : str
        File name without suffix.
    """
    for suffix in FORMATS:
        path = Path(directory) / f"{name}.{suffix}"
        with files.atomic_path(path) as temporary, mpl.rc_context({"svg.hashsalt": name}):
            figure.savefig(temporary, format=suffix, metadata=_METADATA[suffix])
