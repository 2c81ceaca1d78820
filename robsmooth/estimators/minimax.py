r"""The estimator with the least certified error: a semidefinite programme.

The plant with its delay model, in difference to what the estimator knows, is

.. math::

    dx = (A x + B_\xi\xi)\,dt + B_w\,dW,\quad dy = (C_2 x + D_\xi\xi)\,dt + D_w\,dW,\quad
    \mathrm E|\xi_s|^2 \le \mathrm E|C_{1s} x|^2 .

For an estimator :math:`d\hat x = A_c\hat x\,dt + B_c\,dy,\ \hat w = C_c\hat x` of the plant's
order, and multipliers :math:`\theta`, the mean square of :math:`w_a - \hat w` is certified to be at
most :math:`\operatorname{tr} W` by a Lyapunov function of both states. It is that of
`robsmooth.analysis_bound`, which is exact. The usual change of variables of robust filtering makes
the conditions linear in Z, X, F, L, K, :math:`\theta` and W:

.. math::

    \begin{bmatrix} W & * & * \\ ZB_w & Z & * \\ XB_w + LD_w & Z & X\end{bmatrix} > 0,

.. math::

    \begin{bmatrix}
    A'Z + ZA + Q & ZA + A'X + C_2'L' + F' + Q & ZB_\xi & C_a' - K'\\
    * & XA + A'X + LC_2 + C_2'L' + Q & XB_\xi + LD_\xi & C_a'\\
    * & * & -\Theta & 0\\
    * & * & * & -I
    \end{bmatrix} < 0

with :math:`Q = \sum_s\theta_s C_{1s}'C_{1s}`, and :math:`A_c = (Z-X)^{-1}F`,
:math:`B_c = (Z-X)^{-1}L`, :math:`C_c = K`. Noise need not enter through the uncertainty's channels.

**Copies.** The estimator knows the output :math:`\tilde\mu` of a copy. A nonlinearity is
:math:`\tilde\mu` and a rest, :math:`|\mu - \tilde\mu| \le \beta|\nu - \tilde\nu|`. What
:math:`\tilde\mu` does to the state, :math:`dx_2 = (A x_2 + \bar B\tilde\mu)\,dt`, and to the
measurement, is known and taken off. The programme is for the rest, in which a nonlinearity is a
channel whose argument is chosen: its output is :math:`\bar C x - \tilde\nu_1` with
:math:`\tilde\nu_1 = \tilde K\hat x/\theta`, which adds a row to the inequality. This is the limit
in which the multipliers of :math:`\mu` and of :math:`\tilde\mu` vanish.

References: J. C. Geromel, "Optimal linear filtering under parameter uncertainty", IEEE Trans. Signal
Process. 47(1), 1999; C. W. Scherer and I. E. Kose, "Robustness with dynamic IQCs: an exact
state-space characterization of nominal stability with applications to robust estimation",
Automatica 44(7), 2008.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix, frozen
from robsmooth.estimators.certificate import ConstraintProblem
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.units import Units


class NoSolution(ArithmeticError):
    """The solver found no solution of the programme."""


@dataclass(frozen=True, eq=False)
class _Channel:
    """An uncertainty of the programme, its output of norm one."""

    B: Matrix
    D: Matrix
    C: Matrix
    size: float  # by which its output was divided
    constraint: int  # which of the k + 3g it is in
    copied: bool


def _channels(plant: AugmentedSystem) -> list[_Channel]:
    """Return the channels that have an effect: of the uncertainties, then of the differences."""
    system, l = plant.system, plant.system.l
    columns = np.cumsum((0, *plant.input_sizes))
    rows = np.cumsum((0, *plant.output_sizes))
    found = []
    for i in range(system.k + system.g):
        copied = i >= system.k
        gain = system.nonlinearities[i - system.k].lipschitz if copied else 1.0
        C = gain * plant.C1_tilde[rows[i] : rows[i + 1]]
        size = float(np.linalg.norm(C))
        inputs = slice(columns[i], columns[i + 1])
        if size > 0.0:
            B, D = size * plant.B1_tilde[:, inputs], size * plant.D21_tilde[:l, inputs]
            found.append(_Channel(B, D, C / size, size, i, copied))
    return found


@dataclass(frozen=True, eq=False)
class _Solution:
    """The estimator that the programme gives, of the rest, and its multipliers."""

    A_c: Matrix
    B_c: Matrix
    C_c: Matrix
    arguments: Matrix  # of the copies that have an effect, (g, n)
    multipliers: np.ndarray  # (k + 3g,)
    mean_square: float


def _solve(plant: AugmentedSystem, C_a: Matrix) -> _Solution:
    """Solve the programme of the module docstring, for a plant in natural units."""
    import cvxpy as cp

    system, n, m = plant.system, plant.n, len(C_a)
    A, B_w, C_2, D_w = plant.A_p, plant.B_p1[:, : system.q], plant.C2_tilde[: system.l], system.D21
    channels = _channels(plant)
    Z, X = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    F, L, K = cp.Variable((n, n)), cp.Variable((n, system.l)), cp.Variable((m, n))
    W, theta = cp.Variable((system.q,) * 2, symmetric=True), cp.Variable(len(channels), nonneg=True)
    arguments = {c.constraint: cp.Variable((1, n)) for c in channels if c.copied}

    Q = np.zeros((n, n))
    # the columns to the right of the first two, and the diagonal below them
    right, diagonal = [(C_a.T - K.T, C_a.T)], [np.eye(m)]
    for weight, c in zip(theta, channels, strict=True):
        right.append((Z @ c.B, X @ c.B + L @ c.D))
        diagonal.append(weight * np.eye(c.B.shape[1]))
        if c.copied:
            right.append((weight * c.C.T - arguments[c.constraint].T, weight * c.C.T))
            diagonal.append(weight * np.eye(1))
        else:
            Q = Q + weight * (c.C.T @ c.C)
    measured = L @ C_2
    first = Z @ A + A.T @ Z + Q
    middle = Z @ A + A.T @ X + measured.T + F.T + Q
    second = X @ A + A.T @ X + measured + measured.T + Q
    border = [cp.hstack([column[row] for column in right]) for row in (0, 1)]
    below = _block_diagonal(diagonal)
    decay = cp.bmat(
        [
            [first, middle, border[0]],
            [middle.T, second, border[1]],
            [border[0].T, border[1].T, -below],
        ]
    )
    in_Z, in_X = Z @ B_w, X @ B_w + L @ D_w
    energy = cp.bmat([[W, in_Z.T, in_X.T], [in_Z, Z, Z], [in_X, Z, X]])
    problem = cp.Problem(cp.Minimize(cp.trace(W)), [_symmetric(decay) << 0, _symmetric(energy) >> 0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an answer that is inaccurate has no certificate
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError as error:
            raise NoSolution(str(error)) from None
    if Z.value is None:
        raise NoSolution(problem.status)
    multipliers = np.zeros(len(plant.M_i))
    for weight, c in zip(theta.value, channels, strict=True):
        multipliers[c.constraint] = weight / c.size**2
    into = np.linalg.inv(Z.value - X.value)
    gain = into @ L.value
    read = np.zeros((system.g, n))
    for weight, c in zip(theta.value, channels, strict=True):
        if c.copied:
            row = c.constraint - system.k
            read[row] = arguments[c.constraint].value * c.size / weight / system.nonlinearities[row].lipschitz
    return _Solution(into @ F.value, gain, K.value, read, multipliers, float(problem.value))


def _symmetric(matrix):
    return (matrix + matrix.T) / 2


def _block_diagonal(blocks):
    import cvxpy as cp

    sizes = [block.shape[0] for block in blocks]
    return cp.bmat(
        [
            [block if i == j else np.zeros((sizes[i], sizes[j])) for j in range(len(blocks))]
            for i, block in enumerate(blocks)
        ]
    )
