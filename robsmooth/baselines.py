r"""The estimators that the paper compares with or builds on, each as a system of its own.

============================  ====================================================================
Kalman-Bucy filter            optimal for the nominal linear system
fixed-lag smoother            Chirarattananon and Anderson: the Kalman filter of the system with its
                              delay model, which is the Kalman-Bucy filter followed by a smoother
linear robust filter          the robust design with the nonlinearities as plain uncertainties: the
                              estimator has no copy of them
NGCF                          the nonlinear guaranteed cost filter: the paper's design without lag
exact optimal errors          what no fixed-lag or two-sided linear smoother can beat, nominally
============================  ====================================================================
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from robsmooth import validation
from robsmooth.augmented import AugmentedSystem, augment, compact
from robsmooth.bound import minimize_bound
from robsmooth.errors import InfeasibleDesignError
from robsmooth.estimator import Estimator
from robsmooth.riccati import RiccatiError, solve_riccati
from robsmooth.smoother import RobustSmoother
from robsmooth.systems import UncertainSystem, Uncertainty
from robsmooth.validation import Matrix


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
    Estimator
        For the plant without delay.

    Raises
    ------
    InfeasibleDesignError
        Where the filter does not exist: a measurement without noise, or a mode that is neither
        stable nor seen.
    """
    return fixed_lag_smoother(system, delay=0.0, order=0, copies=copies)


def fixed_lag_smoother(
    system: UncertainSystem, delay: float, order: int, copies: bool = False
) -> Estimator:
    """Return the stable fixed-lag smoother of Chirarattananon and Anderson for the nominal system.

    Parameters
    ----------
    system : UncertainSystem
    delay : float
        The lag in seconds.
    order : int
        Pade order of the delay model.
    copies : bool
        As in `kalman_bucy`.

    Returns
    -------
    Estimator

    Raises
    ------
    InfeasibleDesignError
        As in `kalman_bucy`.

    References
    ----------
    S. Chirarattananon and B. D. O. Anderson, "Stable fixed-lag smoothing of continuous time
    processes", IEEE Trans. Inf. Theory 20(1), 1974.
    """
    plant = compact(system, delay, order)
    A, C2 = plant.A_p, plant.C2_tilde[: system.l]
    _, gain = _kalman(A, plant.B_p1[:, : system.q], C2, system.D21)
    estimator = _linear_estimator(plant, A - gain @ C2, gain, plant.C_p0)
    return _with_copies(estimator, gain) if copies else estimator


def linear_robust_filter(
    system: UncertainSystem, delay: float = 0.0, order: int = 0
) -> tuple[Estimator, RobustSmoother]:
    """Return the robust filter (or smoother) that runs no copy of the nonlinearities.

    Each nonlinearity becomes an uncertainty, bounded by its Lipschitz constant; the design is then
    that of `minimize_bound`.

    Parameters
    ----------
    system : UncertainSystem
    delay, order
        The lag (s) and the Pade order of its model; none by default.

    Returns
    -------
    estimator : Estimator
        On the plant of `system`, so that it can be compared with the others.
    design : RobustSmoother
        The same on the plant with the nonlinearities as uncertainties, with its bound.

    Raises
    ------
    InfeasibleDesignError
        Where no design was found.
    """
    validation.instance("system", system, UncertainSystem)
    sectors = tuple(Uncertainty(c.B, c.lipschitz * c.C, c.D) for c in system.nonlinearities)
    linear = replace(system, uncertainties=(*system.uncertainties, *sectors), nonlinearities=())
    design = minimize_bound(augment(linear, delay, order))
    plant = compact(system, delay, order)
    return _linear_estimator(plant, design.A_c, design.B_c, design.C_c), design


def ngcf(system: UncertainSystem) -> RobustSmoother:
    """Return the nonlinear guaranteed cost filter: the paper's design without delay.

    Parameters
    ----------
    system : UncertainSystem

    Returns
    -------
    RobustSmoother

    References
    ----------
    I. R. Petersen, "Robust guaranteed cost state estimation for nonlinear stochastic uncertain
    systems via an IQC approach", Systems & Control Letters 58(11), 2009.
    """
    return minimize_bound(augment(system, 0.0, 0))


def optimal_fixed_lag_error(system: UncertainSystem, lag: float) -> Matrix:
    r"""Return the exact optimal fixed-lag error covariance of the nominal linear system.

    With the Kalman filter's P, gain and :math:`A_f = A - K C_2`, observing for a further lag
    :math:`\delta` removes :math:`P\int_0^\delta e^{A_f's} C_2' R^{-1} C_2 e^{A_f s}\,ds\,P`.

    Parameters
    ----------
    system : UncertainSystem
    lag : float
        In seconds, at least zero; infinity is two-sided smoothing.

    Returns
    -------
    (m, m) array
        In the squared unit of w.

    References
    ----------
    T. Kailath and P. Frost, "An innovations approach to least-squares estimation, part II", IEEE
    Trans. Autom. Control 13(6), 1968.
    """
    validation.instance("system", system, UncertainSystem)
    two_sided = np.ndim(lag) == 0 and lag == np.inf
    if not two_sided:
        lag = validation.real("lag", lag, low=0.0)
    P, gain = _kalman(system.A, system.B1, system.C2, system.D21)
    A_f = system.A - gain @ system.C2
    R = system.D21 @ system.D21.T
    information = solve_continuous_lyapunov(A_f.T, -system.C2.T @ np.linalg.solve(R, system.C2))
    if not two_sided:
        decay = expm(A_f * lag)
        information = information - decay.T @ information @ decay
    return system.C0 @ (P - P @ information @ P) @ system.C0.T


def optimal_two_sided_error(system: UncertainSystem) -> Matrix:
    """Return the error covariance with the whole past and future: the floor of any lag.

    Parameters
    ----------
    system : UncertainSystem

    Returns
    -------
    (m, m) array
        In the squared unit of w.
    """
    return optimal_fixed_lag_error(system, np.inf)


def _kalman(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> tuple[Matrix, Matrix]:
    """Return error covariance and gain of the Kalman-Bucy filter, noises correlated or not."""
    R = D @ D.T
    size = np.sqrt(np.diag(R))
    if (size == 0.0).any() or not np.linalg.eigvalsh(R / np.outer(size, size)).min() > 1e-12:
        raise InfeasibleDesignError(
            "The Kalman-Bucy filter's condition D21 D21' > 0",
            "some combination of the measurements has no noise",
        )
    cross = B @ D.T
    information = np.linalg.solve(R, C)
    try:
        solution = solve_riccati(
            (A - cross @ information).T,
            B @ B.T - cross @ np.linalg.solve(R, cross.T),
            C.T @ information,
        )
    except RiccatiError as error:
        raise InfeasibleDesignError(
            "The Kalman-Bucy filter's Riccati equation", str(error)
        ) from None
    P = solution.X
    return P, np.linalg.solve(R, (P @ C.T + cross).T).T


def _linear_estimator(plant: AugmentedSystem, A_c: Matrix, gain: Matrix, C_w: Matrix) -> Estimator:
    """Return an estimator of w = C_w x that runs no copies: their gains are zero."""
    g = plant.system.g
    return Estimator(
        plant=plant,
        A_c=A_c,
        B_c=np.hstack([gain, np.zeros((plant.n, g))]),
        C_c=np.vstack([C_w, np.zeros((g, plant.n))]),
        C_a=plant.C_a,
        C_f=C_w,
    )


def _with_copies(estimator: Estimator, gain: Matrix) -> Estimator:
    """Return the linear estimator with each nonlinearity run at the estimate."""
    plant, g = estimator.plant, estimator.plant.system.g
    nonlinearities = plant.system.nonlinearities
    first = sum(plant.input_sizes) - 2 * g
    into_state = plant.B1_tilde[:, first : first + g]
    into_measurement = np.hstack([np.zeros((plant.system.l, 0)), *(c.D for c in nonlinearities)])
    outputs = plant.C1_tilde[sum(plant.output_sizes) - 2 * g :][:g]
    return replace(
        estimator,
        B_c=np.hstack([gain, into_state - gain @ into_measurement]),
        C_c=np.vstack([estimator.C_f, outputs]),
    )
