"""The explorer of explore.ipynb: sliders, and what a design does at their settings."""

from robsmooth.explorer.explorer import Explorer
from robsmooth.explorer.settings import Settings
from robsmooth.explorer.text import experiments

__all__ = ["Explorer", "Settings", "experiments"]
