"""The tables of the notebooks."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from scipy.optimize import brentq

from robsmooth._support.notation import matrix as matrix
from robsmooth._support.tables import Table
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne import HomodyneParameters
from robsmooth.homodyne.loop import homodyne_loop, linearised
from robsmooth.paper import published
from robsmooth.simulation.statistics import MeanSquare


def estimate(found: MeanSquare) -> str:
    """Return a mean square and its standard error, to two significant digits of the error."""
    value, error = found.mean_square, found.standard_error
    if not 0.0 < error < math.inf:  # of one path, or none
        return "none" if math.isnan(value) else f"{value:.5g}"
    digits = max(0, 1 - int(f"{error:.1e}".partition("e")[2]))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def simulations(results: Mapping[str, Any], caption: str) -> Table:
    """Return the errors and slips of each `MonteCarloResult`."""
    records = []
    for name, found in results.items():
        smoothed = estimate(found.smoothed) if found.provenance["delay"] else None
        record = {"case": name, "filtered (rad²)": estimate(found.filtered)}
        record |= {"smoothed (rad²)": smoothed, "runs": found.runs, "cycle slips": found.slips}
        records.append(record | {"in how many runs": found.slipped_paths})
    return Table.of_records(records, caption)


def change_needed(smoother: Estimator, ngcf: Estimator, values: HomodyneParameters) -> Table:
    """Return the changes of single numbers of the loop that predict the printed errors."""
    designs = {"smoother": (smoother, "smoothed"), "NGCF": (ngcf, "filtered")}
    printed = {name: published.printed(f"error covariance, {name}") for name in designs}
    changes = ("power of the shot noise", "power of the phase noise", "detector gain")

    def excess(factor: float, change: str, name: str) -> float:
        shot, phase, gain = (factor if change == each else 1.0 for each in changes)
        design, output = designs[name]
        loop = homodyne_loop(replace(values, kappa=phase * values.kappa), design, shot_noise=shot)
        return getattr(linearised(replace(loop, gains=gain * loop.gains)), output) - printed[name]

    records, runs = [], published.printed("runs")
    for change in changes:
        factors = [brentq(excess, 0.7, 2.0, (change, name), xtol=1e-10) for name in designs]
        record: dict[str, Any] = {"changed": change}
        record |= zip(map("factor for the {}".format, designs), factors, strict=True)
        for name, target in printed.items():
            off = excess(sum(factors) / 2, change, name)
            # the standard error of a mean of `runs` squared Gaussian errors
            distance = off / (target * math.sqrt(2 / runs))
            record[f"{name} at the mean factor"] = f"{target + off:.4f} ({distance:+.1f})"
        records.append(record)
    caption = (
        "The factor on one number of the loop at which each printed error is predicted, and what "
        "is predicted (rad²) at the mean of the two factors. In brackets: how far off this is, in "
        f"standard errors of a simulation of {runs:.0f} runs."
    )
    return Table.of_records(records, caption)
