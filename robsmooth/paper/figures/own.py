"""The figures of a user's own system."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robsmooth.paper.figures.axes import plot_curves, stacked
from robsmooth.paper.figures.style import NOWHERE, TRUTH
from robsmooth.simulation.statistics import SamplePaths


def sample_path(paths: SamplePaths, unit: str, scale: float, quantity: str) -> Figure:
    """Draw the first path of a loop and its estimates, each at the time that it is for.

    The time axis is in a unit of which a second has `scale`; `quantity` labels the first output.
    """
    figure, axes = plt.subplots(figsize=(3.4, 2.4))
    time = scale * paths.time
    axes.plot(time, paths.w[0, :, 0], label="true", **TRUTH)
    plot_curves(axes, time, {"filtered": paths.filtered[0, :, 0]})
    plot_curves(axes, time - scale * paths.delay, {"smoothed": paths.smoothed[0, :, 0]})
    axes.set(xlabel=f"time ({unit})", ylabel=quantity, xlim=(0.0, time[-1]))
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def gap(record: SamplePaths, estimates: NDArray[np.float64], missing: slice) -> Figure:
    """Draw the first output and its smoothed estimate around missing measurements.

    The record is of one path. The (N, m) estimates are from its measurements without the rows that
    are missing.
    """
    around = slice(max(missing.start - 600, 0), missing.stop + 600)
    figure, axes = plt.subplots(figsize=(3.4, 2.2))
    time = record.time[around]
    ends = record.time[[missing.start, missing.stop]] - record.step
    axes.axvspan(*ends, label="no measurement", **NOWHERE)
    axes.plot(time, record.w[0, around, 0], label="true", **TRUTH)
    plot_curves(axes, time - record.delay, {"smoothed": estimates[around, 0]})
    axes.set(xlabel="time (s)", ylabel="angle (rad)", xlim=time[[0, -1]])
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def smoother_response(
    omega: NDArray[np.float64], response: NDArray[np.complexfloating], delay: float
) -> Figure:
    """Draw a smoother's response from the measurement to the estimate, beside a pure delay's.

    There is a complex response at each angular frequency omega (rad/s); the delay is in s.
    """
    figure, (top, bottom) = stacked(3.0, (1, 1))
    top.loglog(omega, np.ones_like(omega), label="pure delay", **TRUTH)
    plot_curves(top, omega, {"smoother": np.abs(response)})
    top.set(ylabel="magnitude", ylim=(1e-2, 3.0))
    top.legend(loc="lower left")
    bottom.plot(omega, np.degrees(-omega * delay), **TRUTH)
    plot_curves(bottom, omega, {"smoother": np.degrees(np.unwrap(np.angle(response)))})
    bottom.set(ylabel="phase (°)", yticks=np.arange(-360, 1, 90), ylim=(-400.0, 20.0))
    bottom.set(xlabel=r"angular frequency $\omega$ (rad/s)", xlim=omega[[0, -1]])
    return figure
