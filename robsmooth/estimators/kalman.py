"""The gain of the Kalman-Bucy filter, or why there is none."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from robsmooth._numerics.lyapunov import check_certainty, covariances
from robsmooth._numerics.modes import natural_units
from robsmooth._numerics.riccati import RiccatiError, solve_riccati
from robsmooth._support import notation
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.systems.augmented import check_noise
from robsmooth.systems.delay import DelayModel, pade_delay
from robsmooth.systems.system import UncertainSystem

_LOST = 1e-8  # of a mode, relative: less is rounding


def kalman_gain(system: UncertainSystem, model: DelayModel | None = None) -> tuple[Matrix, Matrix]:
    """Return covariance and gain of the Kalman-Bucy filter, with a delay model behind it.

    The covariance is that of the errors of x and of the model's state with the error of x. Only the
    gain of the Riccati solution is used: the covariance that follows from a gain is not negative,
    and its error is that of the gain squared (Kleinman's step, in Joseph's form). The model needs
    no Riccati equation: no measurement sees it, and it does not feed back.
    """
    A, B, C, D = system.A, system.B1, system.C2, system.D21
    check_noise("The Kalman-Bucy filter's condition D21 D21' > 0", D)
    R, cross = cho_factor(D @ D.T), B @ D.T
    uncorrelated, over_R = B - cross @ cho_solve(R, D), cho_solve(R, C)
    try:
        P = solve_riccati((A - cross @ over_R).T, uncorrelated @ uncorrelated.T, C.T @ over_R).X
    except RiccatiError as error:
        condition = "The Kalman-Bucy filter's Riccati equation"
        raise InfeasibleDesignError(condition, _reason(system) or str(error)) from None
    gain = cho_solve(R, C @ P + cross.T).T
    model = model or pade_delay(0.0, 0, system.m)
    states = len(model.F)
    drift = np.block([[A - gain @ C, np.zeros((system.n, states))], [model.G @ system.C0, model.F]])
    noise = np.vstack([B - gain @ D, np.zeros((states, system.q))])
    found, x = covariances(drift, noise), slice(system.n)
    check_certainty("the filter's error", found.stationary[x, x], found.error[x, x])
    P = found.stationary[:, x]
    cross = np.vstack([cross, np.zeros((states, system.l))])
    return P, cho_solve(R, (P @ C.T + cross).T).T


def _reason(system: UncertainSystem) -> str | None:
    """Return which mode has no stable filter, if there is one."""
    A, B, C, D = system.A, system.B1, system.C2, system.D21
    x, y = natural_units(A, B), np.linalg.norm(D, axis=1)[:, None]
    A, B, C, D = A / x[:, None] * x, B / x[:, None], C / y * x, D / y
    hidden = _hidden_mode(A, C, x, marginal=False)
    if hidden:
        return f"{hidden} does not decay, and no measurement sees it"
    through = B @ np.linalg.pinv(D)  # the process noise that the measurement shows
    hidden = _hidden_mode((A - through @ C).T, (B - through @ D).T, 1.0 / x, marginal=True)
    what = "neither decays nor is driven by noise, so that a filter's gain goes to zero in time"
    return f"{hidden} {what}; give it a noise in B1, however small" if hidden else None


def _hidden_mode(A: Matrix, C: Matrix, units: Matrix, marginal: bool) -> str | None:
    """Return which mode does not decay and C does not see it; `units` are those of its states."""
    size = np.linalg.norm(A) or np.linalg.norm(C) or 1.0
    for pole in np.linalg.eigvals(A):
        if pole.real < -_LOST * size or (marginal and pole.real > _LOST * size):
            continue
        both = np.vstack([A - pole * np.eye(len(A)), C * size / (np.linalg.norm(C) or 1.0)])
        _, sizes, directions = np.linalg.svd(both)
        if sizes[-1] <= _LOST * size:
            direction = units * directions[-1].conj()
            direction = direction / direction[np.abs(direction).argmax()]
            shown = notation.array(direction.real if np.isreal(pole) else direction.round(4))
            value = f"{pole.real:.4g}" if np.isreal(pole) else f"{pole:.4g}"
            return f"the mode with the eigenvalue {value} 1/s and the direction {shown}"
    return None
