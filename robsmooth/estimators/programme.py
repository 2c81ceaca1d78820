r"""The estimator with the least certified error: a semidefinite programme.

Its inequalities are in `docs/source/methods.md`, with the letters of `least_certified`. What the
estimator knows, the copies' outputs and the states :math:`x_2` that they drive, is subtracted
first. No uncertainty may see these states.
"""

import warnings
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from robsmooth._numerics.modes import reaches
from robsmooth._support.validation import Matrix
from robsmooth.estimators.equations import DesignProblem
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem


class _Channel(NamedTuple):
    """An uncertainty, or a nonlinearity less its copy, scaled so that C has the norm one."""

    B: Matrix
    D: Matrix
    C: Matrix
    size: float  # C was divided by it, B and D multiplied
    constraint: int  # which of the k + 3g is its own
    copied: bool


def _channels(plant: AugmentedSystem) -> list[_Channel]:
    """Return the channels whose C is not zero, those of the uncertainties first."""
    problem, found = DesignProblem.of(plant, "smoothed"), []
    for i in range(plant.system.k + plant.system.g):
        inputs, C = problem.channels == i, problem.C1[problem.rows == i]
        size = float(np.linalg.norm(C))
        if size > 0.0:
            B, D = size * problem.B[:, inputs], size * problem.D[:, inputs]
            found.append(_Channel(B, D, C / size, size, i, i >= problem.k))
    return found


def copies_are_known(plant: AugmentedSystem) -> bool:
    """Return whether no uncertainty sees the states that the copies' outputs drive."""
    seen = np.vstack([np.zeros((0, plant.n)), *(c.C for c in _channels(plant) if not c.copied)])
    return not reaches(plant.A_p, plant.known[0], seen)


def least_certified(plant: AugmentedSystem) -> tuple[Estimator, np.ndarray]:
    """Return the estimator of C_a x with the least certified error, and theta, (k + 3g,).

    The plant is in natural units, with `copies_are_known`. Failure is an ArithmeticError.
    """
    import cvxpy as cp  # it takes long to import

    system, n, m, C_a = plant.system, plant.n, plant.system.m, plant.C_a
    A, B_w, C_2, D_w = plant.A_p, plant.B_p1[:, : system.q], plant.C2_tilde[: system.l], system.D21
    channels = _channels(plant)
    Z, X = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    F, L, K = cp.Variable((n, n)), cp.Variable((n, system.l)), cp.Variable((m, n))
    S = cp.Variable((system.q, system.q), symmetric=True)
    theta = [cp.Variable(nonneg=True) for _ in channels]
    arguments = {c.constraint: cp.Variable((1, n)) for c in channels if c.copied}  # times theta

    Q = np.zeros((n, n))
    # the columns right of the first two, and minus the diagonal below these
    right, diagonal = [(C_a.T - K.T, C_a.T)], [np.ones(m)]
    for weight, c in zip(theta, channels, strict=True):
        right.append((Z @ c.B, X @ c.B + L @ c.D))
        diagonal.append(weight * np.ones(c.B.shape[1]))
        if c.copied:
            right.append((weight * c.C.T - arguments[c.constraint].T, weight * c.C.T))
            diagonal.append(weight * np.ones(1))
        else:
            Q = Q + weight * (c.C.T @ c.C)
    measured = L @ C_2
    first = Z @ A + A.T @ Z + Q
    middle = Z @ A + A.T @ X + measured.T + F.T + Q
    second = X @ A + A.T @ X + measured + measured.T + Q
    upper, lower = (cp.hstack([column[row] for column in right]) for row in (0, 1))
    rest = -cp.diag(cp.hstack(diagonal))
    decay = cp.bmat([[first, middle, upper], [middle.T, second, lower], [upper.T, lower.T, rest]])
    in_Z, in_X = Z @ B_w, X @ B_w + L @ D_w
    energy = cp.bmat([[S, in_Z.T, in_X.T], [in_Z, Z, Z], [in_X, Z, X]])
    conditions = [decay << 0, energy >> 0]
    problem = cp.Problem(cp.Minimize(cp.trace(S)), conditions)
    with warnings.catch_warnings(), suppress(cp.SolverError):
        warnings.simplefilter("ignore")  # the certificate shows the accuracy
        problem.solve(solver=cp.CLARABEL)
    if Z.value is None:
        raise ArithmeticError(f"the solver found no estimator: {problem.status}")

    multipliers, rows = np.zeros(len(plant.M_i)), np.zeros((system.g, n))
    for weight, c in zip(theta, channels, strict=True):
        multipliers[c.constraint] = weight.value / c.size**2
        if c.copied:
            i = c.constraint - system.k
            argument = arguments[c.constraint].value[0] / weight.value
            rows[i] = c.size * argument / system.nonlinearities[i].lipschitz
    to_gains = np.linalg.inv(Z.value - X.value)
    A_c, gain = to_gains @ F.value, to_gains @ L.value
    return _with_copies(plant, A_c, gain, K.value, rows), multipliers


def _with_copies(
    plant: AugmentedSystem, A_c: Matrix, gain: Matrix, read: Matrix, arguments: Matrix
) -> Estimator:
    """Return the plant's estimator from that of the rest, with x_2 where copies drive a state."""
    n, m, l, g = plant.n, len(read), plant.system.l, len(arguments)  # noqa: E741
    B, D = plant.known
    B_c, C_c = np.hstack([gain, -gain @ D]), np.vstack([read, arguments])
    if B.any():
        A_c = np.block([[A_c, -gain @ plant.C2_tilde[:l]], [np.zeros((n, n)), plant.A_p]])
        B_c = np.vstack([B_c, np.hstack([np.zeros((n, l)), B])])
        C_c = np.hstack([C_c, np.vstack([plant.C_a, plant.C1_tilde[-2 * g :][:g]])])
    return Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=C_c[:m], C_f=C_c[:m])
