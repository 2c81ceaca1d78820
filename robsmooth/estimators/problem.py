"""What a design's equations are made of, whatever tau and lambda."""

from dataclasses import dataclass

import numpy as np

from robsmooth._support.validation import Matrix
from robsmooth.systems.augmented import AugmentedSystem

_NEGLIGIBLE = 1e-9  # a product of matrices that is smaller, relative to its terms, is rounding


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """What the equations are made of."""

    A: Matrix  # (n, n) the plant's drift
    C: Matrix  # (m, n) the output that the cost is on
    C2: Matrix  # (l, n) the measurement
    B: Matrix  # (n, r + g) the channels' inputs into the state
    D: Matrix  # (l, r + g) and into the measurement
    C1: Matrix  # (h + g, n) their outputs, the nonlinearities' times their Lipschitz constants
    channels: np.ndarray  # (r + g,) to which of the k + g channels an input belongs ...
    rows: np.ndarray  # (h + g,) ... and an output
    lipschitz: np.ndarray  # (g,)

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
        return cls(plant.A_p, C, C2, B, D, C1, channels, rows, lipschitz)

    @property
    def k(self) -> int:
        """Number of uncertainties; what is left of the channels is the nonlinearities'."""
        return int(self.channels[-1]) + 1 - len(self.lipschitz)


def reaches(A: Matrix, B: Matrix, C: Matrix) -> bool:
    """Return whether inputs B of x' = A x + B u have any effect on C x."""
    size = np.abs(B)
    for _ in range(len(A)):
        if (np.abs(C @ B) > _NEGLIGIBLE * (np.abs(C) @ size)).any():
            return True
        largest = size.max(initial=0.0) or 1.0
        B, size = A @ B / largest, np.abs(A) @ size / largest
    return False
