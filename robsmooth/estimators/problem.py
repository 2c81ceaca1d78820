r"""What a design's equations are made of, whatever tau and lambda.

Noise without bound enters the channels whose weights are zero in a limit. What the measurement
tells of them makes them known inputs of the estimator's model (`robsmooth.estimators.limit`).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import null_space

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.conditions import ASSUMPTION_X, refusal
from robsmooth.systems.augmented import AugmentedSystem

_NEGLIGIBLE = 1e-9  # a product of matrices that is smaller, relative to its terms, is rounding


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """What the equations are made of; the last three are of a limit."""

    A: Matrix  # (n, n) the plant's drift
    C: Matrix  # (m, n) the output that the cost is on
    C2: Matrix  # (l, n) the measurement
    B: Matrix  # (n, r + g) the channels' inputs into the state
    D: Matrix  # (l, r + g) and into the measurement
    C1: Matrix  # (h + g, n) their outputs, the nonlinearities' times their Lipschitz constants
    channels: np.ndarray  # (r + g,) to which of the k + g channels an input belongs ...
    rows: np.ndarray  # (h + g,) ... and an output
    lipschitz: np.ndarray  # (g,)
    unbounded: np.ndarray  # (r + g,) which inputs have noise without bound in the X equation
    known: Matrix  # (n, l) what y tells of those in the Y equation, as inputs into the state ...
    combinations: Matrix  # (l, l_Y) ... and combinations of y that they do not enter

    @classmethod
    def of(cls, plant: AugmentedSystem, cost: str, positive: np.ndarray) -> "DesignProblem":
        """Return the problem where the multipliers that `positive` marks are not zero."""
        system, k, g = plant.system, plant.system.k, plant.system.g
        channels, rows = (
            np.repeat(np.arange(k + g), sizes[: k + g])
            for sizes in (plant.input_sizes, plant.output_sizes)
        )
        B, D = plant.B1_tilde[:, : len(channels)], plant.D21_tilde[: system.l, : len(channels)]
        lipschitz = np.array([c.lipschitz for c in system.nonlinearities])
        scales = np.concatenate([np.ones(len(rows) - g), lipschitz])
        C1 = scales[:, None] * plant.C1_tilde[: len(rows)]
        # the weights e of the Y equation and f of the X equation that are not zero
        s, (d, o, c) = positive[:k], positive[k:].reshape(3, g)
        in_Y, in_X = np.concatenate([s, d | o]), np.concatenate([s, o | (d & c)])
        unknown, unbounded = ~in_Y[channels], ~in_X[channels]
        known, combinations = _known_inputs(system.D21, B[:, unknown], D[:, unknown])
        if reaches(plant.A_p, B[:, unbounded], C1[in_X[rows]]):
            raise refusal(
                ASSUMPTION_X,
                "towards the limit of these multipliers the bound grows without limit, because the "
                "remaining uncertainty acts on states that a vanishing channel's noise enters",
            )
        C, C2 = plant.C_p0 if cost == "filtered" else plant.C_a, plant.C2_tilde[: system.l]
        matrices = (plant.A_p, C, C2, B, D, C1)
        return cls(*matrices, channels, rows, lipschitz, unbounded, known, combinations)

    @property
    def k(self) -> int:
        """Number of uncertainties; what is left of the channels is the nonlinearities'."""
        return int(self.channels[-1]) + 1 - len(self.lipschitz)

    @cached_property
    def of_Y(self) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """A, B, C2 and D of the Y equation: the same, but in a limit."""
        N = self.combinations
        A, B = self.A - self.known @ self.C2, self.B - self.known @ self.D
        return A, B, N.T @ self.C2, N.T @ self.D

    def in_units(self, time: float, x: Matrix, y: Matrix) -> "DesignProblem":
        """Return the problem with other units of time, states (n, 1) and measurements (l, 1)."""
        root = np.sqrt(time)
        return replace(
            self,
            A=time * self.A / x * x.T,
            C=self.C * x.T,
            C2=root * self.C2 / y * x.T,
            B=root * self.B / x,
            D=self.D / y,
            C1=root * self.C1 * x.T,
            known=root * self.known / x * y.T,
            combinations=self.combinations * y,
        )


def _known_inputs(D21: Matrix, B: Matrix, D: Matrix) -> tuple[Matrix, Matrix]:
    """Return `known` and `combinations` where these channels have noise without bound."""
    if not B.shape[1]:
        return np.zeros((len(B), len(D))), np.eye(len(D))
    deviations = np.linalg.norm(D21, axis=1)[:, None]
    D = D / deviations
    # Directions that no measurement sees are of no account, if they do not enter the state either.
    unseen = null_space(D, rcond=_NEGLIGIBLE)
    if (np.abs(B @ unseen) > _NEGLIGIBLE * (np.abs(B) @ np.abs(unseen))).any():
        raise InfeasibleDesignError(
            "M(lambda) > 0",
            "in the limit of these multipliers noise without bound enters the state through a "
            "channel that no measurement sees; its multiplier must be positive",
        )
    seen = null_space(unseen.T)
    B, D = B @ seen, D @ seen
    return B @ np.linalg.pinv(D) / deviations.T, null_space(D.T) / deviations


def reaches(A: Matrix, B: Matrix, C: Matrix) -> bool:
    """Return whether inputs B of x' = A x + B u have any effect on C x."""
    size = np.abs(B)
    for _ in range(len(A)):
        if (np.abs(C @ B) > _NEGLIGIBLE * (np.abs(C) @ size)).any():
            return True
        largest = size.max(initial=0.0) or 1.0
        B, size = A @ B / largest, np.abs(A) @ size / largest
    return False
