"""The figures, and the one way to save one."""

from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files as package_files
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from robsmooth import files
from robsmooth.homodyne import HomodyneParameters

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
        with files.atomic_path(Path(directory) / f"{name}.{suffix}") as temporary:
            with mpl.rc_context({"svg.hashsalt": name}):
                figure.savefig(temporary, format=suffix, metadata=_METADATA[suffix])


def sector(parameters: HomodyneParameters, variance: float) -> Figure:
    r"""Draw Fig. 3: the sine of the phase error in its sector, and where the error lives.

    Parameters
    ----------
    parameters : HomodyneParameters
    variance : float
        Stationary variance of the error, rad^2, for the lower panel.
    """
    figure, (top, bottom) = plt.subplots(
        2, 1, sharex=True, figsize=(3.4, 3.6), height_ratios=(3, 1)
    )
    error = np.linspace(-np.pi, np.pi, 721)
    upper, lower = parameters.beta, parameters.lower_slope
    reach = parameters.sector_range()
    wide = parameters.sector_slope
    top.fill_between(
        error, lower * error, upper * error, color="C0", alpha=0.15, linewidth=0,
        label=rf"design's sector $[{lower:g},\,{upper:g}]$",
    )
    top.plot(error, np.sin(error), color="C1", linestyle="-", label=r"$\sin\mu_1$")
    top.plot(error, upper * error, color="0.4", linestyle=":", linewidth=0.9,
             label=rf"tangent, $\beta={upper:g}$")
    top.plot(error, wide * error, color="C2", linestyle="--", linewidth=0.9,
             label=rf"$m=1-2\gamma={wide:.1f}$")
    for end in (-reach, reach):
        for axes in (top, bottom):
            axes.axvline(end, color="C0", linestyle="-.", linewidth=0.8)
    top.annotate(f"{reach:.2f} rad", (reach, -1.55), xytext=(3, 0), textcoords="offset points",
                 color="C0", fontsize=7)
    top.set(ylim=(-1.75, 1.75), ylabel=r"$y = f(\mu_1) + \beta\mu_1$")
    top.legend(loc="upper left", borderaxespad=0.0, frameon=True, framealpha=1.0, edgecolor="none")
    density = np.exp(-(error**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    bottom.fill_between(error, density, color="0.6", linewidth=0)
    bottom.set(
        xlabel=r"phase error $\mu_1 = \phi - \hat\phi$ (rad)", ylabel="density\n(1/rad)",
        xlim=(-np.pi, np.pi), ylim=(0, None),
    )
    return figure


def delta_sweep(
    slopes: Sequence[float],
    curves: Mapping[str, Sequence[float]],
    ylabel: str = r"error covariance (rad$^2$)",
) -> Figure:
    r"""Draw error covariances against :math:`\Delta_2`, as Fig. 4.

    Parameters
    ----------
    slopes : (N,) sequence
        Values of :math:`\Delta_2`.
    curves : mapping
        From each label to its (N,) error covariances, rad^2.
    """
    figure, axes = plt.subplots()
    for label, values in curves.items():
        axes.plot(slopes, values, label=label)
    axes.set(
        xlabel=r"measurement uncertainty $\Delta_2$", ylabel=ylabel,
        xlim=(min(slopes), max(slopes)), ylim=(0, None),
    )
    axes.legend()
    return figure


def mean_squares(
    cases: Sequence[str],
    results: Mapping[str, Sequence[tuple[float, float]]],
    published: Mapping[str, float],
) -> Figure:
    """Draw simulated mean square errors with their intervals against what is printed.

    Parameters
    ----------
    cases : sequence of str
        Labels of the variants, one a row.
    results : mapping
        From each quantity, e.g. "NGCF, filtered", to its (mean square, standard error) in every
        case, rad^2.
    published : mapping
        From the same quantities to the printed value, drawn as a line.
    """
    figure, axes = plt.subplots(figsize=(3.4, 0.9 + 0.36 * len(cases)))
    rows = np.arange(len(cases))[::-1]
    markers = iter("os^Dv")
    for index, (label, pairs) in enumerate(results.items()):
        means, errors = np.array(pairs, dtype=float).T
        colour = f"C{index}"
        axes.errorbar(means, rows, xerr=1.96 * errors, fmt=next(markers), color=colour, label=label)
        if label in published:
            axes.axvline(published[label], color=colour, linestyle="--", linewidth=0.9)
            axes.annotate(
                f"printed {published[label]:g}", (published[label], 1.0), xycoords=("data", "axes fraction"),
                xytext=(2, 1), textcoords="offset points", fontsize=7, color=colour, ha="center",
                va="bottom",
            )
    axes.set(
        yticks=rows, yticklabels=cases, xlabel=r"mean square error (rad$^2$)",
        ylim=(-0.6, len(cases) - 0.4), xlim=(0, None),
    )
    axes.grid(axis="y", visible=False)
    figure.legend(loc="outside lower center", ncols=2)
    return figure
