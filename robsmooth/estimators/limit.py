r"""The limit of designs in which multipliers vanish until M(lambda) is singular.

Where both multipliers of a nonlinearity and of its copy go to zero, and only that of their
difference stays, the bound may fall all the way, and no design attains its infimum. The limit is a
design all the same, and computed here as such, without a small number.

With :math:`\lambda(\varepsilon) = \lambda + \varepsilon\rho`, let the columns of U span the kernel
of :math:`M(\lambda)`, let :math:`F = U(U'M(\rho)U)^{-1/2}`, and let :math:`M_f` be the inverse of
:math:`M(\lambda)` on the complement of the kernel. Then

.. math:: M(\lambda(\varepsilon))^{-1} = \tfrac1\varepsilon FF' + M_f + O(\varepsilon).

Along F the noise of the channels has no bound: all that is known of them is what the measurement
says, in which they appear as :math:`d = \tilde D_{21}F`, and in the state as
:math:`b = \tilde B_1F`. With any L, :math:`L'd = I`, they become a *known input*
:math:`bL'\,d\tilde y`. The rest of the measurement, :math:`N'd\tilde y` with N a basis of
:math:`N'd = 0`, serves a design of the ordinary kind, with :math:`M_f` for :math:`M^{-1}`, for the
reduced system

.. math::

    A_p - bL'\tilde C_2,\qquad \tilde B_1 - bL'\tilde D_{21},\qquad N'\tilde C_2,\qquad
    N'\tilde D_{21}.

For a nonlinearity and its copy this is the *nonlinear observer*: it feeds the copy's output into
its model of the state and of the measurement, as if it were the nonlinearity itself, and is robust
against their difference alone.

The X equation is that of the plant, not of the reduced system, with :math:`M_f` for
:math:`M^{-1}`. Its solution :math:`X_0` must satisfy :math:`X_0b = 0`, else the bound grows without
limit. Next to the limit :math:`X = X_0 + \varepsilon x + \dots`, with x the stabilising solution of

.. math:: x\hat A + \hat A'x + \tfrac1\tau xbb'x + q = 0,\qquad
    \hat A = A_p + \tfrac1\tau\tilde B_1M_f\tilde B_1'X_0,

with q the derivative in :math:`\varepsilon` of the X equation's constant term. The bound is that of
the reduced design, plus :math:`\tfrac12\operatorname{tr}(b'xb)`, which depends on the ratios of the
rates rho; where no vanishing channel enters the state, it is zero.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import null_space

from robsmooth._numerics.riccati import RiccatiSolution, solve_riccati
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.smoother import (
    ASSUMPTION_X,
    DesignEquations,
    RobustSmoother,
    check_arguments,
    check_multiplier_level,
    cost_matrices,
    design_smoother,
    nonnegative_solution,
    solve_design,
    weights,
)
from robsmooth.systems.augmented import AugmentedSystem

_NOTHING = 1e-10  # what is below this, relative to its size, is rounding


@dataclass(frozen=True, eq=False)
class Reduction:
    """What is left of a plant's channels and measurements as some multipliers vanish.

    Attributes
    ----------
    kernel : (r + 2g, c) array
        U: orthonormal directions of the channels on which M(lambda) vanishes.
    rest : (r + 2g, r + 2g - c) array
        An orthonormal basis of the other directions.
    known : (l + g, c) array
        L, by which the extended measurement tells the component along the kernel.
    measured : (l + g, l + g - c) array
        N, the combinations of the measurements that the kernel does not touch.
    A, B1, C2, D21 : arrays
        The reduced system, its channels still all r + 2g.
    entering : (n, c) array
        B1_tilde U: how the vanishing channels enter the state.
    """

    kernel: Matrix
    rest: Matrix
    known: Matrix
    measured: Matrix
    A: Matrix
    B1: Matrix
    C2: Matrix
    D21: Matrix
    entering: Matrix


def kernel_of(plant: AugmentedSystem, multipliers: ArrayLike) -> Matrix:
    """Return an orthonormal basis of the kernel of M(lambda)."""
    kernel = null_space(plant.M(np.asarray(multipliers) > 0.0))  # whatever their sizes
    kernel[np.abs(kernel) < _NOTHING] = 0.0
    return kernel


def reduction(plant: AugmentedSystem, multipliers: ArrayLike) -> Reduction:
    """Return the system that is left where M(lambda) is singular.

    Raises
    ------
    InfeasibleDesignError
        Where noise without limit would enter the state, and no measurement would tell of it.
    """
    B1, C2, D21 = plant.B1_tilde, plant.C2_tilde, plant.D21_tilde
    kernel = kernel_of(plant, multipliers)
    size = np.sqrt(np.diag(plant.D21_bar @ plant.D21_bar.T))[:, None]  # of each measurement
    seen = D21 @ kernel / size
    # Directions that no measurement sees are of no account, if they do not enter the state either.
    unseen = null_space(seen, rcond=_NOTHING)
    hidden = kernel @ unseen
    if (np.abs(B1 @ hidden) > _NOTHING * (np.abs(B1) @ np.abs(hidden))).any():
        raise InfeasibleDesignError(
            "M(lambda) > 0",
            "in the limit of these multipliers noise without bound enters the state through a "
            "channel that no measurement sees; its multiplier must be positive",
        )
    rest = null_space(kernel.T)
    kernel = kernel @ null_space(unseen.T)
    d = D21 @ kernel / size
    known = np.linalg.pinv(d).T / size
    measured = null_space(d.T) / size
    through = B1 @ kernel @ known.T
    return Reduction(
        kernel=kernel,
        rest=rest,
        known=known,
        measured=measured,
        A=plant.A_p - through @ C2,
        B1=B1 - through @ D21,
        C2=measured.T @ C2,
        D21=measured.T @ D21,
        entering=B1 @ kernel,
    )


def default_rates(plant: AugmentedSystem, multipliers: ArrayLike) -> NDArray[np.float64]:
    """Return one for each zero among the multipliers that makes M(lambda) singular, else zero."""
    multipliers = np.asarray(multipliers)
    kernel = kernel_of(plant, multipliers)
    touched = [np.linalg.norm(M @ kernel) > _NOTHING for M in plant.M_i]
    return np.where((multipliers == 0.0) & touched, 1.0, 0.0)


@one_thread
def limiting_smoother(
    plant: AugmentedSystem,
    tau: float,
    multipliers: ArrayLike,
    cost: str = "filtered",
    *,
    rates: ArrayLike | None = None,
) -> RobustSmoother:
    r"""Design the smoother in the limit where the zeros among the multipliers are approached.

    It is the limit of `design_smoother` at :math:`\lambda + \varepsilon\rho` as
    :math:`\varepsilon \to 0`, gains and bound, computed where :math:`\varepsilon = 0`. Its
    guarantee is the limit of theirs: whatever the admissible uncertainty, the loops of those
    designs keep half their mean square errors below bounds that tend to this one, and a stable
    loop's error is a continuous function of the gains.

    Parameters
    ----------
    plant : AugmentedSystem
        Made by `augment`.
    tau : float
        :math:`\bar\tau > 0`, in seconds times the squared unit of w.
    multipliers : (k + 3g,) sequence
        lambda, as for `design_smoother`, with zeros for those that vanish. Where M(lambda) is
        positive all the same, there is no limit to take: the design is that of `design_smoother`.
    cost : {"filtered", "smoothed"}
        The error that the bound is for, as in `design_smoother`.
    rates : (k + 3g,) sequence, optional
        :math:`\rho \ge 0`, how fast the zeros are approached, relative to each other; only those of
        vanishing multipliers count. By default one for all that make M(lambda) singular. Rates
        matter where two or more nonlinearities that enter the state vanish.

    Returns
    -------
    RobustSmoother
        X is the limit of X, and the certificate "x" that of its derivative.

    Raises
    ------
    InfeasibleDesignError
        Where Assumption 2 or 3 or the constraint (eqcons) fails in the limit, or the bound grows
        without limit towards it.
    ValueError, TypeError
        For bad arguments, as `design_smoother`; for rates that leave M(lambda) singular.

    References
    ----------
    Section III: Assumptions 2 and 3, equations (eqcons), (eqCparams) and (eqbound).
    """
    tau, multipliers, cost = check_arguments(plant, tau, multipliers, cost)
    zero = multipliers == 0.0
    if rates is None:
        rates = default_rates(plant, multipliers)
    rates = np.where(zero, weights("rates", plant, rates), 0.0)
    check_multiplier_level(plant, plant.M(multipliers))
    reduced = reduction(plant, multipliers)
    if reduced.rest.shape[1] == plant.B1_tilde.shape[1]:
        return design_smoother(plant, tau, multipliers, cost)
    S = reduced.kernel.T @ plant.M(rates) @ reduced.kernel
    if S.size and not np.linalg.eigvalsh(S).min() > 0.0:
        raise ValueError(
            "rates must be positive for enough of the vanishing multipliers to make M positive, "
            f"got {rates.tolist()}"
        )
    equations = _reduced_equations(plant, tau, multipliers, rates, cost, reduced)
    design = solve_design(equations)
    b = reduced.entering
    spread = b @ np.linalg.solve(S, b.T)  # b b' of the module's text
    _check_X(design.X, spread)
    x = _first_order(equations, design.X, spread, rates)
    return replace(
        design,
        B_c=design.B_c @ reduced.measured.T + b @ reduced.known.T,
        bound=design.bound + 0.5 * float(np.trace(spread @ x.X)),
        certificates={**design.certificates, "x": x},
    )


def _reduced_equations(
    plant: AugmentedSystem,
    tau: float,
    multipliers: np.ndarray,
    rates: np.ndarray,
    cost: str,
    reduced: Reduction,
) -> DesignEquations:
    """Return the data of the design in the limit, with the reduced system in the Y equation."""
    R, G, Gamma = cost_matrices(plant, tau, multipliers, cost)
    # The argument of a copy of which no multiplier is left depends on the rates alone.
    copies = np.diag(G) == 0.0
    _, G_rates, Gamma_rates = cost_matrices(plant, tau, rates, cost)
    feedback = -np.linalg.solve(
        np.where(copies[:, None], G_rates, G), np.where(copies, Gamma_rates, Gamma).T
    )
    M_f = reduced.rest @ np.linalg.solve(
        reduced.rest.T @ plant.M(multipliers) @ reduced.rest, reduced.rest.T
    )
    return DesignEquations(
        plant=plant,
        tau=tau,
        multipliers=multipliers,
        cost=cost,
        M_inverse=M_f,
        A=reduced.A,
        B1=reduced.B1,
        C2=reduced.C2,
        D21=reduced.D21,
        R=R,
        Gamma=Gamma,
        feedback=feedback,
    )


def _check_X(X: Matrix, spread: Matrix) -> None:
    """Check that X0 b = 0."""
    if np.trace(spread @ X) > _NOTHING * np.sum(np.abs(spread) * np.abs(X)):
        raise InfeasibleDesignError(
            ASSUMPTION_X,
            "towards the limit of these multipliers the bound grows without limit, because the "
            "remaining uncertainty acts on states that a vanishing channel's noise enters",
        )


def _first_order(
    equations: DesignEquations, X: Matrix, spread: Matrix, rates: np.ndarray
) -> RiccatiSolution:
    """Return x, the derivative of X in the limit."""
    plant, tau = equations.plant, equations.tau
    q = tau * equations.worst_output(rates)
    drift = plant.A_p + equations.worst_noise @ X / tau
    return nonnegative_solution(
        f"{ASSUMPTION_X} in the limit",
        lambda: solve_riccati(drift, q, -spread / tau),
    )
