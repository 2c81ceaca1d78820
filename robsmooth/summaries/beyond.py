"""Tables of what the paper leaves open."""

import numpy as np

from robsmooth.study import Study
from robsmooth.tables import Table


def study(found: Study, lag: float) -> Table:
    """Return the best lag for each sector and noise, and what it and a given one save."""
    ratio = found.ratio
    near = int(np.argmin(np.abs(np.log(np.array(found.lags) / lag))))
    rows = []
    for i, gamma in enumerate(found.gammas):
        for j, noise in enumerate(found.noises):
            if (gamma, noise) in found.failures or np.isnan(ratio[i, j]).all():
                rows.append((f"{gamma:g}", f"{noise:.3g}", *[None] * 6, "no design"))
                continue
            k, m = np.unravel_index(np.nanargmin(ratio[i, j]), ratio.shape[2:])
            at = (i, j, k, m)
            rows.append(
                (
                    f"{gamma:g}",
                    f"{noise:.3g}",
                    float(found.quantities["filtered"][at]),
                    float(found.quantities["smoothed"][at]),
                    float(1e6 * found.lags[m]),
                    str(found.orders[k]),
                    f"{100 * (1 - ratio[at]):.0f}%",
                    f"{100 * (1 - ratio[i, j, :, near].min()):.0f}%",
                    f"{np.nanmax(found.quantities['slip_rate'][i, j]):.2g}",
                )
            )
    return Table(
        columns=(
            r"$\gamma$",
            "shot noise",
            "filtered (rad²)",
            "smoothed (rad²)",
            "best lag (µs)",
            "order",
            "saved",
            f"saved at {1e6 * found.lags[near]:.2g} µs",
            "slips (1/s)",
        ),
        rows=rows,
        caption=(
            "The best lag and order of those studied for each sector and noise, and what smoothing "
            "saves there of the filtered error in the nonlinear loop."
        ),
        digits=3,
    )
