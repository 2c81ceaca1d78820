"""Limiting designs of all kinds: which multipliers vanish, and how fast."""

from dataclasses import replace

import numpy as np

from robsmooth import InfeasibleDesignError, Uncertainty, augment
from robsmooth.estimators.conditions import multiplier_level
from robsmooth.estimators.limit import limiting_smoother
from tests.helpers.strategies import random_system


def limit_of(plant, zero, cost="filtered", rates=None, seed=0):
    """A limiting design at random multipliers, about the least tau that is feasible."""
    rng = np.random.default_rng(seed)
    multipliers = rng.uniform(0.3, 1.0, len(plant.M_i))
    multipliers[plant.system.k + plant.system.g :] *= 0.3
    multipliers[list(zero)] = 0.0
    multipliers *= 0.9 / multiplier_level(plant, multipliers)
    for tau in np.geomspace(0.3, 1e3, 20):
        try:
            return limiting_smoother(plant, tau, multipliers, cost, rates=rates)
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


def cascade(seed):
    """A plant with X0 and b different from zero: uncertainty drives what vanishing noise enters."""
    system = random_system(np.random.default_rng(seed), n=3, m=1, measurements=2, g=3)
    A = np.array(system.A)
    A[0, 1:] = 0.0
    first, second, third = system.nonlinearities
    return augment(
        replace(
            system,
            A=A,
            uncertainties=[Uncertainty(u.B, u.C * [1, 0, 0], u.D) for u in system.uncertainties],
            nonlinearities=[
                replace(first, B=first.B * [[0], [1], [1]]),
                replace(second, B=second.B * [[0], [1], [1]]),
                replace(third, C=third.C * [1, 0, 0]),
            ],
        ),
        0.5,
        1,
    )


CASES = {
    "a nonlinearity that enters the state": (observer_plant(1), [3, 4], None),
    "one measurement": (observer_plant(2, measurements=1), [3, 4], [0, 0, 0, 1.0, 0.2]),
    "two at different rates": (observer_plant(3, g=2), [4, 5, 6, 7], [0, 0, 0, 0, 1, 3, 0.5, 2]),
    "one of two": (observer_plant(3, g=2, B=0.0), [4, 6], None),
    "with uncertainty": (observer_plant(7, g=2, C=0.1, B=0.0), [4, 6], None),
    "cascade": (cascade(1), [5, 6, 8, 9], [0, 0, 0, 0, 0, 1.0, 0.4, 0, 0.7, 1.5, 0]),
    "difference and nonlinearity": (observer_plant(6), [2, 3], None),
    "difference and copy": (observer_plant(4, B=0.0), [2, 4], None),
    "all of a nonlinearity": (observer_plant(6, measurements=1), [2, 3, 4], [0, 0, 1.0, 2.0, 0.5]),
    "an uncertainty of the measurement": (observer_plant(6, C=0.5), [1], None),
}
