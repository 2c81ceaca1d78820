"""The tables of the notebooks."""

from robsmooth._support.notation import matrix
from robsmooth._support.tables import Table
from robsmooth.paper.tables.beyond import gains, lag_choices, optima, side_by_side, study, tightness
from robsmooth.paper.tables.design import (
    approach_to_infimum,
    copy_noise,
    covariances,
    designs,
    sector_ranges,
    sign_readings,
)
from robsmooth.paper.tables.own import in_units, own_systems, refusals
from robsmooth.paper.tables.simulation import (
    change_needed,
    noise_sweep,
    noise_table,
    routes,
    routes_table,
    simulations,
)

__all__ = [
    "Table",
    "approach_to_infimum",
    "change_needed",
    "copy_noise",
    "covariances",
    "designs",
    "gains",
    "in_units",
    "lag_choices",
    "matrix",
    "noise_sweep",
    "noise_table",
    "optima",
    "own_systems",
    "refusals",
    "routes",
    "routes_table",
    "sector_ranges",
    "side_by_side",
    "sign_readings",
    "simulations",
    "study",
    "tightness",
]
