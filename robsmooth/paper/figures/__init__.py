"""The figures of the notebooks, and how they are saved."""

from robsmooth._support.extras import extra

with extra("plot", "a figure"):
    from robsmooth._support.plots import styles
    from robsmooth.paper.figures import plots
    from robsmooth.paper.figures.plots import save_figure, use_style

__all__ = ["plots", "save_figure", "styles", "use_style"]
