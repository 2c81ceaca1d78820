"""The tables of the notebooks."""

import math
from collections.abc import Mapping
from typing import Any

from robsmooth._support.notation import matrix as matrix
from robsmooth._support.tables import Table
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
