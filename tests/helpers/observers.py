r"""The least certified error by another route: a search over observers of the worst plant.

In the programme, F and K are in one block and one row each, and drop out; what is left is convex in
Z, X, L and theta. With Y = X - Z and G = Y^-1 L it reads: let Z be the stabilising solution of

.. math:: A'Z + ZA + Q + ZB_\xi\Theta^{-1}B_\xi'Z = 0, \qquad F = \Theta^{-1}B_\xi'Z,

so that F is the feedback by which the uncertainty does most harm to the plant alone, and Y that of

.. math:: A_o'Y + YA_o + C_a'C_a + R + YB_o\Theta^{-1}B_o'Y = 0,

with :math:`A_o = A + B_\xi F + G(C_2 + D_\xi F)`, :math:`B_o = B_\xi + GD_\xi` and R the squared
arguments of the copied channels, times theta. The least certified error is the least of
:math:`\operatorname{tr}B_w'ZB_w + \operatorname{tr}(B_w + GD_w)'Y(B_w + GD_w)` over the gains G and
theta. It has no other local minimum: it is convex in the other variables.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solve_continuous_are, solve_continuous_lyapunov
from scipy.optimize import minimize

import robsmooth as rs

_INFEASIBLE = 1e2  # the objective, a logarithm, where there is no solution


@dataclass(frozen=True, eq=False)
class Observers:
    """The channels of a plant that have an effect, those of the uncertainties first."""

    plant: rs.AugmentedSystem

    def __post_init__(self):
        plant, system = self.plant, self.plant.system
        ends = np.cumsum([plant.input_sizes, plant.output_sizes], axis=1)[:, :-1]
        gains = [1.0] * system.k + [c.lipschitz for c in system.nonlinearities]
        into = np.split(np.vstack([plant.B1_tilde, plant.D21_tilde[: system.l]]), ends[0], axis=1)
        channels = zip(gains, into, np.split(plant.C1_tilde, ends[1]), strict=False)
        found = [(i, B, gain * C) for i, (gain, B, C) in enumerate(channels) if C.any()]
        vars(self).update(
            copied=np.array([i >= system.k for i, _, _ in found]),
            sizes=[B.shape[1] for _, B, _ in found],
            into=np.hstack([np.zeros((plant.n + system.l, 0)), *(B for _, B, _ in found)]),
            squares=[C.T @ C for _, _, C in found],
        )

    def least_error(self):
        """The least certified mean square error over theta and G, from the Kalman gain."""
        plant = self.plant
        kalman = rs.baselines.fixed_lag_smoother(plant.system, plant.delay, plant.order)
        G = -kalman.B_c[:, : plant.system.l]

        def objective(x):
            theta, gain = np.split(x, [len(self.sizes)])
            try:
                value, slopes = self.error(np.exp(theta), gain.reshape(G.shape))
            except (LinAlgError, ValueError):
                return _INFEASIBLE, np.zeros_like(x)
            return np.log(value), slopes / value

        starts = [np.append([np.log(t)] * len(self.sizes), G) for t in 4.0 ** np.arange(-6, 16)]
        x = min(starts, key=lambda start: objective(start)[0])
        before, value = np.inf, objective(x)[0]
        while value < min(before - 1e-9, _INFEASIBLE):
            before, x = value, minimize(objective, x, jac=True, method="BFGS").x
            value = objective(x)[0]
        return np.inf if value == _INFEASIBLE else np.exp(value)

    def error(self, theta, G):
        """The certified error of an observer, and its slopes in the logarithms of theta, and in G.

        The slopes are the energies that the worst uncertainty leaves, with the second moments T of
        the plant and S of the error, and what the gain does to them.
        """
        plant, n = self.plant, self.plant.n
        A, B_w, C_2 = plant.A_p, plant.B_p1[:, : plant.system.q], plant.C2_tilde[: plant.system.l]
        D_w, B, D = plant.system.D21, self.into[:n], self.into[n:]
        Theta = np.diag(np.repeat(theta, self.sizes))
        squares = np.reshape([t * C for t, C in zip(theta, self.squares, strict=True)], (-1, n, n))

        Z, F, closed = worst(A, B, squares[~self.copied].sum(axis=0), Theta)
        measured, noise, B_o = C_2 + D @ F, B_w + G @ D_w, B + G @ D
        R = plant.C_a.T @ plant.C_a + squares[self.copied].sum(axis=0)
        Y, H, closed_error = worst(A + B @ F + G @ measured, B_o, R, Theta)
        value = np.trace(B_w.T @ Z @ B_w) + np.trace(noise.T @ Y @ noise)

        S = solve_continuous_lyapunov(closed_error, -noise @ noise.T)
        in_G = 2.0 * Y @ (noise @ D_w.T + S @ measured.T + S @ H.T @ D.T)
        in_F = B_o.T @ Y @ S
        weight = B @ np.linalg.solve(Theta, in_F)
        T = solve_continuous_lyapunov(closed, -B_w @ B_w.T - weight - weight.T)
        spent = np.diag(Theta @ (F @ T @ F.T + H @ S @ H.T) + 2.0 * in_F @ F.T)
        parts = np.split(spent, np.cumsum(self.sizes)[:-1])
        slopes = [
            np.sum((S if copied else T) * square) - part.sum()
            for copied, square, part in zip(self.copied, squares, parts, strict=True)
        ]
        return value, np.append(slopes, in_G)


def worst(A, B, Q, Theta):
    """The value of the uncertainty's worst feedback, the feedback, and the loop that it closes."""
    P = solve_continuous_are(A, B, Q, -Theta) if B.size else solve_continuous_lyapunov(A.T, -Q)
    feedback = np.linalg.solve(Theta, B.T @ P)
    closed = A + B @ feedback
    if np.linalg.eigvals(closed).real.max() >= 0.0 or np.linalg.eigvalsh(P)[0] < -1e-9 * P.max():
        raise LinAlgError("no stabilising solution")
    return P, feedback, closed
