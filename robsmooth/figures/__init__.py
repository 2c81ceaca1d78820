"""The figures of the notebooks."""

from robsmooth.figures.beyond import where_smoothing_pays
from robsmooth.figures.paper import (
    bound_landscape,
    delay_error,
    delta_sweep,
    loss_of_lock,
    mean_squares,
    routes,
    sector,
)
from robsmooth.figures.style import FORMATS, save_figure, use_style

__all__ = [
    "FORMATS",
    "bound_landscape",
    "delay_error",
    "delta_sweep",
    "loss_of_lock",
    "mean_squares",
    "routes",
    "save_figure",
    "sector",
    "use_style",
    "where_smoothing_pays",
]
