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
    A, C, C2 : (n, n), (m, n), (l, n) arrays
        The plant's drift, the output that the cost is on, and the measurement.
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

    A: Matrix
    C: Matrix
    C2: Matrix
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
        known, combinations = _known_inputs(system.D21, B[:, unknown], D[:, unknown])
        if _reaches(plant.A_p, B[:, unbounded], C1[left.X[rows] > 0.0]):
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
        return (
            self.A - self.known @ self.C2,
            self.B - self.known @ self.D,
            N.T @ self.C2,
            N.T @ self.D,
        )

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

    def scaled(self, size: float) -> "DesignProblem":
        """Return the problem of uncertainty whose outputs are `size` times as large."""
        return replace(self, C1=size * self.C1, lipschitz=size * self.lipschitz)


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


def _reaches(A: Matrix, B: Matrix, C: Matrix) -> bool:
    """Return whether inputs B of x' = A x + B u have any effect on C x."""
    size = np.abs(B)
    for _ in range(len(A)):
        if (np.abs(C @ B) > _NEGLIGIBLE * (np.abs(C) @ size)).any():
            return True
        largest = size.max(initial=0.0) or 1.0
        B, size = A @ B / largest, np.abs(A) @ size / largest
    return False
