r"""The adaptive homodyne loop of Section IV with a linear estimator in it.

`docs/source/simulation.md` has its equations. The phase u of the local oscillator is the filtered
or the smoothed estimate, or :math:`\tilde\nu/2\alpha\gamma`, with which the copy's output is zero,
or zero.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag, expm

from robsmooth._numerics import linearisation, lyapunov, modes
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import matrices
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.systems.augmented import augment
from robsmooth.systems.channels import REFERENCES
from robsmooth.systems.system import UncertainSystem

OSCILLATORS = (*REFERENCES, "copy", "none")
_SLOPE_TOLERANCE = 1e-13
_LEAST_DECAY = 1e-8  # of the phase, relative to the rate of its filter
LARGEST_VARIANCE = 4 * np.pi**2  # rad^2, the square of a turn: out of lock


@dataclass(frozen=True, eq=False)
class Loop:
    """The loop in the form of the last equation of the module's docstring."""

    drift: Matrix  # (1 + n, 1 + n), 1/s, of (phi, x_hat) without the sines: -lambda and G
    noise: Matrix  # (1 + n, 2), of dV and dW
    gains: Matrix  # (1 + n, 2), of the sines: b_s and b_c, 1/s
    arguments: Matrix  # (2, 1 + n), of the sines: (1, -r) and (0, c)
    sine_noise: float  # nu, s^(1/2)
    readout: Matrix  # (3, n): filtered and smoothed estimate, oscillator's phase, rad
    delay: float  # of the smoothed estimate, s

    def linearised_drift(self, sine_slope: float = 1.0, copy_slope: float = 1.0) -> Matrix:
        r"""Drift of :math:`(\phi, \hat x)`, each sine replaced by a slope, 1/s."""
        return self.drift + self.gains @ np.diag([sine_slope, copy_slope]) @ self.arguments

    @lru_cache(maxsize=4)  # noqa: B019, of a few loops
    def covariance(self, sine_slope: float = 1.0, copy_slope: float = 1.0) -> Matrix:
        r"""Stationary covariance of :math:`(\phi, \hat x)`, each sine replaced by a slope."""
        drift = self.linearised_drift(sine_slope, copy_slope)
        decay_rate(drift)
        return lyapunov.covariances(drift, self.noise).stationary

    def stationary_root(self, slopes: Sequence[float], S: Matrix, inverse: Matrix) -> Matrix:
        """Return a root of the stationary covariance in S, accurate for small deviations."""
        drift = self.linearised_drift(*slopes)
        decay_rate(drift)
        return lyapunov.stationary_root(inverse @ drift @ S, inverse @ self.noise)

    def error_coordinates(self) -> tuple[Matrix, Matrix]:
        """Return coordinates with the first sine's argument for the phase, which may wander far."""
        identity = np.eye(len(self.drift))
        inverse = np.vstack([self.arguments[:1], identity[1:]])
        return 2 * identity - inverse, inverse

    def linear_errors(self, *slopes: float) -> tuple[float, float]:
        """Filtered and smoothed mean square error, rad^2, each sine replaced by a slope."""
        P = self.covariance(*slopes)
        filtered, smoothed = np.hstack([[[1.0], [0.0]], -self.readout[:2]])
        # covariance of the state now and the phase a delay ago
        cross = (expm(self.linearised_drift(*slopes) * self.delay) @ P)[:, 0]
        lagged = float(P[0, 0] + 2 * smoothed @ cross + smoothed @ P @ smoothed)
        return float(filtered @ P @ filtered), lagged

    def equivalent_slopes(self, tolerance: float = _SLOPE_TOLERANCE) -> tuple[float, float]:
        """Return slopes by statistical linearisation; UnstableLoopError: the loop loses lock."""
        S, inverse = self.error_coordinates()
        rows = self.arguments @ S
        slopes = linearisation.equivalent_slopes(
            np.ones(2),
            lambda slopes: ((rows @ self.stationary_root(slopes, S, inverse)) ** 2).sum(axis=1),
            lambda variances: np.exp(-0.5 * variances),
            tolerance=tolerance,
            largest=LARGEST_VARIANCE,
        )
        return tuple(slopes.tolist())

    def response_time(self) -> float:
        r"""The time in which the sines respond to themselves, s; infinity if never.

        A kick through a gain b moves the argument r x of a sine by :math:`r e^{At}b`. The rate is
        the larger of that and the root of its slope, at time zero.
        """
        A = self.linearised_drift()[1:, 1:]
        gains, rows = self.gains[1:], self.arguments[:, 1:]
        rate = max(np.abs(rows @ gains).max(), math.sqrt(np.abs(rows @ A @ gains).max()))
        rate = rate or np.abs(np.linalg.eigvals(A)).max()
        return 1.0 / float(rate) if rate else math.inf


def decay_rate(drift: Matrix) -> float:
    """Return the decay rate of the slowest mode, 1/s; UnstableLoopError: it is not positive."""
    slowest = 0.0 + modes.rates(drift)[0]  # no minus zero
    if not slowest > 0.0:
        why = f"linearised, its slowest mode has the decay rate {slowest:.3g} 1/s"
        raise UnstableLoopError(f"the loop has no stationary state: {why}")
    return slowest


def homodyne_loop(
    parameters: HomodyneParameters,
    smoother: Estimator,
    oscillator: str = "filtered",
    copy: bool = True,
    shot_noise: float = 1.0,
) -> Loop:
    """Close the loop of the module's docstring; see `monte_carlo` for the arguments."""
    validation.instance("parameters", parameters, HomodyneParameters)
    validation.choice("oscillator", oscillator, OSCILLATORS)
    copy = validation.boolean("copy", copy)
    shot_noise = validation.real("shot_noise", shot_noise, low=0.0)
    # A phase that does not decay gets a decay too small to change the errors.
    rate = 2.0 * parameters.alpha * parameters.beta * math.sqrt(parameters.kappa)
    system = replace(parameters, lam=max(parameters.lam, _LEAST_DECAY * rate)).uncertain_system()
    system = replace(system, D21=math.sqrt(shot_noise) * system.D21)
    estimator = _estimator(smoother, system, copy)

    alpha, beta = parameters.alpha, parameters.beta
    scale = 2 * alpha * parameters.gamma
    rows = (scale * estimator.C_f, scale * estimator.C_a, estimator.C_c[1:], scale * estimator.C_f)
    steering = rows[OSCILLATORS.index(oscillator)]
    if oscillator == "copy" and not steering.any():
        allowed = "'filtered', 'smoothed' or 'none' where no copy runs"
        raise ValueError(f"oscillator must be {allowed}, got 'copy'")
    reference = None if oscillator == "none" else steering
    drift, noise, inputs, outputs = matrices(estimator, loop="real", reference=reference)
    # the first channel is an uncertainty that is zero; the sine and its copy follow
    gains, arguments = 2 * alpha * inputs[:, 1:], outputs[1:] / scale
    arguments[1] *= gains[:, 1].any()
    linear = drift - beta * gains @ arguments
    sine_noise = beta * system.D21[0, 1]
    return Loop(
        drift=block_diag(linear[0, 0], linear[1:, 1:]),
        noise=np.column_stack([noise[:, 0], sine_noise * gains[:, 0]]),
        gains=gains,
        arguments=arguments,
        sine_noise=sine_noise,
        readout=np.vstack([estimator.C_f, estimator.C_a, steering / scale]),
        delay=estimator.plant.delay,
    )


def _estimator(smoother: Estimator, system: UncertainSystem, copy: bool) -> Estimator:
    """Return the estimator, checked, as one of this system and with the channel of a copy."""
    validation.instance("smoother", smoother, Estimator)
    own = smoother.plant.system
    if (own.m, own.l) != (1, 1) or own.g > 1:
        rule = "one output, one measurement and at most one nonlinearity"
        raise ValueError(f"smoother must have {rule}, got m={own.m}, l={own.l} and g={own.g}")
    runs, missing = np.array([1.0, float(copy)])[: 1 + own.g], 1 - own.g
    return Estimator(
        plant=augment(system, smoother.plant.delay, order=0),
        A_c=smoother.A_c,
        B_c=np.pad(smoother.B_c * runs, ((0, 0), (0, missing))),
        C_c=np.pad(smoother.C_c * runs[:, None], ((0, missing), (0, 0))),
        C_f=smoother.C_f,
        C_a=smoother.C_a,
    )


@dataclass(frozen=True)
class StatisticalLinearisation:
    """The result of `statistical_linearisation`."""

    filtered: float  # mean square errors, rad^2
    smoothed: float
    slopes: tuple[float, float]  # of the sine and of its copy in the estimator


@one_thread
def statistical_linearisation(
    parameters: HomodyneParameters,
    smoother: Estimator,
    *,
    oscillator: str = "filtered",
    copy: bool = True,
    shot_noise: float = 1.0,
) -> StatisticalLinearisation:
    r"""Predict the errors of the nonlinear loop by statistical linearisation.

    The mean slope of the sine of a Gaussian argument with variance P is :math:`e^{-P/2}`.

    Parameters
    ----------
    parameters, smoother, oscillator, copy, shot_noise : as in `monte_carlo`

    Returns
    -------
    StatisticalLinearisation

    Raises
    ------
    UnstableLoopError
        Where no slopes belong to their own variances: the loop loses lock.

    Examples
    --------
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> found = rs.statistical_linearisation(rs.homodyne.PAPER, kalman)
    >>> round(found.slopes[0], 4), round(found.filtered, 4)
    (0.9569, 0.0881)
    """
    return linearised(homodyne_loop(parameters, smoother, oscillator, copy, shot_noise))


def linearised(loop: Loop) -> StatisticalLinearisation:
    """Return the errors of a loop with its equivalent slopes."""
    slopes = loop.equivalent_slopes()
    return StatisticalLinearisation(*loop.linear_errors(*slopes), slopes)
