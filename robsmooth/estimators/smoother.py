r"""The robust fixed-lag smoother at given tau and lambda (Section III)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth._numerics.riccati import RiccatiSolution
from robsmooth._support import notation, validation
from robsmooth._support.validation import Matrix
from robsmooth.estimators import conditions
from robsmooth.estimators.equations import DesignEquations, DesignProblem
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class RobustSmoother(Estimator):
    """A robust fixed-lag smoother with its guarantee, as `design_smoother` makes it.

    Attributes
    ----------
    tau, multipliers, cost : as in `design_smoother`
    X, Y : (n, n) arrays, the solutions of the Riccati equations
    certificates : dict of RiccatiSolution, the residual, definiteness and stability of each
    bound : float
        V: half the mean square error of w-hat, in the loop with the copies' fictitious noise, is
        below it for every admissible uncertainty. The error is that against w, or with
        cost="smoothed" that against the output w_a of the delay model (not of the exact delay).
    bound_infimum, limit : float and RobustSmoother, or None
        The infimum and the limiting design, where `minimize_bound` found no least bound.
    spectral_radius : float, rho(YX), below tau
    """

    tau: float
    multipliers: NDArray[np.float64]
    cost: str
    X: Matrix
    Y: Matrix
    certificates: dict[str, RiccatiSolution]
    bound: float
    spectral_radius: float
    bound_infimum: float | None = None
    limit: "RobustSmoother | None" = None

    @property
    def mean_square_bound(self) -> float:
        """The guarantee, 2V: no admissible uncertainty makes the mean square error larger."""
        return 2.0 * self.bound

    @property
    def _figures(self) -> str:
        multipliers, radius = notation.array(self.multipliers), self.spectral_radius / self.tau
        given = f"cost={self.cost!r}, tau={self.tau:.4g}, multipliers={multipliers}"
        return f"bound={self.bound:.4g}, {given}, spectral_radius/tau={radius:.3g}"


def design_smoother(
    plant: AugmentedSystem, tau: float, multipliers: ArrayLike, cost: str = "filtered"
) -> RobustSmoother:
    r"""Design the robust fixed-lag smoother of (eqCparams), (eqbound) at given tau and lambda.

    Parameters
    ----------
    plant : AugmentedSystem
    tau : float, :math:`\tau > 0`, in seconds times the squared unit of w
    multipliers : (k + 3g,) sequence
        lambda, not negative: those of the k uncertainties, then for the g nonlinearities those of
        the difference, the mu and the mu-tilde constraints. `minimize_bound` finds the best.
    cost : {"filtered", "smoothed"}
        The bound is for the filtered error, with :math:`C_{p0}` in R and Gamma as in the paper's
        example, or for the error against the delay model's output, with :math:`C_a` as in its text.

    Raises
    ------
    InfeasibleDesignError
        Where Assumption 2 or 3, M(lambda) > 0 or the constraint (eqcons) fails, with the figures.

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.design_smoother(plant, tau=1.1e-6, multipliers=[1.0, 0.49, 1e-4, 1e-4])
    >>> round(smoother.mean_square_bound, 4)
    0.2465
    """
    return _solved(plant, design_equations(plant, tau, multipliers, cost), cost)


def limiting_smoother(
    plant: AugmentedSystem, tau: float, multipliers: ArrayLike, cost: str = "filtered"
) -> RobustSmoother:
    r"""Design the smoother in the limit of `design_smoother` as some multipliers go to zero.

    Its guarantee is the limit of theirs: a stable loop's error is continuous in the gains. Where
    M(lambda) is positive, it is the design of `design_smoother`.

    Parameters
    ----------
    plant, tau, multipliers, cost
        As in `design_smoother`. The multipliers of both the mu and the mu-tilde constraint may be
        zero for a nonlinearity that enters the measurements and not the state.

    Raises
    ------
    InfeasibleDesignError
        Where Assumption 2 or 3 or (eqcons) fails in the limit, or other multipliers are zero.

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> limit = rs.limiting_smoother(plant, tau=1.1e-6, multipliers=[1.0, 0.5, 0.0, 0.0])
    >>> round(limit.mean_square_bound, 4)
    0.2433
    """
    return _solved(plant, design_equations(plant, tau, multipliers, cost, limit=True), cost)


def design_equations(
    plant: AugmentedSystem,
    tau: float,
    multipliers: ArrayLike,
    cost: str = "filtered",
    limit: bool = False,
) -> DesignEquations:
    """Check all but Assumption 3, and return the equations of a design or of a limit."""
    conditions.check_plant(plant, cost)
    tau = validation.positive("tau", tau)
    multipliers = conditions.weights("multipliers", plant, multipliers)
    conditions.check_multipliers(plant, multipliers, limit)
    return DesignEquations(DesignProblem.of(plant, cost), tau, multipliers)


def _solved(plant: AugmentedSystem, equations: DesignEquations, cost: str) -> RobustSmoother:
    """Check Assumption 3, and return the design."""
    conditions.check_stable(plant)
    Y = conditions.certified_solution(conditions.ASSUMPTION_Y, equations.equation_Y)
    X = conditions.certified_solution(conditions.ASSUMPTION_X, equations.equation_X())
    A_c, B_c, C_c, bound, radius = equations.gains(X.X, Y.X)
    C_f = C_c[: plant.system.m] if cost == "filtered" else plant.C_p0
    matrices = {"A_c": A_c, "B_c": B_c, "C_c": C_c, "C_a": plant.C_a, "C_f": C_f}
    given = {"tau": equations.tau, "multipliers": equations.multipliers, "cost": cost}
    found = {"X": X.X, "Y": Y.X, "certificates": {"X": X, "Y": Y}, "bound": bound}
    return RobustSmoother(plant=plant, **matrices, **given, **found, spectral_radius=radius)
