"""The figures of a user's own system."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robsmooth.nonlinear import SamplePaths


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
    axes.plot(time, paths.w[0, :, 0], color="0.2", linewidth=1.0, ls="-", label="true")
    axes.plot(time, paths.filtered[0, :, 0], color="C1", ls="--", label="filtered")
    smoothed = paths.smoothed[0, :, 0]
    axes.plot(time - scale * paths.delay, smoothed, color="C0", ls="-", label="smoothed")
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
    axes.axvspan(*ends, color="0.9", linewidth=0)
    axes.plot(
        record.time[around], record.w[0, around, 0], color="0.2", lw=1.0, ls="-", label="true"
    )
    times = record.time[around] - record.delay
    axes.plot(times, estimates[around, 0], color="C0", ls="--", label="smoothed, from the record")
    axes.set(xlabel="time (s)", ylabel="angle (rad)", xlim=record.time[around][[0, -1]])
    figure.legend(loc="outside lower center", ncols=2)
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
    top.loglog(omega, np.abs(response), label="smoother")
    top.axhline(1.0, color="C1", linestyle="--", label="pure delay")
    top.set(ylabel="magnitude", ylim=(1e-2, 3.0))
    top.legend(loc="lower left")
    bottom.semilogx(omega, np.degrees(np.unwrap(np.angle(response))))
    bottom.semilogx(omega, np.degrees(-omega * delay))
    bottom.set(
        xlabel=r"angular frequency $\omega$ (rad/s)",
        ylabel="phase (°)",
        xlim=omega[[0, -1]],
        ylim=(-400.0, 20.0),
    )
    return figure
