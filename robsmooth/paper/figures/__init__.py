"""The figures of the notebooks."""

from robsmooth._support.style import FORMATS, TRUTH, save_figure, styles, use_style
from robsmooth.paper.figures.beyond import (
    all_designs,
    lag_and_order,
    side_by_side,
    two_landscapes,
    where_smoothing_pays,
    worst_spectra,
)
from robsmooth.paper.figures.own import gap, sample_path, smoother_response
from robsmooth.paper.figures.paper import (
    bound_landscape,
    delay_error,
    delta_sweep,
    loss_of_lock,
    mean_squares,
    routes,
    sector,
)

__all__ = [
    "FORMATS",
    "TRUTH",
    "all_designs",
    "bound_landscape",
    "delay_error",
    "delta_sweep",
    "gap",
    "lag_and_order",
    "loss_of_lock",
    "mean_squares",
    "routes",
    "sample_path",
    "save_figure",
    "sector",
    "side_by_side",
    "smoother_response",
    "styles",
    "two_landscapes",
    "use_style",
    "where_smoothing_pays",
    "worst_spectra",
]
