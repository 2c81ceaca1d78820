"""Estimators that are a model and a gain: the classical fixed-lag smoother."""

import numpy as np

from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.kalman import kalman_gain
from robsmooth.systems.augmented import AugmentedSystem


def classical(plant: AugmentedSystem, copies: bool = False) -> Estimator:
    """Return the classical fixed-lag smoother of a plant's nominal system."""
    _, gain = kalman_gain(plant.system, plant.delay_model)
    A_c = plant.A_p - gain @ plant.C2_tilde[: plant.system.l]
    nominal = plant.system.nominal
    return with_copies(plant, A_c, gain, copies).of_nominal(nominal, nominal)


def with_copies(plant: AugmentedSystem, A_c: Matrix, gain: Matrix, copies: bool) -> Estimator:
    """Return an estimator of w that runs the nonlinearities at its estimate, or not."""
    B, D = plant.known
    _, C, _ = plant.system.stacked(plant.system.nonlinearities)
    into, arguments = B - gain @ D, np.pad(C, ((0, 0), (0, plant.n - plant.system.n)))
    if not copies:
        into, arguments = np.zeros_like(into), np.zeros_like(arguments)
    B_c, C_c = np.hstack([gain, into]), np.vstack([plant.C_p0, arguments])
    return Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=plant.C_a, C_f=plant.C_p0)
