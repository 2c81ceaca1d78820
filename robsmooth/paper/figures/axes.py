"""What several figures draw alike on their axes."""

import textwrap
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from robsmooth.homodyne.montecarlo import MeanSquare
from robsmooth.paper.figures.style import styles

DOTTED = {"color": "0.4", "linestyle": ":", "linewidth": 0.9}  # a line to compare with
LOOSE = {"linestyle": "none", "clip_on": False}  # points, whole even at the edge of the axes


def stacked(height: float, ratios: tuple[float, float]) -> tuple[Figure, tuple[Axes, Axes]]:
    """Return a figure with two panels, one above the other, over one x axis; inches."""
    return plt.subplots(2, 1, sharex=True, figsize=(3.4, height), height_ratios=ratios)


def label_ticks(axis: Axis, ticks: Sequence[float]) -> None:
    """Label these ticks of a logarithmic axis, those in its view, as numbers without powers."""
    low, high = axis.get_view_interval()
    seen = [tick for tick in ticks if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]
    axis.set_ticks(seen, [f"{tick:g}" for tick in seen])
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


def plot_intervals(
    axes: Axes, values: Sequence[MeanSquare], heights: ArrayLike, **look: Any
) -> None:
    """Plot mean squares with their 95% intervals, each at its height."""
    means = [value.mean_square for value in values]
    reach = [1.96 * value.standard_error for value in values]
    axes.errorbar(means, heights, xerr=reach, **look | {"linestyle": "none", "markersize": 3})
