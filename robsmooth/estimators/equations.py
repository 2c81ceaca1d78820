r"""The equations of the design: Assumption 3, (eqCparams) and (eqbound) of Section III.

The squares of a nonlinearity and its copy are completed, so that nothing cancels as multipliers
vanish; `docs/source/methods.md` has the equations with the letters of the code. Where the noise 1/f
does not enter the state it is left out: these are the equations of the limit. The quadratic term of
the X equation has the printed sign; the paper's numbers follow from the other one
(`robsmooth.paper.published`).
"""

from typing import NamedTuple

import numpy as np

from robsmooth._numerics.lyapunov import square_root
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.systems.augmented import AugmentedSystem

Equation = tuple[Matrix, Matrix, Matrix]  # the A, Q and S of A'Z + ZA + Q - ZSZ = 0


class DesignProblem(NamedTuple):
    """The data of the equations, for all tau and lambda."""

    A: Matrix  # (n, n) the plant's drift
    C: Matrix  # (m, n) the output that the cost is on
    C2: Matrix  # (l, n) the measurement
    B: Matrix  # (n, r + g) the channels' inputs into the state
    D: Matrix  # (l, r + g) and into the measurement
    C1: Matrix  # (h + g, n) their outputs, the nonlinearities' times their Lipschitz constants
    channels: np.ndarray  # (r + g,) to which of the k + g channels an input belongs ...
    rows: np.ndarray  # (h + g,) ... and an output
    lipschitz: np.ndarray  # (g,)
    k: int  # the first channels are the uncertainties, the others the nonlinearities

    @classmethod
    def of(cls, plant: AugmentedSystem, cost: str) -> "DesignProblem":
        """Return the problem of a plant and a cost."""
        system, k, g = plant.system, plant.system.k, plant.system.g
        channels, rows = (
            np.repeat(np.arange(k + g), sizes[: k + g])
            for sizes in (plant.input_sizes, plant.output_sizes)
        )
        B, D = plant.B1_tilde[:, : len(channels)], plant.D21_tilde[: system.l, : len(channels)]
        lipschitz = np.array([c.lipschitz for c in system.nonlinearities])
        scales = np.concatenate([np.ones(len(rows) - g), lipschitz])
        C1 = scales[:, None] * plant.C1_tilde[: len(rows)]
        C, C2 = plant.C_p0 if cost == "filtered" else plant.C_a, plant.C2_tilde[: system.l]
        return cls(plant.A_p, C, C2, B, D, C1, channels, rows, lipschitz, k)


class DesignEquations:
    """The equations at one tau and lambda."""

    def __init__(self, problem: DesignProblem, tau: float, multipliers: np.ndarray) -> None:
        self.problem, self.tau, self.multipliers = problem, tau, multipliers
        of_s, (d, o, c) = multipliers[: problem.k], multipliers[problem.k :].reshape(3, -1)
        self.d, self.a, self.b = d, d / (d + o), d / (d + c)
        of_Y, of_X = np.concatenate([of_s, d + o]), np.concatenate([of_s, o + self.b * c])
        C1 = problem.C1
        self.R = problem.C.T @ problem.C + tau * (C1.T * of_Y[problem.rows] @ C1)
        self.Q_X = tau * (C1.T * of_X[problem.rows] @ C1)  # R - Gamma G^{-1} Gamma'
        # Diagonals of Lambda_Y^{-1} and Lambda_X^{-1}; zero for noise without bound.
        self.noise_Y = (1.0 / of_Y)[problem.channels]
        of_X = of_X[problem.channels]
        self.noise_X = np.divide(1.0, of_X, out=np.zeros_like(of_X), where=of_X > 0.0)
        self.E = problem.D * self.noise_Y @ problem.D.T
        self.L = problem.B * self.noise_Y @ problem.D.T
        over_E = np.linalg.solve(self.E, np.hstack([problem.C2, self.L.T]))
        self.information, self.gain = np.hsplit(over_E, 2)  # (l, n) E^{-1} C2 and E^{-1} L'
        self.worst_noise = problem.B * self.noise_X @ problem.B.T  # B1_tilde M^{-1} B1_tilde'

    @property
    def equation_Y(self) -> Equation:
        """The first Riccati equation of Assumption 3."""
        problem = self.problem
        return (
            (problem.A - self.L @ self.information).T,
            problem.B * self.noise_Y @ problem.B.T - self.L @ self.gain,
            problem.C2.T @ self.information - self.R / self.tau,
        )

    def equation_X(self, quadratic_sign: float = 1.0) -> Equation:
        """Return the second Riccati equation of Assumption 3; the theory has `quadratic_sign` 1."""
        return self.problem.A, self.Q_X, -quadratic_sign / self.tau * self.worst_noise

    def solution(self, X: Matrix, Y: Matrix) -> tuple[Matrix, Matrix, float, float]:
        """Return K, T, V and rho(YX), which must be below tau."""
        # T = inv(I - Y X/tau) by a symmetric matrix: no digit depends on the states' units
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
        K = Y @ self.information.T + self.gain.T
        copies = self.problem.channels >= self.problem.k
        B, excess = self.problem.B[:, copies], self.a * self.b * self.noise_X[copies]  # 1/f - 1/e
        U = K @ self.E @ K.T + B * excess @ B.T
        return K, T, 0.5 * float(np.trace(Y @ self.R + U @ X @ T)), radius

    def gains(self, X: Matrix, Y: Matrix) -> tuple[Matrix, Matrix, Matrix, float, float]:
        """Return A_c, B_c and C_c of (eqCparams), V of (eqbound), and rho(YX)."""
        problem = self.problem
        K, T, bound, radius = self.solution(X, Y)
        arguments = problem.C1[problem.rows >= problem.k] / problem.lipschitz[:, None]
        Gamma = -np.hstack([problem.C.T, arguments.T * (self.tau * problem.lipschitz**2 * self.d)])
        C_c = np.vstack([problem.C, self.b[:, None] * arguments]) @ T
        A_c = problem.A - K @ problem.C2 + Y @ (self.R + Gamma @ C_c) / self.tau
        copies = (problem.B - K @ problem.D)[:, problem.channels >= problem.k] * self.a
        return A_c, np.hstack([K, copies]), C_c, bound, radius
