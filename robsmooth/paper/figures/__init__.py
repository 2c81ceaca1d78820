"""The figures of the notebooks, and how they are saved."""

from robsmooth._support.style import FORMATS, TRUTH, save_figure, styles, use_style
from robsmooth.paper.figures import beyond, landscapes, own, paper

__all__ = [
    "FORMATS",
    "TRUTH",
    "beyond",
    "landscapes",
    "own",
    "paper",
    "save_figure",
    "styles",
    "use_style",
]
