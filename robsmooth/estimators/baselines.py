"""The estimators that the paper compares with or builds on, and the least nominal errors."""

from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from robsmooth._numerics.lyapunov import ERROR_TOLERANCE, check_certainty, covariances, square_root
from robsmooth._numerics.riccati import RiccatiError, solve_riccati
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.systems.augmented import AugmentedSystem, augment, check_noise
from robsmooth.systems.channels import Uncertainty
from robsmooth.systems.delay import DelayModel, pade_delay
from robsmooth.systems.system import UncertainSystem


def kalman_bucy(system: UncertainSystem, copies: bool = False) -> Estimator:
    """Return the Kalman-Bucy filter of the nominal system: all uncertainties and mu zero.

    Parameters
    ----------
    system : UncertainSystem
    copies : bool
        Whether the filter also runs copies of the nonlinearities, at its own estimate. A loop that
        feeds the estimate back, as adaptive homodyne detection does, amounts to that.

    Returns
    -------
    Estimator, for the plant without delay

    Raises
    ------
    InfeasibleDesignError
        For a measurement without noise, or a mode that is neither stable nor seen.

    See Also
    --------
    fixed_lag_smoother, ngcf, linear_robust_filter : with a delay; robust.

    Examples
    --------
    >>> import robsmooth as rs
    >>> estimator = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> print(f"{-estimator.poles[0]:.4g} 1/s")
    4.649e+05 1/s
    """
    return fixed_lag_smoother(system, delay=0.0, order=0, copies=copies)


@one_thread
def fixed_lag_smoother(
    system: UncertainSystem, delay: float, order: int, copies: bool = False
) -> Estimator:
    """Return the stable fixed-lag smoother of Chirarattananon and Anderson for the nominal system.

    Parameters
    ----------
    system : UncertainSystem
    delay, order
        The delay of the smoothed estimate (s), and the Pade order of its model.
    copies
        As in `kalman_bucy`, and what it raises, too.

    Returns
    -------
    Estimator

    See Also
    --------
    minimize_bound, optimal_fixed_lag_error : the robust smoother; what no smoother can beat.

    References
    ----------
    S. Chirarattananon and B. D. O. Anderson, "Stable fixed-lag smoothing of continuous time
    processes", IEEE Trans. Inf. Theory 20(1), 1974.

    Examples
    --------
    >>> import robsmooth as rs
    >>> rs.baselines.fixed_lag_smoother(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, order=2)
    Estimator(3 states, delay=3.1e-06 s, order=2, 1 measurements, 1 outputs, 1 copies)
    """
    plant = augment(system, delay, order)
    _, gain = _kalman(system, plant.delay_model)
    A_c = plant.A_p - gain @ plant.C2_tilde[: system.l]
    return _estimator(plant, A_c, gain, plant.C_p0, copies)


def linear_robust_filter(
    system: UncertainSystem, delay: float = 0.0, order: int = 0
) -> tuple[Estimator, RobustSmoother]:
    """Return the robust filter (or smoother) that runs no copy of the nonlinearities.

    Each nonlinearity becomes an uncertainty, bounded by its Lipschitz constant; the design is then
    that of `minimize_bound`, which says what it raises.

    Parameters
    ----------
    system, delay, order
        As in `fixed_lag_smoother`; no delay by default.

    Returns
    -------
    estimator : Estimator
        On the plant of `system`, so that it can be compared with the others.
    design : RobustSmoother
        The same on the plant with the nonlinearities as uncertainties, with its bound.

    See Also
    --------
    ngcf : the same with copies.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import robsmooth as rs
    >>> system = replace(rs.homodyne.PAPER, gamma=0.05).uncertain_system()
    >>> estimator, design = rs.baselines.linear_robust_filter(system)
    >>> round(design.mean_square_bound, 3), round(rs.baselines.ngcf(system).mean_square_bound, 3)
    (0.291, 0.127)
    """
    validation.instance("system", system, UncertainSystem)
    sectors = tuple(Uncertainty(c.B, c.lipschitz * c.C, c.D) for c in system.nonlinearities)
    linear = replace(system, uncertainties=(*system.uncertainties, *sectors), nonlinearities=())
    design = minimize_bound(augment(linear, delay, order), "filtered")
    plant = augment(system, delay, order)
    return _estimator(plant, design.A_c, design.B_c, design.C_c), design


def ngcf(system: UncertainSystem) -> RobustSmoother:
    """Return the nonlinear guaranteed cost filter: `minimize_bound` without delay.

    Parameters
    ----------
    system : UncertainSystem

    Returns
    -------
    RobustSmoother

    See Also
    --------
    minimize_bound, linear_robust_filter : with a delay; without copies.

    References
    ----------
    I. R. Petersen, "Robust guaranteed cost state estimation for nonlinear stochastic uncertain
    systems via an IQC approach", Systems & Control Letters 58(11), 2009.

    Examples
    --------
    >>> import robsmooth as rs
    >>> round(rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system()).mean_square_bound, 4)
    0.2434
    """
    return minimize_bound(augment(system, 0.0, 0))


@one_thread
def optimal_fixed_lag_error(system: UncertainSystem, delay: float) -> Matrix:
    r"""Return the exact optimal fixed-lag error covariance of the nominal linear system.

    With the Kalman filter's P, gain and :math:`A_f = A - K C_2`, observing for a further time
    :math:`\delta` removes :math:`P\int_0^\delta e^{A_f's} C_2' R^{-1} C_2 e^{A_f s}\,ds\,P`.

    Parameters
    ----------
    system : UncertainSystem
    delay : float, s, at least zero; infinity is two-sided smoothing

    Returns
    -------
    (m, m) array, in the squared unit of w

    Raises
    ------
    InfeasibleDesignError, ArithmeticError
        As in `kalman_bucy`; where the filter's time constants are so far apart that rounding would
        spoil the result.

    See Also
    --------
    fixed_lag_smoother, optimal_two_sided_error : what comes close; the same for an endless delay.

    References
    ----------
    T. Kailath and P. Frost, "An innovations approach to least-squares estimation, part II", IEEE
    Trans. Autom. Control 13(6), 1968.

    Examples
    --------
    >>> import robsmooth as rs
    >>> rs.baselines.optimal_fixed_lag_error(rs.homodyne.PAPER.uncertain_system(), 3.1e-6).round(4)
    array([[0.0453]])
    """
    validation.instance("system", system, UncertainSystem)
    two_sided = np.ndim(delay) == 0 and delay == np.inf
    if not two_sided:
        delay = validation.real("delay", delay, low=0.0)
    P, gain = _kalman(system, pade_delay(0.0, 0, system.m))
    A_f = system.A - gain @ system.C2
    noise = np.linalg.cholesky(system.D21 @ system.D21.T)
    rate = solve_triangular(noise, system.C2, lower=True).T  # a root of C2' R^-1 C2
    found = covariances(A_f.T, rate, 0.0 if two_sided else delay)
    information = found.stationary if two_sided else found.grown
    root = square_root(P)
    known, directions = np.linalg.eigh(root.T @ information @ root)
    uncertain = max(np.linalg.norm(root.T @ found.error @ root, 2), known.max() - 1.0)
    if not uncertain <= ERROR_TOLERANCE:
        raise ArithmeticError(
            f"what the delay takes off the filter's error is certain to {uncertain:.2g} of that "
            "only: the time constants of the filter are too far apart"
        )
    remaining = system.C0 @ root @ directions * np.sqrt(np.maximum(1.0 - known, 0.0))
    return remaining @ remaining.T


def optimal_two_sided_error(system: UncertainSystem) -> Matrix:
    """Return `optimal_fixed_lag_error` with the whole past and future: the floor of any delay.

    Parameters
    ----------
    system : UncertainSystem

    Returns
    -------
    (m, m) array

    See Also
    --------
    optimal_fixed_lag_error

    Examples
    --------
    >>> import robsmooth as rs
    >>> rs.baselines.optimal_two_sided_error(rs.homodyne.PAPER.uncertain_system()).round(4)
    array([[0.043]])
    """
    return optimal_fixed_lag_error(system, np.inf)


def _kalman(system: UncertainSystem, model: DelayModel) -> tuple[Matrix, Matrix]:
    """Return covariance and gain of the Kalman-Bucy filter of a system with a delay model behind.

    The covariance is that of the errors of x and of the model's state with the error of x. Of the
    Riccati solution only the gain is used: a covariance that follows from the gain cannot be
    negative, and its own error is that of the gain squared (Kleinman's step, in Joseph's form). As
    no measurement sees the model, nor does the model feed back, it needs no equation of its own.
    """
    A, B, C, D = system.A, system.B1, system.C2, system.D21
    check_noise("The Kalman-Bucy filter's condition D21 D21' > 0", D)
    R, cross = cho_factor(D @ D.T), B @ D.T
    uncorrelated = B - cross @ cho_solve(R, D)
    try:
        P = solve_riccati(
            (A - cross @ cho_solve(R, C)).T, uncorrelated @ uncorrelated.T, C.T @ cho_solve(R, C)
        ).X
    except RiccatiError as error:
        condition = "The Kalman-Bucy filter's Riccati equation"
        raise InfeasibleDesignError(condition, str(error)) from None
    gain = cho_solve(R, C @ P + cross.T).T
    states = len(model.F)
    drift = np.block([[A - gain @ C, np.zeros((system.n, states))], [model.G @ system.C0, model.F]])
    noise = np.vstack([B - gain @ D, np.zeros((states, system.q))])
    found, x = covariances(drift, noise), slice(system.n)
    check_certainty("the filter's error", found.stationary[x, x], found.error[x, x])
    P = found.stationary[:, x]
    cross = np.vstack([cross, np.zeros((states, system.l))])
    return P, cho_solve(R, (P @ C.T + cross).T).T


def _estimator(
    plant: AugmentedSystem, A_c: Matrix, gain: Matrix, C_w: Matrix, copies: bool = False
) -> Estimator:
    """Return an estimator of w = C_w x that runs the nonlinearities at its estimate, or not."""
    B, C, D = plant.system.stacked(plant.system.nonlinearities)
    states = plant.n - plant.system.n
    into, arguments = np.pad(B, ((0, states), (0, 0))) - gain @ D, np.pad(C, ((0, 0), (0, states)))
    if not copies:
        into, arguments = np.zeros_like(into), np.zeros_like(arguments)
    B_c, C_c = np.hstack([gain, into]), np.vstack([C_w, arguments])
    return Estimator(plant=plant, A_c=A_c, B_c=B_c, C_c=C_c, C_a=plant.C_a, C_f=C_w)
