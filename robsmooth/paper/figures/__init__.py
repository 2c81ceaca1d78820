"""The figures of the notebooks, and how they are saved."""

from robsmooth._support.extras import extra

with extra("plot", "a figure"):
    from robsmooth.paper.figures import beyond, landscapes, own, paper
    from robsmooth.paper.figures.style import FORMATS, TRUTH, save_figure, styles, use_style

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
