"""Limiting designs of all kinds: which multipliers vanish."""

from dataclasses import replace

import numpy as np

from robsmooth import InfeasibleDesignError, Uncertainty, augment
from robsmooth.estimators.conditions import multiplier_level
from robsmooth.estimators.smoother import limiting_smoother
from tests.helpers.strategies import random_system


def limit_of(plant, zero, cost="filtered", seed=0):
    """A limiting design at random multipliers, about the least tau that is feasible."""
    rng = np.random.default_rng(seed)
    multipliers = rng.uniform(0.3, 1.0, len(plant.M_i))
    multipliers[plant.system.k + plant.system.g :] *= 0.3
    multipliers[list(zero)] = 0.0
    multipliers *= 0.9 / multiplier_level(plant, multipliers)
    for tau in np.geomspace(0.3, 1e3, 20):
        try:
            return limiting_smoother(plant, tau, multipliers, cost)
        except InfeasibleDesignError:
            continue
    raise AssertionError("no limiting design found")


def observer_plant(seed, g=1, measurements=2, C=0.0, B=1.0):
    """A plant with little or no uncertainty but that of its nonlinearities."""
    system = random_system(np.random.default_rng(seed), n=2, m=1, measurements=measurements, g=g)
    return augment(
        replace(
            system,
            uncertainties=[Uncertainty(u.B, C * u.C, u.D) for u in system.uncertainties],
            nonlinearities=[replace(c, B=B * c.B) for c in system.nonlinearities],
        ),
        0.5,
        1,
    )


CASES = {
    "one measurement": (observer_plant(2, measurements=1, B=0.0), [3, 4]),
    "both of two": (observer_plant(3, g=2, B=0.0), [4, 5, 6, 7]),
    "one of two": (observer_plant(3, g=2, B=0.0), [4, 6]),
    "with uncertainty": (observer_plant(7, g=2, C=0.1, B=0.0), [4, 6]),
}
