"""The explorer of explore.ipynb: sliders, and what a design does at their settings."""

from robsmooth._support.extras import extra
from robsmooth.explorer.snapshot import Settings

with extra("notebooks", "the explorer"):
    from robsmooth.explorer.explorer import Explorer

__all__ = ["Explorer", "Settings"]
