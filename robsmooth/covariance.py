r"""Closed loop and stationary error covariance (Section III-A).

With the uncertainty :math:`\tilde\xi = \Delta\tilde\zeta`, the plant and the estimator form
:math:`dX = \mathbf A X\,dt + \mathbf B\,dW`; its stationary covariance :math:`\mathbf P` solves
:math:`\mathbf{AP} + \mathbf{PA}' + \mathbf{BB}' = 0`, and the smoothed error is (eqCo), with the
transposes that the paper leaves out,

.. math::

    P_{sa} = C\mathbf P C' - C_s e^{\mathbf A\delta}\mathbf P C' -
             (C_s e^{\mathbf A\delta}\mathbf P C')' + C_s\mathbf P C_s', \qquad
    C = [C_{p0}\; 0],\quad C_s = [0\; C_a].

The paper drives the copies with the fictitious noise of the design. A real loop has no such noise:
`copy_noise=False` leaves it out.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.optimize import brentq

from robsmooth import validation
from robsmooth.augmented import AugmentedSystem
from robsmooth.blas import one_thread
from robsmooth.errors import UnstableLoopError
from robsmooth.estimator import Estimator
from robsmooth.validation import Matrix

OUTPUTS = ("smoothed", "filtered")
_RESIDUAL_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The loop dX = A X dt + B dW of plant and estimator, X = [x_p; x_hat], asymptotically stable.

    Attributes
    ----------
    A : (N, N) array
        Drift, 1/s.
    B : (N, q + g) array
        Noise intensity.
    estimator : Estimator
    """

    A: Matrix
    B: Matrix
    estimator: Estimator

    def covariance(self) -> Matrix:
        """Return the stationary covariance P of X, checked by its residual."""
        Q = self.B @ self.B.T
        P = solve_continuous_lyapunov(self.A, -Q)
        P = (P + P.T) / 2
        residual = np.linalg.norm(self.A @ P + P @ self.A.T + Q)
        if not residual <= _RESIDUAL_TOLERANCE * 2 * np.linalg.norm(self.A) * np.linalg.norm(P):
            raise ArithmeticError(
                f"the Lyapunov equation of the closed loop was solved to {residual:.2g} only"
            )
        return P

    def error_covariance(self, output: str) -> Matrix:
        """Return the (m, m) stationary covariance of the smoothed or filtered error."""
        plant = self.estimator.plant
        P = self.covariance()
        truth = np.hstack([plant.C_p0, np.zeros_like(self.estimator.C_f)])
        if output == "filtered":
            error = truth - np.hstack([np.zeros_like(plant.C_p0), self.estimator.C_f])
            return error @ P @ error.T
        estimate = np.hstack([np.zeros_like(plant.C_p0), self.estimator.C_a])
        cross = estimate @ expm(self.A * plant.delay) @ P @ truth.T
        return truth @ P @ truth.T - cross - cross.T + estimate @ P @ estimate.T


def closed_loop(
    estimator: Estimator,
    Delta: ArrayLike,
    copy_noise: bool = True,
    allow_inadmissible: bool = False,
) -> ClosedLoop:
    r"""Close the loop of an estimator and its plant under a constant uncertainty.

    Parameters
    ----------
    estimator : Estimator
        Any design of this package.
    Delta : (r + 2g, h + 2g) array
        :math:`\tilde\xi = \Delta\tilde\zeta`, of norm at most one with the outputs of the
        nonlinearities weighted by their Lipschitz constants. That is necessary to be
        admissible, not sufficient: the bound of a design is for the block-diagonal ones with the
        same slope for a nonlinearity and its copy, which `AugmentedSystem.structured_delta` makes.
    copy_noise : bool
        Whether the design's fictitious noise drives the copies of the nonlinearities.
    allow_inadmissible : bool
        Whether a Delta with norm above one is let through.

    Returns
    -------
    ClosedLoop

    Raises
    ------
    UnstableLoopError
        Where the closed loop is not asymptotically stable.
    ValueError, TypeError
        For a Delta of the wrong shape or with norm above one.

    References
    ----------
    Section III-A, equation (eqclosed).
    """
    validation.instance("smoother", estimator, Estimator)
    plant = estimator.plant
    B1, C1, D12 = plant.B1_tilde, plant.C1_tilde, plant.D12_tilde
    Delta = validation.matrix("Delta", Delta, (B1.shape[1], C1.shape[0]))
    norm = np.linalg.norm(Delta / _output_weights(plant), 2) if Delta.size else 0.0
    if norm > 1.0 + 1e-12 and not allow_inadmissible:
        raise ValueError(
            f"Delta must have norm at most 1 to be admissible, got {norm:.6g} (columns of "
            "nonlinearities count divided by their Lipschitz constants); "
            "allow_inadmissible=True computes it all the same"
        )
    gain, D21 = estimator.B_c, plant.D21_tilde
    A = np.block(
        [
            [plant.A_p + B1 @ Delta @ C1, B1 @ Delta @ D12 @ estimator.C_c],
            [
                gain @ (plant.C2_tilde + D21 @ Delta @ C1),
                estimator.A_c + gain @ D21 @ Delta @ D12 @ estimator.C_c,
            ],
        ]
    )
    noise = plant.D21_bar.copy()
    if not copy_noise:
        noise[plant.system.l :] = 0.0
    abscissa = np.linalg.eigvals(A).real.max()
    if not abscissa < 0.0:
        raise UnstableLoopError(
            f"the closed loop is not stable: it has an eigenvalue with real part {abscissa:.4g} 1/s"
        )
    return ClosedLoop(A, np.vstack([plant.B_p1, gain @ noise]), estimator)


def _output_weights(plant: AugmentedSystem) -> np.ndarray:
    """Return the weights of zeta-tilde in its constraints: the Lipschitz constants, or one."""
    constants = [c.lipschitz for c in plant.system.nonlinearities]
    ones = [1.0] * (len(plant.C1_tilde) - 2 * len(constants))
    return np.array([*ones, *constants, *constants])


def error_covariance(
    smoother: Estimator,
    Delta: ArrayLike,
    output: str = "smoothed",
    copy_noise: bool = True,
    allow_inadmissible: bool = False,
) -> Matrix:
    r"""Return the stationary error covariance under a constant uncertainty.

    Parameters
    ----------
    smoother : Estimator
        Any design of this package.
    Delta : (r + 2g, h + 2g) array
        :math:`\tilde\xi = \Delta\tilde\zeta`, of norm at most one, as in `closed_loop`.
    output : {"smoothed", "filtered"}
        The error of the smoothed estimate one lag back, or of the filtered one now.
    copy_noise : bool
        Whether the design's fictitious noise drives the copies, as in the paper's formula.
    allow_inadmissible : bool
        Whether a Delta with norm above one is let through.

    Returns
    -------
    (m, m) array
        In the squared unit of w.

    Raises
    ------
    UnstableLoopError
        Where the closed loop is not asymptotically stable.
    ValueError, TypeError
        For a Delta of the wrong shape or with norm above one, or an unknown output.

    References
    ----------
    Section III-A, equation (eqCo).
    """
    output = validation.choice("output", output, OUTPUTS)
    return closed_loop(smoother, Delta, copy_noise, allow_inadmissible).error_covariance(output)


@one_thread
def delta_sweep(
    smoother: Estimator,
    nonlinearities: Iterable[float],
    output: str = "smoothed",
    copy_noise: bool = True,
) -> np.ndarray:
    """Return the error covariance for each slope of the nonlinearities, as in Fig. 4.

    Parameters
    ----------
    smoother : Estimator
        Any design of this package.
    nonlinearities : (N,) array
        The paper's Delta_2 in [-1, 1], the same for every nonlinearity and its copy; the
        uncertainties are zero.
    output, copy_noise
        As in `error_covariance`.

    Returns
    -------
    (N, m, m) array
    """
    validation.instance("smoother", smoother, Estimator)
    slopes = validation.array("nonlinearities", nonlinearities, ndim=1)
    plant = smoother.plant
    deltas = (plant.structured_delta((), [slope] * plant.system.g) for slope in slopes)
    covariances = [error_covariance(smoother, D, output, copy_noise) for D in deltas]
    return np.array(covariances).reshape(-1, plant.system.m, plant.system.m)


@dataclass(frozen=True)
class StatisticalLinearisation:
    """The stationary nonlinear loop, each nonlinearity replaced by its equivalent gain.

    Attributes
    ----------
    slope : float
        The equivalent Delta_2 of the nonlinearity.
    filtered, smoothed : float
        Mean square errors, in the squared unit of w.
    """

    slope: float
    filtered: float
    smoothed: float


@one_thread
def statistical_linearisation(
    smoother: Estimator, equivalent_slope: Callable[[float], float]
) -> StatisticalLinearisation:
    r"""Predict the nonlinear errors: the variance P of the loop's error solves P = P(slope(P)).

    Parameters
    ----------
    smoother : Estimator
        A design for a plant with one output and one nonlinearity, which acts on the filtered error
        because the estimator runs a copy, or the loop feeds the estimate back. (A Kalman filter in
        such a loop: ``baselines.kalman_bucy(system, copies=True)``.)
    equivalent_slope : callable
        Maps the variance of the error to the nonlinearity's equivalent Delta_2. For the homodyne
        loop `HomodyneParameters.equivalent_slope`: the Gaussian mean of the slope of
        :math:`\sin e` is :math:`e^{-P/2}`.

    Returns
    -------
    StatisticalLinearisation

    Raises
    ------
    UnstableLoopError
        Where no self-consistent variance exists: the linearised loop loses lock.
    """
    validation.instance("smoother", smoother, Estimator)
    plant = smoother.plant
    if plant.system.m != 1 or plant.system.g != 1:
        raise ValueError(
            "statistical linearisation takes one output and one nonlinearity, got "
            f"m={plant.system.m} and g={plant.system.g}"
        )
    if not smoother.C_c[1:].any():
        raise ValueError(
            "smoother must run a copy of the nonlinearity, got one that does not; an estimator of "
            "robsmooth.baselines does with copies=True"
        )

    def loop(slope: float) -> ClosedLoop:
        Delta = plant.structured_delta((), [slope])
        return closed_loop(smoother, Delta, copy_noise=False, allow_inadmissible=True)

    def excess(variance: float) -> float:
        slope = equivalent_slope(variance)
        return loop(slope).error_covariance("filtered")[0, 0] - variance

    low = 0.0
    high = loop(equivalent_slope(0.0)).error_covariance("filtered")[0, 0]
    while excess(high) > 0.0:
        low, high = high, 1.25 * high
        if high > 10.0 * np.pi**2:
            raise UnstableLoopError(
                "no stationary variance: the statistically linear loop diverges"
            )
    variance = brentq(excess, low, high, xtol=1e-15, rtol=1e-13)
    slope = equivalent_slope(variance)
    smoothed = loop(slope).error_covariance("smoothed")[0, 0]
    return StatisticalLinearisation(float(slope), float(variance), float(smoothed))
