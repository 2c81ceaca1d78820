"""The figures of what the paper leaves open."""

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from robsmooth.study import Study


def where_smoothing_pays(study: Study, gamma: float, lag: float) -> Figure:
    """Draw what smoothing saves of the filtered error, over lag and noise, and for each order.

    Parameters
    ----------
    study : Study
    gamma : float
        Of the sector, one of the study's.
    lag : float
        To mark, s.
    """
    i = study.gammas.index(gamma)
    ratio = study.ratio[i]
    floor = (study.quantities["optimal"] / study.quantities["filtered"])[i]
    lags = 1e6 * np.array(study.lags)
    middle = int(np.argmin(np.abs(np.log(study.noises))))
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(3.4, 4.6), sharex=True)

    levels = np.arange(0, 61, 10)
    colours = mpl.colormaps["cividis"].with_extremes(under="0.85")
    saved = 100 * (1 - ratio[:, -1])
    shading = top.contourf(lags, study.noises, saved, levels, extend="min", cmap=colours)
    top.contour(lags, study.noises, saved, [0], colors="k", linewidths=1.0)
    best = np.nanargmin(ratio[:, -1], axis=1)
    top.plot(lags[best], study.noises, "o", color="w", markeredgecolor="k", markersize=4, ls="none")
    top.plot(1e6 * lag, study.noises[middle], "*", color="C1", markeredgecolor="k", markersize=9)
    top.set(xscale="log", yscale="log", ylabel="shot noise, relative to the paper's")
    least, most = study.noises[0], study.noises[-1]
    levels = [level for level in (0.1, 0.3, 1, 3, 10) if least <= level <= most]
    top.set_yticks(levels, [f"{level:g}" for level in levels])
    top.minorticks_off()
    top.grid(visible=False)
    figure.colorbar(shading, ax=top, label="saved by smoothing (%)", pad=0.02)

    for order, values in zip(study.orders, ratio[middle], strict=True):
        bottom.plot(lags, values, label=f"order {order}")
    bottom.plot(lags, floor[middle, -1], color="0.4", linestyle=":", label="optimum, linear")
    bottom.axhline(1.0, color="k", linestyle="-", linewidth=0.6)
    bottom.axvline(1e6 * lag, color="C1", linestyle="--", linewidth=0.8)
    bottom.set(
        xlabel="lag (µs)", ylabel="smoothed / filtered error", ylim=(0.4, 1.6), xlim=lags[[0, -1]]
    )
    bottom.legend(loc="upper left")
    ticks = [tick for tick in (0.3, 1, 3, 10, 30) if lags[0] <= tick <= lags[-1]]
    bottom.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    bottom.minorticks_off()
    return figure
