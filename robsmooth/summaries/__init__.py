"""The tables of the notebooks."""

from robsmooth.summaries.beyond import study
from robsmooth.summaries.design import (
    approach_to_infimum,
    copy_noise,
    covariances,
    designs,
    parameters,
    sector_ranges,
    sign_readings,
)
from robsmooth.summaries.simulation import (
    change_needed,
    noise_sweep,
    noise_table,
    routes,
    routes_table,
    simulations,
)

__all__ = [
    "approach_to_infimum",
    "change_needed",
    "copy_noise",
    "covariances",
    "designs",
    "noise_sweep",
    "noise_table",
    "parameters",
    "routes",
    "routes_table",
    "sector_ranges",
    "sign_readings",
    "simulations",
    "study",
]
