"""The figures of a user's own system."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robsmooth._support.style import NOWHERE, TRUTH, styles
from robsmooth.simulation.simulate import SamplePaths


def sample_path(paths: SamplePaths, unit: str, scale: float, quantity: str) -> Figure:
    """Draw the first path of a loop and its estimates, each at the time that it is for.

    Parameters
    ----------
    paths : SamplePaths
    unit : str
        Of the time axis.
    scale : float
        How many of it are a second.
    quantity : str
        Label of the first output.
    """
    figure, axes = plt.subplots(figsize=(3.4, 2.4))
    time = scale * paths.time
    filtered, smoothed = styles(["filtered", "smoothed"])
    axes.plot(time, paths.w[0, :, 0], label="true", **TRUTH)
    axes.plot(time, paths.filtered[0, :, 0], label="filtered", **filtered)
    back = time - scale * paths.delay
    axes.plot(back, paths.smoothed[0, :, 0], label="smoothed", **smoothed)
    axes.set(xlabel=f"time ({unit})", ylabel=quantity, xlim=(0.0, time[-1]))
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def gap(record: SamplePaths, estimates: NDArray[np.float64], missing: slice) -> Figure:
    """Draw the first output and its smoothed estimate around missing measurements.

    Parameters
    ----------
    record : SamplePaths
        What was simulated, of one path.
    estimates : (N, m) array
        What the measurements of it, less those that are missing, gave.
    missing : slice
        Their rows.
    """
    around = slice(max(missing.start - 600, 0), missing.stop + 600)
    figure, axes = plt.subplots(figsize=(3.4, 2.2))
    ends = record.time[[missing.start, missing.stop]] - record.step
    (smoothed,) = styles(["smoothed"])
    axes.axvspan(*ends, label="no measurement", **NOWHERE)
    axes.plot(record.time[around], record.w[0, around, 0], label="true", **TRUTH)
    times = record.time[around] - record.delay
    axes.plot(times, estimates[around, 0], label="smoothed", **smoothed)
    axes.set(xlabel="time (s)", ylabel="angle (rad)", xlim=record.time[around][[0, -1]])
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def smoother_response(
    omega: NDArray[np.float64], response: NDArray[np.complexfloating], delay: float
) -> Figure:
    """Draw a smoother's response from the measurement to the estimate, beside a pure delay's.

    Parameters
    ----------
    omega : (F,) array
        Angular frequencies, rad/s.
    response : (F,) array
        Complex.
    delay : float
        The lag, s.
    """
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(3.4, 3.0), sharex=True)
    (smoother,) = styles(["smoother"])
    top.loglog(omega, np.ones_like(omega), label="pure delay", **TRUTH)
    top.loglog(omega, np.abs(response), label="smoother", **smoother)
    top.set(ylabel="magnitude", ylim=(1e-2, 3.0))
    top.legend(loc="lower left")
    bottom.semilogx(omega, np.degrees(-omega * delay), **TRUTH)
    bottom.semilogx(omega, np.degrees(np.unwrap(np.angle(response))), **smoother)
    bottom.set_yticks(np.arange(-360, 1, 90))
    bottom.set(
        xlabel=r"angular frequency $\omega$ (rad/s)",
        ylabel="phase (°)",
        xlim=omega[[0, -1]],
        ylim=(-400.0, 20.0),
    )
    return figure
