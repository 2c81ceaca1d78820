r"""The robust fixed-lag smoother: two Riccati equations, gains and bound (Section III).

With :math:`M = \tilde M(\lambda)`, :math:`N = \tilde N(\lambda)` and
:math:`E_\lambda = \tilde D_{21} M^{-1} \tilde D_{21}'`, which the paper uses but does not define
(it is in Petersen, Ugrinovskii and Savkin, *Robust Control Design Using H-infinity Methods*):

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
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve

from robsmooth._numerics.lyapunov import square_root
from robsmooth._numerics.riccati import RiccatiError, RiccatiSolution, solve_riccati
from robsmooth._support import notation, validation
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix, frozen
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem, check_noise

COSTS = ("filtered", "smoothed")
MAKE_A_PLANT = "; augment(system, delay, order) makes one"
ASSUMPTION_Y = "Assumption 3.1 (Riccati equation for Y)"
ASSUMPTION_X = "Assumption 3.2 (Riccati equation for X)"
# What usually mends them. X/tau depends on the multipliers alone.
_HINTS = {
    ASSUMPTION_Y: "a larger tau may help",
    ASSUMPTION_X: (
        "other ratios of the multipliers, or less uncertainty (smaller outputs C or Lipschitz "
        "constants), may help"
    ),
}
_CANCELLED = 1e-15  # a difference that is smaller, relative to its terms, is their rounding
_ROUNDING = 1e-9  # slack for conditions that hold with equality at an optimum


@dataclass(frozen=True, eq=False, kw_only=True)
class RobustSmoother(Estimator):
    """A robust fixed-lag smoother with its guarantee.

    Attributes
    ----------
    tau : float
        The scaling constant, in seconds times the squared unit of w.
    multipliers : (k + 3g,) array
        The paper's lambda: k uncertainties, then for the g nonlinearities those of the difference
        constraints, of the mu constraints and of the mu-tilde constraints.
    cost : str
        "filtered" or "smoothed": the error that the bound is for.
    X, Y : (n, n) arrays
        The solutions of the Riccati equations.
    certificates : dict of RiccatiSolution
        Residual, definiteness and stability of each.
    bound : float
        V: half the mean square of w-hat's error, in the loop with the copies' fictitious noise, is
        below it for every admissible uncertainty. The error is that against w, or with
        cost="smoothed" that against the output w_a of the delay model (not of the true delay).
    bound_infimum : float or None
        Where `minimize_bound` made the design and the least bound is approached but not attained:
        its infimum.
    limit : RobustSmoother or None
        Then the design that attains it in the limit.
    spectral_radius : float
        rho(YX), below tau.
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

    def __post_init__(self) -> None:
        super().__post_init__()
        for value in (self.multipliers, self.X, self.Y):
            frozen(value)

    @property
    def mean_square_bound(self) -> float:
        """The guarantee: 2V, above the mean square error of the cost, (unit of w)^2."""
        return 2.0 * self.bound

    def __repr__(self) -> str:
        return (
            f"RobustSmoother(bound={self.bound:.4g}, cost={self.cost!r}, tau={self.tau:.4g}, "
            f"multipliers={notation.array(self.multipliers)}, "
            f"delay={self.plant.delay:g} s, order={self.plant.order}, "
            f"spectral_radius/tau={self.spectral_radius / self.tau:.3g})"
        )

    def _repr_html_(self) -> str:
        rows = [
            (f"bound $V$ on half the {self.cost} error, (unit of $w$)²", self.bound),
            ("its infimum, which no design attains", self.bound_infimum),
            (r"$\tau$, s (unit of $w$)²", self.tau),
            (r"multipliers $\lambda$", f"${notation.vector(self.multipliers)}$"),
            (r"$\rho(YX)/\tau$, below 1", self.spectral_radius / self.tau),
        ]
        return self._sheet("Robust smoother", rows)


@dataclass(frozen=True, eq=False)
class DesignEquations:
    """The data of the two Riccati equations and of the gains at one tau and lambda.

    Attributes
    ----------
    M_inverse : (r + 2g, r + 2g) array
        The inverse of M(lambda); in the limit of vanishing multipliers, what stays finite of it.
    A, B1, C2, D21 : arrays
        The system of the Y equation: A_p, B1_tilde, C2_tilde and D21_tilde, or in the limit those
        of a reduced system.
    R, Gamma : arrays
        (n, n) and (n, m + g), as in Assumption 3.
    feedback : (m + g, n) array
        -G^{-1} Gamma', the estimator's output if it knew the state.
    """

    plant: AugmentedSystem
    tau: float
    multipliers: NDArray[np.float64]
    cost: str
    M_inverse: Matrix
    A: Matrix
    B1: Matrix
    C2: Matrix
    D21: Matrix
    R: Matrix
    Gamma: Matrix
    feedback: Matrix

    @cached_property
    def worst_noise(self) -> Matrix:
        """(n, n) B1_tilde M^{-1} B1_tilde', in the X equation."""
        return self.plant.B1_tilde @ self.M_inverse @ self.plant.B1_tilde.T

    @cached_property
    def correlation(self) -> Matrix:
        """(n, l + g) B1_tilde M^{-1} D21_tilde'."""
        return self.B1 @ self.M_inverse @ self.D21.T

    @cached_property
    def E(self) -> Matrix:
        """(l + g, l + g) E_lambda."""
        return self.D21 @ self.M_inverse @ self.D21.T

    @property
    def Q_X(self) -> Matrix:
        """The constant term of the X equation, R - Gamma G^{-1} Gamma'.

        The cost cancels in it. What is left is written as a square: where there is no uncertainty
        it is zero, and rounding in its place would have no Riccati solution.
        """
        return self.tau * self.worst_output(self.multipliers)

    def worst_output(self, weights: ArrayLike) -> Matrix:
        """Return the constraints' outputs squared and weighted, if the state were known."""
        outputs = self.plant.C1_tilde + self.plant.D12_tilde @ self.feedback
        return sum_of_squares(np.array(self.plant.N_i), weights, outputs)

    def solve_X(self, quadratic_sign: float = 1.0) -> RiccatiSolution:
        """Return the solution of X A_p + A_p' X + Q_X + sign/tau X worst_noise X = 0.

        The theory has `quadratic_sign` 1.
        """
        return solve_riccati(
            self.plant.A_p, self.Q_X, -quadratic_sign / self.tau * self.worst_noise
        )

    def solve_Y(self) -> RiccatiSolution:
        """Return the solution of the first Riccati equation of Assumption 3."""
        C2 = self.C2
        gain = np.linalg.solve(self.E, self.correlation.T)
        return solve_riccati(
            (self.A - self.correlation @ np.linalg.solve(self.E, C2)).T,
            self.B1 @ self.M_inverse @ self.B1.T - self.correlation @ gain,
            C2.T @ np.linalg.solve(self.E, C2) - self.R / self.tau,
        )

    def gains(self, X: Matrix, Y: Matrix) -> tuple[Matrix, Matrix, Matrix, float]:
        """Return A_c, B_c, C_c and V of (eqCparams) and (eqbound)."""
        tau = self.tau
        innovation = Y @ self.C2.T + self.correlation
        B_c = np.linalg.solve(self.E, innovation.T).T
        # inv(I - Y X/tau), symmetric inside: no digit of it depends on the units of the states
        root, identity = square_root(Y), np.eye(len(X))
        coupling = identity + root @ np.linalg.solve(tau * identity - root.T @ X @ root, root.T @ X)
        C_c = self.feedback @ coupling
        A_c = self.A + Y @ self.R / tau - B_c @ self.C2 + Y @ self.Gamma @ C_c / tau
        bound = 0.5 * np.trace(Y @ self.R + B_c @ innovation.T @ X @ coupling)
        return A_c, B_c, C_c, float(bound)


def design_equations(
    plant: AugmentedSystem, tau: float, multipliers: ArrayLike, cost: str = "filtered"
) -> DesignEquations:
    """Return the data of Assumption 3 at one tau and lambda, after checking all but Assumption 3.

    Raises
    ------
    InfeasibleDesignError
        Where Assumption 2, M(lambda) > 0 or the constraint (eqcons) fails.
    ValueError, TypeError
        For a tau that is not positive, multipliers of the wrong length or sign, an unknown cost.
    """
    tau, multipliers, cost = check_arguments(plant, tau, multipliers, cost)
    M = plant.M(multipliers)
    M_inverse = inverse(M)
    check_multiplier_level(plant, M)
    R, G, Gamma = cost_matrices(plant, tau, multipliers, cost)
    return DesignEquations(
        plant=plant,
        tau=tau,
        multipliers=multipliers,
        cost=cost,
        M_inverse=M_inverse,
        A=plant.A_p,
        B1=plant.B1_tilde,
        C2=plant.C2_tilde,
        D21=plant.D21_tilde,
        R=R,
        Gamma=Gamma,
        feedback=-np.linalg.solve(G, Gamma.T),
    )


def cost_matrices(
    plant: AugmentedSystem, tau: float, multipliers: ArrayLike, cost: str
) -> tuple[Matrix, Matrix, Matrix]:
    """Return R, G and Gamma of Assumption 3."""
    g, m, n = plant.system.g, plant.system.m, plant.n
    N, C1, D12 = plant.N(multipliers), plant.C1_tilde, plant.D12_tilde
    C = plant.C_p0 if cost == "filtered" else plant.C_a
    R = C.T @ C + tau * C1.T @ N @ C1
    G = np.diag([1.0] * m + [0.0] * g) + tau * D12.T @ N @ D12
    Gamma = -np.hstack([C.T, np.zeros((n, g))]) + tau * C1.T @ N @ D12
    return R, G, Gamma


def sum_of_squares(matrices: NDArray[np.float64], weights: ArrayLike, outputs: Matrix) -> Matrix:
    """Return the sum of weight times outputs' N outputs, over the matrices N_i of constraints.

    It is formed as a sum of squares, and what cancels in the outputs is zero in it, not rounding.
    """
    parts = matrices @ outputs
    parts[np.abs(parts) < _CANCELLED * (np.abs(matrices) @ np.abs(outputs))] = 0.0
    traces = np.einsum("aii->a", matrices)
    squares = np.einsum("aij,aij->a", matrices, matrices)  # N = n'n, with n n' = (square/trace) I
    scales = np.divide(weights * traces, squares, out=np.zeros_like(traces), where=squares > 0.0)
    return np.einsum("a,aij,aik->jk", scales, parts, parts)


def design_smoother(
    plant: AugmentedSystem, tau: float, multipliers: ArrayLike, cost: str = "filtered"
) -> RobustSmoother:
    r"""Design the robust fixed-lag smoother at given :math:`\tau` and :math:`\lambda`.

    Parameters
    ----------
    plant : AugmentedSystem
        Made by `augment`.
    tau : float
        :math:`\bar\tau > 0`, in seconds times the squared unit of w.
    multipliers : (k + 3g,) sequence
        lambda, not negative: those of the k uncertainties, then for the g nonlinearities those of
        the difference constraints, of the mu constraints and of the mu-tilde constraints.
    cost : {"filtered", "smoothed"}
        Whether the bound is for the filtered error, with :math:`C_{p0}` in R and Gamma as the
        paper's example has it, or for the error against the delay model's output, with :math:`C_a`
        as its text has it.

    Returns
    -------
    RobustSmoother

    Raises
    ------
    InfeasibleDesignError
        Where Assumption 2 or 3, M(lambda) > 0 or the constraint (eqcons) fails; the message says
        which and by how much.
    ValueError, TypeError
        For a tau that is not positive, multipliers of the wrong length or sign, an unknown cost.

    References
    ----------
    Section III: Assumptions 2 and 3, equations (eqcons), (eqCparams) and (eqbound).
    """
    return solve_design(design_equations(plant, tau, multipliers, cost))


def solve_design(equations: DesignEquations) -> RobustSmoother:
    """Solve the equations of a design, after checking Assumption 3."""
    plant = equations.plant
    check_stable_plant(plant)
    Y = nonnegative_solution(ASSUMPTION_Y, equations.solve_Y)
    X = nonnegative_solution(ASSUMPTION_X, equations.solve_X)
    root = square_root(Y.X)
    radius = float(np.abs(np.linalg.eigvalsh(root.T @ X.X @ root)).max())
    if not radius < equations.tau:
        raise InfeasibleDesignError(
            "Assumption 3.3",
            f"rho(YX) = {radius:.4g} is not below tau = {equations.tau:.4g}; a larger tau may help",
        )
    A_c, B_c, C_c, bound = equations.gains(X.X, Y.X)
    return RobustSmoother(
        plant=plant,
        A_c=A_c,
        B_c=B_c,
        C_c=C_c,
        C_a=plant.C_a,
        C_f=C_c[: plant.system.m] if equations.cost == "filtered" else plant.C_p0,
        tau=equations.tau,
        multipliers=equations.multipliers,
        cost=equations.cost,
        X=X.X,
        Y=Y.X,
        certificates={"X": X, "Y": Y},
        bound=bound,
        spectral_radius=radius,
    )


def check_arguments(
    plant: AugmentedSystem, tau: float, multipliers: ArrayLike, cost: str
) -> tuple[float, NDArray[np.float64], str]:
    """Return the clean arguments of a design, after checking Assumption 2, too."""
    validation.instance("plant", plant, AugmentedSystem, MAKE_A_PLANT)
    tau = validation.positive("tau", tau)
    multipliers = weights("multipliers", plant, multipliers)
    cost = validation.choice("cost", cost, COSTS)
    check_measurement_noise(plant)
    return tau, multipliers, cost


def weights(name: str, plant: AugmentedSystem, given: ArrayLike) -> NDArray[np.float64]:
    """Return k + 3g numbers that are not negative."""
    result = validation.array(name, given, ndim=1)
    k, g = plant.system.k, plant.system.g
    if result.size != k + 3 * g:
        raise ValueError(
            f"{name} must have k + 3g = {k} + 3*{g} = {k + 3 * g} entries, got {result.size}"
        )
    if (result < 0.0).any():
        raise ValueError(f"{name} must not be negative, got {result.tolist()}")
    return result


def check_measurement_noise(plant: AugmentedSystem) -> None:
    """Check Assumption 2."""
    check_noise("Assumption 2", plant.D21_bar)


def inverse(M: Matrix) -> Matrix:
    """Return the inverse of M(lambda), or refuse multipliers that make it singular."""
    try:
        return cho_solve(cho_factor(M), np.eye(M.shape[0]))
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(M).min()
        raise InfeasibleDesignError(
            "M(lambda) > 0",
            f"its smallest eigenvalue is {smallest:.3g}; every uncertainty needs a positive "
            "multiplier and every nonlinearity two positive ones (limiting_smoother gives the "
            "limit in which more of them vanish)",
        ) from None


def multiplier_level(plant: AugmentedSystem, M: Matrix) -> float:
    """Return the largest eigenvalue of J'MJ; (eqcons) says that it is at most 1."""
    return float(np.linalg.eigvalsh(plant.J.T @ M @ plant.J).max(initial=0.0))


def check_multiplier_level(plant: AugmentedSystem, M: Matrix) -> None:
    """Check the constraint (eqcons)."""
    level = multiplier_level(plant, M)
    if level > 1.0 + _ROUNDING:
        raise InfeasibleDesignError(
            "The multiplier constraint M(lambda)^-1 >= J J'",
            f"the largest eigenvalue of J'M(lambda)J is {level:.6g}, above 1; divide the "
            f"multipliers by {level:.6g}",
        )


def check_stable_plant(plant: AugmentedSystem) -> None:
    """Check that A is stable: else no nonnegative X exists."""
    abscissa = float(np.linalg.eigvals(plant.system.A).real.max())
    if not abscissa < 0.0:
        raise InfeasibleDesignError(
            ASSUMPTION_X,
            "the system's A must be stable for a nonnegative solution to exist, but it has an "
            f"eigenvalue with real part {abscissa:.3g}; give an integrator a slow decay, or "
            "stabilise the plant first (baselines.kalman_bucy needs no stability)",
        )


def nonnegative_solution(condition: str, solve: Callable[[], RiccatiSolution]) -> RiccatiSolution:
    """Solve one Riccati equation; name the assumption where there is no nonnegative solution."""
    try:
        solution = solve()
    except RiccatiError as error:
        detail = str(error)
    else:
        if solution.smallest_eigenvalue >= -_ROUNDING:
            return solution
        detail = (
            "its stabilising solution is not nonnegative definite: smallest eigenvalue "
            f"{solution.smallest_eigenvalue:.3g} of its norm"
        )
    hint = f"; {_HINTS[condition]}" if condition in _HINTS else ""
    raise InfeasibleDesignError(condition, detail + hint)
