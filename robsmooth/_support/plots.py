"""Curves in axes of any style, distinct in grey and for the colour-blind."""

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support import validation
from robsmooth._support.extras import extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes

MEAN_SQUARE = "mean square error\n(squared unit of $w$)"
STYLE = Path(__file__).with_name("robsmooth.mplstyle")

# Places in the style's cycle: the same curve looks the same in all figures.
_PLACES: dict[str | int, int] = {  # a number is the order of a delay's model
    # solid blue, and broken red, as in the paper
    **dict.fromkeys(("filtered", "NGCF", 1), 0),
    **dict.fromkeys(("smoothed", "smoother", "robust smoother", 2), 1),
    **dict.fromkeys(("classical smoother", 4), 2),
    3: 4,
}
# A pale band for the truth or an ideal, under the estimates.
_BAND = {"color": "0.78", "linestyle": "-", "linewidth": 2.5}
_BANDS = dict.fromkeys(("true", "exact optimum", "both optimal, linear loop"), _BAND)


def styles(names: Iterable[str | int]) -> list[dict[str, Any]]:
    """Return the look of each estimate or order; other names get the rest of the cycle in turn."""
    import matplotlib as mpl

    properties = mpl.rc_params_from_file(STYLE, use_default_template=False)["axes.prop_cycle"]
    cycle = [look | {"color": mpl.colors.to_hex(look["color"])} for look in properties]
    others = itertools.cycle(set(range(len(cycle))) - set(_PLACES.values()))
    return [
        _BANDS.get(name) or cycle[_PLACES[name] if name in _PLACES else next(others)]
        for name in names
    ]


def axes_or_new(axes: Any, *grid: int, **settings: Any) -> Any:
    """Return axes, as many as a grid has, or new ones of pyplot with the settings of `subplots`."""
    if axes is None:
        with extra("plot", "a plot"):
            from matplotlib import pyplot as plt
        return plt.subplots(*grid, layout="constrained", **settings)[1]
    found = validation.sequence("ax", axes, "axes", int(np.prod(grid))) if grid else [axes]
    if not all(hasattr(each, "imshow") for each in found):
        raise TypeError(f"ax must be axes of matplotlib, got {validation.shown(axes)}")
    return found if grid else axes


def draw_curves(
    axes: "Axes | None", x: ArrayLike, curves: Mapping[str | int, ArrayLike], **labels: str
) -> "Axes":
    """Draw curves by name or order, over one x or each over its own; new axes have a legend."""
    drawn = axes_or_new(axes)
    x = np.broadcast_to(x, (len(curves), np.shape(x)[-1]))
    for each, (name, y), look in zip(x, curves.items(), styles(curves), strict=True):
        label, order = name if isinstance(name, str) else f"order {name}", np.argsort(each)
        look = look | {"marker": "o"} if len(order) == 1 else look
        drawn.plot(each[order], np.asarray(y)[order], label=label, **look)
    drawn.set(**labels)
    if axes is None:
        drawn.figure.legend(loc="outside lower center", ncols=2)
    return drawn
