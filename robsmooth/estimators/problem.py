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
from robsmooth.estimators.weights import Weights
from robsmooth.systems.augmented import AugmentedSystem

_NEGLIGIBLE = 1e-9  # a product of matrices that is smaller, relative to its terms, is rounding


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """What the equations are made of, whatever tau and the positive multipliers are.

    Attributes
    ----------
    plant : AugmentedSystem
    C : (m, n) array
        The output that the cost is on.
    B, D, C1 : (n, r + g), (l, r + g), (h + g, n) arrays
        The channels of the uncertainties and nonlinearities: inputs into the state and into the
        measurement, and outputs.
    channels, rows : (r + g,), (h + g,) arrays of int
        To which of the k + g uncertainties and nonlinearities these inputs and outputs belong.
    lipschitz : (g,) array
        The constants of the nonlinearities, which their outputs are multiplied by.
    unbounded : (r + g,) array of bool
        In a limit, the channels with noise without bound in the X equation.
    known, combinations : (n, l), (l, l_Y) arrays
        In a limit, what the measurement tells of the channels with noise without bound, as inputs
        into the state, and the combinations of measurements that these channels do not enter.
    """

    plant: AugmentedSystem
    C: Matrix
    B: Matrix
    D: Matrix
    C1: Matrix
    channels: np.ndarray
    rows: np.ndarray
    lipschitz: np.ndarray
    unbounded: np.ndarray
    known: Matrix
    combinations: Matrix

    @classmethod
    def of(cls, plant: AugmentedSystem, cost: str, positive: np.ndarray) -> "DesignProblem":
        """Return the problem where the multipliers that `positive` marks are not zero.

        Raises
        ------
        InfeasibleDesignError
            Where noise without bound enters the state and no measurement tells of it, or the
            remaining uncertainty acts on what it enters.
        """
        system, k, g = plant.system, plant.system.k, plant.system.g
        channels, rows = (
            np.repeat(np.arange(k + g), sizes[: k + g])
            for sizes in (plant.input_sizes, plant.output_sizes)
        )
        B, D = plant.B1_tilde[:, : len(channels)], plant.D21_tilde[: system.l, : len(channels)]
        lipschitz = np.array([c.lipschitz for c in system.nonlinearities])
        scales = np.concatenate([np.ones(len(rows) - g), lipschitz])
        C1 = scales[:, None] * plant.C1_tilde[: len(rows)]
        left = Weights.of(k, 1.0 * positive, np.zeros(len(positive)))
        unknown, unbounded = left.Y[channels] == 0.0, left.X[channels] == 0.0
        known, combinations = _known_inputs(plant, B[:, unknown], D[:, unknown])
        if _reaches(plant.A_p, B[:, unbounded], C1[left.X[rows] > 0.0]):
            raise refusal(
                ASSUMPTION_X,
                "towards the limit of these multipliers the bound grows without limit, because the "
                "remaining uncertainty acts on states that a vanishing channel's noise enters",
            )
        return cls(
            plant=plant,
            C=plant.C_p0 if cost == "filtered" else plant.C_a,
            B=B,
            D=D,
            C1=C1,
            channels=channels,
            rows=rows,
            lipschitz=lipschitz,
            unbounded=unbounded,
            known=known,
            combinations=combinations,
        )

    @property
    def nonlinear(self) -> np.ndarray:
        """(r + g,) which of the channels are the nonlinearities'."""
        return self.channels >= self.plant.system.k

    @property
    def arguments(self) -> Matrix:
        """(g, n) those of the nonlinearities, nu."""
        return self.C1[self.rows >= self.plant.system.k] / self.lipschitz[:, None]

    def scaled(self, size: float) -> "DesignProblem":
        """Return the problem of uncertainty whose outputs are `size` times as large."""
        return replace(self, C1=size * self.C1, lipschitz=size * self.lipschitz)

    @cached_property
    def of_Y(self) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """A, B, C2 and D of the Y equation: of the plant, but in a limit."""
        N, C2 = self.combinations, self.plant.C2_tilde[: len(self.D)]
        A, B = self.plant.A_p - self.known @ C2, self.B - self.known @ self.D
        return A, B, N.T @ C2, N.T @ self.D


def _known_inputs(plant: AugmentedSystem, B: Matrix, D: Matrix) -> tuple[Matrix, Matrix]:
    """Return `known` and `combinations` where these channels have noise without bound."""
    measurements = plant.system.l
    if not B.shape[1]:
        return np.zeros((plant.n, measurements)), np.eye(measurements)
    deviations = np.linalg.norm(plant.system.D21, axis=1)[:, None]
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


def _reaches(A: Matrix, B: Matrix, C: Matrix) -> bool:
    """Return whether inputs B of x' = A x + B u have any effect on C x."""
    size = np.abs(B)
    for _ in range(len(A)):
        if (np.abs(C @ B) > _NEGLIGIBLE * (np.abs(C) @ size)).any():
            return True
        largest = size.max(initial=0.0) or 1.0
        B, size = A @ B / largest, np.abs(A) @ size / largest
    return False
