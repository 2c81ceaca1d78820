"""The gain of the Kalman-Bucy filter, and estimators that are a model and a gain."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from robsmooth._numerics.lyapunov import check_certainty, covariances
from robsmooth._numerics.riccati import RiccatiError, solve_riccati
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem, check_noise
from robsmooth.systems.delay import DelayModel
from robsmooth.systems.system import UncertainSystem


def kalman_gain(system: UncertainSystem, model: DelayModel) -> tuple[Matrix, Matrix]:
    """Return covariance and gain of the Kalman-Bucy filter of a system with a delay model behind.

    The covariance is that of the errors of x and of the model's state with the error of x. Of the
    Riccati solution only the gain is used: a covariance that follows from the gain cannot be
    negative, and its own error is that of the gain squared (Kleinman's step, in Joseph's form). As
    no measurement sees the model, nor does the model feed back, it needs no equation of its own.
    """
    A, B, C, D = system.A, system.B1, system.C2, system.D21
    check_noise("The Kalman-Bucy filter's condition D21 D21' > 0", D)
    R, cross = cho_factor(D @ D.T), B @ D.T
    uncorrelated = B - cross @ cho_solve(R, D)
    try:
        P = solve_riccati(
            (A - cross @ cho_solve(R, C)).T, uncorrelated @ uncorrelated.T, C.T @ cho_solve(R, C)
        ).X
    except RiccatiError as error:
        condition = "The Kalman-Bucy filter's Riccati equation"
        raise InfeasibleDesignError(condition, str(error)) from None
    gain = cho_solve(R, C @ P + cross.T).T
    states = len(model.F)
    drift = np.block([[A - gain @ C, np.zeros((system.n, states))], [model.G @ system.C0, model.F]])
    noise = np.vstack([B - gain @ D, np.zeros((states, system.q))])
    found, x = covariances(drift, noise), slice(system.n)
    check_certainty("the filter's error", found.stationary[x, x], found.error[x, x])
    P = found.stationary[:, x]
    cross = np.vstack([cross, np.zeros((states, system.l))])
    return P, cho_solve(R, (P @ C.T + cross).T).T


def with_copies(
    plant: AugmentedSystem, A_c: Matrix, gain: Matrix, C_w: Matrix, copies: bool = False
) -> Estimator:
    """Return an estimator of w = C_w x that runs the nonlinearities at its estimate, or not."""
    B, C, D = plant.system.stacked(plant.system.nonlinearities)
    states = plant.n - plant.system.n
    into, arguments = np.pad(B, ((0, states), (0, 0))) - gain @ D, np.pad(C, ((0, 0), (0, states)))
    if not copies:
        into, arguments = np.zeros_like(into), np.zeros_like(arguments)
    B_c, C_c = np.hstack([gain, into]), np.vstack([C_w, arguments])
    return Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=plant.C_a, C_f=C_w)
