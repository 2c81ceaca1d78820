r"""Descent on an error over all linear estimators of a given order.

The variables are the drift, the measurement's gain, the copies' arguments and the read-out of the
estimate of (eqcontrol). The copies' outputs are subtracted from the measurement where the
nonlinearities enter it, so that a reference in both arguments has no effect. The search is in
coordinates in which the covariance of the estimator's states is the identity.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError
from scipy.optimize import minimize

from robsmooth._numerics.schur import SchurForm
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import matrices
from robsmooth.systems.augmented import padded

_REFUSED = 1e2  # more than the logarithm of any error in natural units
_GRADIENT = 1e-9  # of the logarithm, at the end of a search
_ITERATIONS = 400


class Slopes(NamedTuple):
    """The gradient of an error in the matrices of `OpenLoop`."""

    A: Matrix
    B: Matrix
    inputs: Matrix
    outputs: Matrix
    estimate: Matrix

    def of_estimator(self, estimator: Estimator) -> np.ndarray:
        """Return the gradient in `variables`."""
        plant = estimator.plant
        n, m, own = plant.n, plant.system.m, slice(plant.n, None)
        drift = self.A[own, own]
        gain = (
            self.A[own, :n] @ plant.C2_tilde.T
            + self.B[own] @ padded(plant.system.D21, *plant.D21_bar.shape).T
            + self.inputs[own] @ plant.D21_tilde.T
        )
        arguments = (plant.D12_tilde.T @ self.outputs[:, own])[m:]
        measured, copied = np.hsplit(gain, [plant.system.l])
        gain = measured - copied @ plant.known[1].T
        parts = (drift, gain, arguments, self.estimate[:, own])
        return np.concatenate([part.ravel() for part in parts])


def variables(estimator: Estimator) -> np.ndarray:
    """Return drift, gains, the copies' arguments and the read-out as one array."""
    return np.concatenate([part.ravel() for part in _parts(estimator)])


def _parts(estimator: Estimator) -> tuple[Matrix, ...]:
    system = estimator.plant.system
    return estimator.A_c, estimator.B_c[:, : system.l], estimator.C_c[system.m :], estimator.C_a


def with_variables(estimator: Estimator, x: np.ndarray) -> Estimator:
    """Return the estimator with these variables; its C_c and C_a read the same estimate."""
    parts = _parts(estimator)
    ends = np.cumsum([part.size for part in parts])[:-1]
    A_c, gain, arguments, C_a = (
        values.reshape(part.shape).copy()
        for values, part in zip(np.split(x, ends), parts, strict=True)
    )
    plant = estimator.plant
    copies = estimator.B_c[:, plant.system.l :] + (parts[1] - gain) @ plant.known[1]
    B_c, C_c = np.hstack([gain, copies]), np.vstack([C_a, arguments])
    return replace(estimator, A_c=A_c, B_c=B_c, C_c=C_c, C_a=C_a)


def descend(
    estimator: Estimator,
    objective: Callable[[Estimator, np.ndarray], tuple[float, np.ndarray]],
    more: np.ndarray | tuple[()] = (),
) -> tuple[Estimator, np.ndarray, float]:
    """Return an estimator with a lower objective, its `more` variables, and the objective.

    The objective returns a logarithm and its gradient in `variables` and `more`. It raises an
    ArithmeticError or LinAlgError where it has no value.
    """
    A, B, _, _ = matrices(estimator, "real")
    covariance = SchurForm(A).lyapunov(B @ B.T)[estimator.plant.n :, estimator.plant.n :]
    sizes, directions = np.linalg.eigh(covariance)
    sizes = np.sqrt(np.maximum(sizes, 1e-14 * sizes.max()))
    estimator = estimator.in_coordinates((directions / sizes).T, directions * sizes)
    start = np.concatenate([variables(estimator), more])
    own = len(start) - len(more)

    def value(x: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            return objective(with_variables(estimator, x[:own]), x[own:])
        except (ArithmeticError, LinAlgError):
            return _REFUSED, np.zeros_like(x)

    options = {"maxiter": _ITERATIONS, "gtol": _GRADIENT}
    found = minimize(value, start, jac=True, method="BFGS", options=options)
    return with_variables(estimator, found.x[:own]), found.x[own:], float(found.fun)
