r"""The certified error: what the constraints on the uncertainty allow a loop, at given multipliers.

The constraints (eqIQC1) to (eqIQC4) speak of mean energies of inputs :math:`\tilde\xi` that may
depend on all that has happened. For multipliers :math:`\theta \ge 0` and the stabilising solution
of

.. math::

    \mathbf A'P + P\mathbf A + C'C + C_\zeta' N(\theta) C_\zeta +
    P B_\xi M(\theta)^{-1} B_\xi' P = 0, \qquad C = C_w - C_s,

Ito's formula for :math:`X'PX` gives :math:`E|e|^2 \le \operatorname{tr}\mathbf B'P\mathbf B` for
every admissible uncertainty. The right hand side is convex in :math:`\theta`. The worst input is
the feedback :math:`\tilde\xi = M^{-1}B_\xi'PX`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space, solve_continuous_lyapunov

from robsmooth._numerics.riccati import RiccatiError, solve_riccati
from robsmooth._support.validation import Matrix
from robsmooth.estimators.descent import Slopes
from robsmooth.estimators.loop import OpenLoop
from robsmooth.systems.augmented import AugmentedSystem

_NEGLIGIBLE = 1e-7  # an effect that is smaller, relative to its terms, is rounding


@dataclass(frozen=True, eq=False)
class Certificate:
    """The certified mean square error at one theta, with its gradients and the worst input."""

    mean_square: float
    slack: np.ndarray  # the gradient in theta: how much less energy than allowed the worst input has
    feedback: Matrix  # the worst input
    slopes: Slopes


class ConstraintProblem:
    """A loop without delay, with the inputs and constraints that are not void.

    A constraint whose right hand side is zero forbids its input: `free` spans the inputs that are
    left, and M (between these) and N (between states) are those of the `active` constraints.
    Constraints that are not `kept` have the multiplier zero. Then inputs may be `unbounded`, and
    there is a certificate only where they have no effect on the error.
    """

    def __init__(
        self, loop: OpenLoop, plant: AugmentedSystem, kept: np.ndarray | None = None
    ) -> None:
        constraints, inputs = len(plant.M_i), loop.inputs.shape[1]
        M = np.reshape(plant.M_i, (constraints, inputs, inputs))
        N = [loop.outputs.T @ N_i @ loop.outputs for N_i in plant.N_i]
        N = np.reshape(N, (constraints, *loop.A.shape))
        self.loop, self.A, self.B, self.C = loop, loop.A, loop.B, loop.truth - loop.estimate
        forbidding = ~N.any(axis=(1, 2))
        self.active = ~forbidding if kept is None else ~forbidding & kept
        allowed = null_space(M[forbidding].sum(axis=0))
        between = allowed.T @ M[self.active].sum(axis=0) @ allowed
        unbounded = null_space(between)
        self.free = allowed @ null_space(unbounded.T)
        self.inputs, self.unbounded = loop.inputs @ self.free, loop.inputs @ allowed @ unbounded
        self.M, self.N = self.free.T @ M[self.active] @ self.free, N[self.active]
        self._between_outputs = np.reshape(plant.N_i, (constraints, len(loop.outputs), -1))[self.active]

    def at(self, theta: np.ndarray, fraction: float = 1.0) -> Certificate:
        """Certify the error with the outputs scaled; a RiccatiError says that it cannot be."""
        weighted = np.tensordot(theta, self.N, axes=1)
        gain = fraction * np.linalg.solve(np.tensordot(theta, self.M, axes=1), self.inputs.T)
        P = solve_riccati(self.A, self.C.T @ self.C + fraction * weighted, -self.inputs @ gain).X
        through = np.linalg.norm(P @ self.unbounded)
        if through > _NEGLIGIBLE * np.linalg.norm(P) * np.linalg.norm(self.loop.inputs):
            raise RiccatiError("inputs without a bound have an effect on the error")
        feedback = gain @ P
        covariance = solve_continuous_lyapunov(self.A + self.inputs @ feedback, -self.B @ self.B.T)
        allowed = fraction * np.tensordot(self.N, covariance, axes=2)
        used = np.tensordot(self.M, feedback @ covariance @ feedback.T, axes=2) / fraction
        both = 2.0 * P @ covariance
        slopes = Slopes(
            A=both,
            B=2.0 * P @ self.B,
            inputs=both @ (self.free @ feedback).T,
            outputs=2.0 * fraction * np.tensordot(theta, self._between_outputs, axes=1) @ self.loop.outputs @ covariance,
            estimate=-2.0 * self.C @ covariance,
        )
        return Certificate(float(np.trace(self.B.T @ P @ self.B)), allowed - used, self.free @ feedback, slopes)
