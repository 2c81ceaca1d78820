"""The style of the figures, and the one way to save one."""

from importlib.resources import as_file
from importlib.resources import files as package_files
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from robsmooth import files

FORMATS = ("pdf", "svg", "png")
# Nothing in a file says when, or by which release, it was made: equal figures are equal bytes.
_METADATA = {
    "pdf": {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None},
    "png": {"Software": None},
}


def use_style() -> None:
    """Set matplotlib to the style of all figures."""
    with as_file(package_files("robsmooth") / "robsmooth.mplstyle") as path:
        plt.style.use(path)


def save_figure(figure: Figure, directory: Path | str, name: str) -> None:
    """Write a figure as PDF, SVG and PNG, byte for byte the same for the same figure.

    Parameters
    ----------
    figure : Figure
    directory : path
        Made where missing.
    name : str
        File name without suffix.
    """
    for suffix in FORMATS:
        path = Path(directory) / f"{name}.{suffix}"
        with files.atomic_path(path) as temporary, mpl.rc_context({"svg.hashsalt": name}):
            figure.savefig(temporary, format=suffix, metadata=_METADATA[suffix])
