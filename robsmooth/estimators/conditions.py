"""The conditions of the theory, and the errors where one fails."""

from collections.abc import Sequence

import numpy as np

from robsmooth._numerics.riccati import RiccatiError, RiccatiSolution, solve_riccati
from robsmooth._support import validation
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.systems.augmented import AugmentedSystem, check_is_plant, check_noise

COSTS = ("filtered", "smoothed")
ASSUMPTION_Y = "Assumption 3.1 (Riccati equation for Y)"
ASSUMPTION_X = "Assumption 3.2 (Riccati equation for X)"
# What usually helps. X/tau depends on the multipliers alone.
_HINTS = {
    ASSUMPTION_Y: "; a larger tau may help",
    ASSUMPTION_X: "; other ratios of the multipliers, or less uncertainty (smaller outputs C or "
    "Lipschitz constants), may help",
}
EQUALITY_SLACK = 1e-9  # of inequalities that are equalities at an optimum


def check_plant(plant: AugmentedSystem, cost: str) -> None:
    """Check the types, and Assumptions 1 and 2."""
    check_is_plant(plant)
    validation.choice("cost", cost, COSTS)
    _ = plant.J  # exists by Assumption 1
    check_noise("Assumption 2", plant.D21_bar)


def weights(name: str, plant: AugmentedSystem, given: Sequence[float]) -> np.ndarray:
    """Return k + 3g numbers that are not negative."""
    result = validation.array(name, given, ndim=1)
    k, g = plant.system.k, plant.system.g
    if result.size != k + 3 * g:
        allowed = f"k + 3g = {k} + 3*{g} = {k + 3 * g} entries"
        raise ValueError(f"{name} must have {allowed}, got {result.size}")
    if (result < 0.0).any():
        raise ValueError(f"{name} must not be negative, got {result.tolist()}")
    return result


def of_measurements(plant: AugmentedSystem) -> np.ndarray:
    """Return which nonlinearities do not enter the state, (g,)."""
    return np.array([not c.B.any() for c in plant.system.nonlinearities], dtype=bool)


def multiplier_level(plant: AugmentedSystem, multipliers: Sequence[float]) -> float:
    """Return the largest eigenvalue of J'MJ, at most 1 by (eqcons)."""
    return float(np.linalg.eigvalsh(plant.J.T @ plant.M(multipliers) @ plant.J).max(initial=0.0))


def check_multipliers(plant: AugmentedSystem, multipliers: np.ndarray, limit: bool) -> None:
    """Check M(lambda) > 0, or what a limit needs of it, and the constraint (eqcons)."""
    k, positive = plant.system.k, multipliers > 0.0
    pairs = positive[k:].reshape(3, -1)
    enough = pairs.sum(axis=0) > 1
    if limit:
        enough |= pairs[0] & of_measurements(plant)
    if not (positive[:k].all() and enough.all()):
        raise InfeasibleDesignError(
            "M(lambda) > 0",
            "every uncertainty needs a positive multiplier and every nonlinearity two positive "
            f"ones, got {multipliers.tolist()} (in a limit, see limiting_smoother, a nonlinearity "
            "that does not enter the state needs that of the difference alone)",
        )
    level = multiplier_level(plant, multipliers)
    if level > 1.0 + EQUALITY_SLACK:
        raise InfeasibleDesignError(
            "The multiplier constraint M(lambda)^-1 >= J J'",
            f"the largest eigenvalue of J'M(lambda)J is {level:.6g}, above 1; divide the "
            f"multipliers by {level:.6g}",
        )


def check_stable(plant: AugmentedSystem) -> None:
    """Check that A is stable: else no nonnegative X exists."""
    abscissa = float(np.linalg.eigvals(plant.system.A).real.max())
    if not abscissa < 0.0:
        raise InfeasibleDesignError(
            ASSUMPTION_X,
            "the system's A must be stable for a nonnegative solution to exist, but it has an "
            f"eigenvalue with real part {abscissa + 0.0:.3g}; give an integrator a slow decay, or "
            "use minimax_smoother or the baselines, which need no stability",
        )


def certified_solution(condition: str, equation: tuple[Matrix, ...]) -> RiccatiSolution:
    """Solve one Riccati equation; name the assumption where there is no nonnegative solution."""
    try:
        solution = solve_riccati(*equation)
        if solution.smallest_eigenvalue < -EQUALITY_SLACK:
            detail = f"smallest eigenvalue {solution.smallest_eigenvalue:.3g} of its norm"
            raise RiccatiError(f"its stabilising solution is not nonnegative definite: {detail}")
    except RiccatiError as error:
        raise InfeasibleDesignError(condition, f"{error}{_HINTS[condition]}") from None
    return solution
