"""Maps: numbers on a grid as shades, and hatched where there are none.

A point of the grid stands for what is nearer to it than to the next ones. What is beyond the grid
is not shown: there nothing was computed.
"""

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet
from matplotlib.patches import PathPatch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from robsmooth.paper.figures.style import NOWHERE


def shade(
    axes: Axes,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    values: NDArray[np.float64],
    levels: Sequence[float],
    missing: str,
) -> ContourSet:
    """Shade a map between levels, and hatch it around the points of its grid that have no value.

    There are (M, N) values, some not a number, for (N,) x and (M,) y. Levels are the least values
    of the shades; there is one for all above the last. `missing` says what there is not where there
    is no value: a patch of the axes has this label if it is anywhere. Returned is what a colour bar
    needs.
    """
    norm = mpl.colors.BoundaryNorm(levels, 256, extend="max")
    shading = axes.contourf(x, y, _spread(values), levels, norm=norm, extend="max")
    hatch(axes, x, y, np.isnan(values) - 0.5, missing, zorder=1.5)  # on what is spread
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    axes.grid(visible=False)
    return shading


def hatch(
    axes: Axes,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    excess: NDArray[np.float64],
    label: str,
    **look: Any,
) -> None:
    """Hatch where (M, N) numbers for (N,) x and (M,) y are above zero; they are interpolated.

    The label is for a legend; the look of the patch, where not given, is that of what has no value.
    """
    most = np.nanmax(excess, initial=0.0)
    if most <= 0.0:
        return
    region = axes.contourf(x, y, _spread(excess), [0.0, 2.0 * most])
    (path,) = region.get_paths()
    region.remove()
    axes.add_patch(PathPatch(path, label=label, **NOWHERE | look))


def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values on a grid, and beside them, where there is none, the nearest one."""
    distance, nearest = distance_transform_edt(np.isnan(values), return_indices=True)
    return np.where(distance < 2.0, values[tuple(nearest)], np.nan)
