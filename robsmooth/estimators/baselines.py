"""The estimators that the paper compares with or builds on, and the least nominal errors."""

import math
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from robsmooth._numerics.lyapunov import ERROR_TOLERANCE, covariances, square_root
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.validation import Matrix
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.constant import cut_at_one
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.kalman import kalman_gain
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.estimators.tuned import classical
from robsmooth.estimators.tuned import tuned_fixed_lag_smoother as tuned_fixed_lag_smoother
from robsmooth.systems.augmented import augment
from robsmooth.systems.channels import with_feedback
from robsmooth.systems.system import UncertainSystem

_CORNERS = 4  # of the set of uncertainties: a search starts there and at their opposites


def kalman_bucy(system: UncertainSystem, copies: bool = False) -> Estimator:
    """Return the Kalman-Bucy filter of the nominal system: all uncertainties and mu zero.

    Parameters
    ----------
    system : UncertainSystem
    copies : bool
        Whether the filter also runs copies of the nonlinearities at its own estimate, as a loop
        that feeds the estimate back does: adaptive homodyne detection, for example.

    Raises
    ------
    InfeasibleDesignError
        For a measurement without noise, or a mode that is neither stable nor seen.

    Examples
    --------
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

    Source: S. Chirarattananon and B. D. O. Anderson, "Stable fixed-lag smoothing of continuous
    time processes", IEEE Trans. Inf. Theory 20(1), 1974.

    Parameters
    ----------
    system : UncertainSystem
    delay, order : float and int, the delay of the smoothed estimate (s), its model's Pade order
    copies : as in `kalman_bucy`, with the same exceptions

    Examples
    --------
    >>> rs.baselines.fixed_lag_smoother(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, order=2)
    Estimator(3 states, 1 measurements, 1 outputs, 1 copies, delay=3.1e-06 s, order=2)
    """
    return classical(augment(system, delay, order), validation.boolean("copies", copies))


def ngcf(system: UncertainSystem) -> RobustSmoother:
    """Return the nonlinear guaranteed cost filter: `minimize_bound` without delay.

    Source: I. R. Petersen, "Robust guaranteed cost state estimation for nonlinear stochastic
    uncertain systems via an IQC approach", Systems & Control Letters 58(11), 2009.

    Parameters
    ----------
    system : UncertainSystem

    Examples
    --------
    >>> round(rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system()).mean_square_bound, 4)
    0.2434
    """
    return minimize_bound(augment(system, 0.0, 0))


@one_thread
def optimal_fixed_lag_error(system: UncertainSystem, delay: float) -> Matrix:
    r"""Return the exact optimal fixed-lag error covariance of the nominal linear system.

    With the Kalman filter's P, gain and :math:`A_f = A - K C_2`, observing for a further time
    :math:`\delta` removes :math:`P\int_0^\delta e^{A_f's} C_2' R^{-1} C_2 e^{A_f s}\,ds\,P`.

    Source: T. Kailath and P. Frost, "An innovations approach to least-squares estimation, part
    II", IEEE Trans. Autom. Control 13(6), 1968.

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
        As in `kalman_bucy`; where the filter's time constants are too far apart for the precision.

    Examples
    --------
    >>> rs.baselines.optimal_fixed_lag_error(rs.homodyne.PAPER.uncertain_system(), 3.1e-6).round(4)
    array([[0.0453]])
    """
    validation.instance("system", system, UncertainSystem)
    two_sided = isinstance(delay, float) and delay == np.inf
    if not two_sided:
        delay = validation.real("delay", delay, low=0.0)
    P, gain = kalman_gain(system)
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
            "the time constants of the filter are too far apart: the effect of the delay on its "
            f"error is known to {uncertain:.2g} of that error only"
        )
    remaining = system.C0 @ root @ directions * np.sqrt(np.maximum(1.0 - known, 0.0))
    return remaining @ remaining.T


def optimal_two_sided_error(system: UncertainSystem) -> Matrix:
    """Return `optimal_fixed_lag_error` with the whole past and future, the least for any delay.

    Parameters
    ----------
    system : UncertainSystem

    Returns
    -------
    (m, m) array

    Examples
    --------
    >>> rs.baselines.optimal_two_sided_error(rs.homodyne.PAPER.uncertain_system()).round(4)
    array([[0.043]])
    """
    return optimal_fixed_lag_error(system, np.inf)


@one_thread
def worst_optimal_error(system: UncertainSystem, delay: float) -> float:
    """Return the largest mean square error of an estimator that knows a constant uncertainty.

    A search maximises `optimal_fixed_lag_error` over the systems that the uncertainty makes. No
    estimator has a lower worst constant error.

    Parameters
    ----------
    system, delay : as in `optimal_fixed_lag_error`, with the same exceptions

    Returns
    -------
    float, in the squared unit of w

    Examples
    --------
    >>> round(rs.baselines.worst_optimal_error(rs.homodyne.PAPER.uncertain_system(), 3.1e-6), 5)
    0.08358
    """
    nominal = float(np.trace(optimal_fixed_lag_error(system, delay)))
    channels = [(c, 1.0) for c in system.uncertainties if c.C.any()]
    channels += [(c, c.lipschitz) for c in system.nonlinearities]
    if not channels:
        return nominal
    shapes = [(c.B.shape[1], len(c.C)) for c, _ in channels]
    sizes = [rows * columns for rows, columns in shapes]

    def gain(entries: np.ndarray) -> float:
        A, C2, ends = system.A, system.C2, np.cumsum(sizes)[:-1]
        for (c, size), part, shape in zip(channels, np.split(entries, ends), shapes, strict=True):
            A, C2 = with_feedback(A, C2, c, size * cut_at_one(part.reshape(shape)) @ c.C)
        return -math.log(np.trace(optimal_fixed_lag_error(replace(system, A=A, C2=C2), delay)))

    corners = np.random.default_rng(0).choice((-1.0, 1.0), (_CORNERS, sum(sizes)))
    starts = np.vstack([np.zeros(sum(sizes)), np.unique(np.vstack([corners, -corners]), axis=0)])
    box = [(-1.0, 1.0)] * sum(sizes)
    least = min(minimize(gain, start, method="L-BFGS-B", bounds=box).fun for start in starts)
    return math.exp(-least)
