r"""The equations of the design (Section III), for all that solves them.

With :math:`M = \tilde M(\lambda)`, :math:`N = \tilde N(\lambda)` and
:math:`E_\lambda = \tilde D_{21} M^{-1} \tilde D_{21}'`, which the paper uses but does not define
(it is in Petersen, Ugrinovskii and Savkin, *Robust Control Design Using H-infinity Methods*), the
paper has

.. math::

    R &= C'C + \tau \tilde C_1' N \tilde C_1, \qquad
    G = \begin{bmatrix} I_m & 0\\ 0 & 0\end{bmatrix} + \tau \tilde D_{12}' N \tilde D_{12}, \qquad
    \Gamma = -[C'\; 0] + \tau \tilde C_1' N \tilde D_{12},\\
    0 &= A_Y Y + Y A_Y' - Y(\tilde C_2' E_\lambda^{-1} \tilde C_2 - R/\tau) Y
         + \tilde B_1 (M^{-1} - M^{-1}\tilde D_{21}' E_\lambda^{-1} \tilde D_{21} M^{-1})
         \tilde B_1', \quad
         A_Y = A_p - \tilde B_1 M^{-1} \tilde D_{21}' E_\lambda^{-1} \tilde C_2,\\
    0 &= X A_p + A_p' X + (R - \Gamma G^{-1} \Gamma')
         + \tfrac{1}{\tau} X \tilde B_1 M^{-1} \tilde B_1' X,

where `C` is :math:`C_{p0}` when the cost is on the filtered error, as in the paper's example, and
:math:`C_a` when it is on the smoothed error, as in its text. Two slips of the printed equations are
put right here: the constant term of the second Riccati equation, and :math:`A_c = A_p + \dots`, not
:math:`A + \dots`. The Y equation is the paper's with its inner signs kept; the quadratic term of
the X equation has the sign as printed (the paper's numbers follow from the other one, see
`robsmooth.paper.published`).

Only between a nonlinearity and its copy have :math:`M(\lambda)` and :math:`N(\lambda)` entries off
their diagonals. With d, o and c the multipliers of the difference, of the nonlinearity's own
constraint and of its copy's, the squares are completed there:

.. math::

    d(\mu - \tilde\mu)^2 + o\mu^2 + c\tilde\mu^2 &= e(\mu - a\tilde\mu)^2
      + \tfrac{d + c}{e}f\,\tilde\mu^2, & a &= \tfrac{d}{d + o},\quad e = d + o,\\
    d(\nu - \tilde\nu)^2 + o\nu^2 + c\tilde\nu^2 &= (d + c)(\tilde\nu - b\nu)^2 + f\nu^2, &
      b &= \tfrac{d}{d + c},\quad f = o + \tfrac{dc}{d + c}.

The estimator has the copy's output :math:`\tilde\mu` without noise: :math:`a\tilde\mu` is a known
input to it, and what is left of :math:`\mu`, of weight e, is the noise of the Y equation. The
copy's argument is the estimator's to choose: :math:`b\nu` if it knew the state, which leaves the
weight f in the X equation, where the noise is 1/f, too. Nothing cancels in e and f.

With the channels of uncertainties and nonlinearities side by side in B, D and
:math:`C_1 = [C_{1,s};\ \beta_i\bar C_{1,i}]`, and the weights :math:`\Lambda_Y` and
:math:`\Lambda_X`, which are :math:`\lambda_s` and then e and f, the equations above are

.. math::

    R &= C'C + \tau C_1'\Lambda_Y C_1,\qquad E = D\Lambda_Y^{-1}D',\qquad L = B\Lambda_Y^{-1}D',\\
    0 &= (A_p - LE^{-1}C_2)Y + Y(A_p - LE^{-1}C_2)' - Y(C_2'E^{-1}C_2 - R/\tau)Y
         + B\Lambda_Y^{-1}B' - LE^{-1}L',\\
    0 &= XA_p + A_p'X + \tau C_1'\Lambda_X C_1 + \tfrac1\tau XB\Lambda_X^{-1}B'X,

with l rows of measurements in the place of l + g. (eqCparams) and (eqbound) become

.. math::

    K &= (YC_2' + L)E^{-1},\qquad T = (I - YX/\tau)^{-1},\qquad
         U = KEK' + B(\Lambda_X^{-1} - \Lambda_Y^{-1})B',\\
    \tilde B_c &= [K,\ (\bar B_1 - K\bar D_{21})a],\qquad \tilde C_c = [C;\ b\bar C_1]T,\qquad
    A_c = A_p - KC_2 + Y(R + \Gamma\tilde C_c)/\tau,\\
    V &= \tfrac12\operatorname{tr}(YR + UXT).

Where some multipliers are zero and M is singular, the equations are those of the limit
(`robsmooth.estimators.limit`).
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from robsmooth._numerics.lyapunov import square_root
from robsmooth._numerics.riccati import RiccatiSolution, solve_riccati
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.problem import DesignProblem

Equation = tuple[Matrix, Matrix, Matrix]  # the A, Q and S of A'Z + ZA + Q - ZSZ = 0


class Weights(NamedTuple):
    """What the equations need of the multipliers of k uncertainties and g nonlinearities."""

    a: np.ndarray  # (g,) the shares of the copies' outputs ...
    b: np.ndarray  # (g,) ... and of their arguments
    Y: np.ndarray  # (k + g,) lambda_s, then e
    X: np.ndarray  # (k + g,) lambda_s, then f
    rates: np.ndarray  # (k + g,) how fast those of the X equation grow as a limit is left

    @classmethod
    def of(cls, k: int, multipliers: np.ndarray, rates: np.ndarray) -> "Weights":
        """Return the weights; where neither d nor c is left, b depends on the rates alone."""
        both = np.array([multipliers, rates])
        d, o, c = np.moveaxis(both[:, k:].reshape(2, 3, -1), 1, 0)
        pair = np.where(d[0] + c[0] > 0.0, (d[0], c[0]), (d[1], c[1]))
        a, b, rest = _share((d[0], *pair), (o[0], *pair[::-1]))
        X, fast = np.hstack([both[:, :k], rest**2 * d + o + b**2 * c])
        return cls(a, b, np.concatenate([multipliers[:k], d[0] + o[0]]), X, fast)


def _share(parts: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> np.ndarray:
    """Return part/(part + other), zero where both are."""
    total = np.add(parts, others)
    return np.divide(parts, total, out=np.zeros_like(total), where=total > 0.0)


class DesignEquations:
    """The equations at one tau and lambda; `rates` say how fast zeros are approached in a limit."""

    def __init__(
        self, problem: DesignProblem, tau: float, multipliers: np.ndarray, rates: np.ndarray
    ) -> None:
        self.problem, self.tau, self.multipliers = problem, tau, multipliers
        self.weights = Weights.of(problem.k, multipliers, rates)
        self.R = problem.C.T @ problem.C + self._output_cost(self.weights.Y)
        self.Q_X = self._output_cost(self.weights.X)  # R - Gamma G^{-1} Gamma'
        # Diagonals of Lambda_Y^{-1}, Lambda_X^{-1}; zero for noise without bound, and its size.
        self.noise_Y = _inverse(self.weights.Y)[problem.channels]
        self.noise_X = _inverse(self.weights.X)[problem.channels]
        fast = _inverse(self.weights.rates)[problem.channels]
        self.unbounded_noise = np.where(problem.unbounded, fast, 0.0)
        _, B, _, D = problem.of_Y
        self.E = D * self.noise_Y @ D.T
        self.L = B * self.noise_Y @ D.T
        self.worst_noise = problem.B * self.noise_X @ problem.B.T  # B1_tilde M^{-1} B1_tilde'

    @cached_property
    def over_E(self) -> tuple[Matrix, Matrix]:
        """(l, n) E^{-1} C2 and E^{-1} L'."""
        _, _, C2, _ = self.problem.of_Y
        return tuple(np.hsplit(np.linalg.solve(self.E, np.hstack([C2, self.L.T])), 2))

    @property
    def equation_Y(self) -> Equation:
        """The first Riccati equation of Assumption 3."""
        A, B, C2, _ = self.problem.of_Y
        information, gain = self.over_E
        return (
            (A - self.L @ information).T,
            B * self.noise_Y @ B.T - self.L @ gain,
            C2.T @ information - self.R / self.tau,
        )

    def equation_X(self, quadratic_sign: float = 1.0) -> Equation:
        """Return the second Riccati equation of Assumption 3; the theory has `quadratic_sign` 1."""
        return self.problem.A, self.Q_X, -quadratic_sign / self.tau * self.worst_noise

    def equation_of_slope(self, X: Matrix) -> Equation:
        """Return the equation of x, how fast X grows as a limit is left."""
        B = self.problem.B
        A = self.problem.A + self.worst_noise @ X / self.tau
        return A, self._output_cost(self.weights.rates), -B * self.unbounded_noise @ B.T / self.tau

    def solve_Y(self) -> RiccatiSolution:
        """Return the solution of the first Riccati equation."""
        return solve_riccati(*self.equation_Y)

    def solve_X(self, quadratic_sign: float = 1.0) -> RiccatiSolution:
        """Return the solution of the second one."""
        return solve_riccati(*self.equation_X(quadratic_sign))

    def solution(self, X: Matrix, Y: Matrix) -> tuple[Matrix, Matrix, Matrix, float, float]:
        """Return K, U, T, V and rho(YX), which must be below tau."""
        # inv(I - Y X/tau), symmetric inside: no digit of it depends on the units of the states
        root = square_root(Y)
        radii, directions = np.linalg.eigh(root.T @ X @ root)
        radius = float(np.abs(radii).max())
        if not radius < self.tau:
            raise InfeasibleDesignError(
                "Assumption 3.3",
                f"rho(YX) = {radius:.4g} is not below tau = {self.tau:.4g}; a larger tau may help",
            )
        root = root @ directions
        T = np.eye(len(X)) + root / (self.tau - radii) @ root.T @ X
        information, gain = self.over_E
        K = Y @ information.T + gain.T
        a, b, *_ = self.weights
        copies = self.problem.channels >= self.problem.k
        B, excess = self.problem.B[:, copies], a * b * self.noise_X[copies]  # 1/f - 1/e
        U = K @ self.E @ K.T + B * excess @ B.T
        return K, U, T, 0.5 * float(np.trace(Y @ self.R + U @ X @ T)), radius

    def gains(self, X: Matrix, Y: Matrix) -> tuple[Matrix, Matrix, Matrix, float, float]:
        """Return A_c, B_c and C_c of (eqCparams), V of (eqbound), and rho(YX)."""
        problem, (a, b, *_) = self.problem, self.weights
        A, _, C2, _ = problem.of_Y
        K, _, T, bound, radius = self.solution(X, Y)
        arguments = problem.C1[problem.rows >= problem.k] / problem.lipschitz[:, None]
        difference = self.tau * problem.lipschitz**2 * np.split(self.multipliers[problem.k :], 3)[0]
        Gamma = -np.hstack([problem.C.T, arguments.T * difference])
        C_c = np.vstack([problem.C, b[:, None] * arguments]) @ T
        A_c = A - K @ C2 + Y @ (self.R + Gamma @ C_c) / self.tau
        K = K @ problem.combinations.T + problem.known
        copies = (problem.B - K @ problem.D)[:, problem.channels >= problem.k] * a
        return A_c, np.hstack([K, copies]), C_c, bound, radius

    def _output_cost(self, weights: np.ndarray) -> Matrix:
        """Return tau C1' Lambda C1."""
        C1 = self.problem.C1
        return self.tau * (C1.T * weights[self.problem.rows] @ C1)


def _inverse(weights: np.ndarray) -> np.ndarray:
    """Return one over each weight, zero where it is zero."""
    return np.divide(1.0, weights, out=np.zeros_like(weights), where=weights > 0.0)
