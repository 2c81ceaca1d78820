r"""The linearised loop in coordinates in which its stationary covariance is the identity.

With the slopes of statistical linearisation the loop is :math:`dz = Az\,dt + Q^{1/2}dW` for
:math:`z = (\varphi, \hat x)`, with :math:`AP + PA' + Q = 0`. Then :math:`z = S\xi` with
:math:`P = SS'`, and :math:`\xi` has the covariance I.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr, solve_triangular

from robsmooth._numerics import linearisation
from robsmooth._numerics.lyapunov import stationary_root
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.homodyne.loop import Loop, check_stationary

LARGEST_DEVIATION = math.pi / 2  # standard deviation of the argument of a sine in lock, rad
_NEGLIGIBLE_REMAINDER = 1e-15  # of what sin(v) - v does to the state in a time constant
_SLOPE_TOLERANCE = 1e-9  # change of the slopes at which they are found
_LARGEST_ROUNDING = 1e-4  # of the covariance in white coordinates
_NEGLIGIBLE_DEVIATION = 1e-10  # of a direction in which nothing moves, relative
_ILL_CONDITIONED = (
    "the covariance of the linearised loop is lost in rounding: its rates, or the scales of the "
    "estimator's states, are too far apart"
)


@dataclass(frozen=True, eq=False)
class Sine:
    """One sine of the loop: its argument is row . (xi_1, xi_2), linear, its slope is slope."""

    row: Matrix
    gain: Matrix
    slope: float


@dataclass(frozen=True, eq=False)
class WhitenedLoop:
    """The loop in the coordinates xi, with time in units of its fastest time constant."""

    drift: Matrix
    sines: tuple[Sine, ...]
    phase: Matrix  # rows that read the phase and the errors out of xi
    filtered: Matrix  # phi - C_f x_hat
    smoothed: Matrix  # phi - C_a x_hat
    phase_decay: float
    phase_variance: float
    delay: float
    rounding: float  # relative error of the covariance

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return len(self.drift)


def whitened(loop: Loop) -> WhitenedLoop:
    """Return the loop in white coordinates, where it is stable and in lock."""
    rate = np.abs(np.linalg.eigvals(loop.linearised_drift())).max()
    slopes = slopes_of_lock(loop, rate)
    S, inverse, rounding = _white_coordinates(loop, slopes, rate)

    rows = loop.arguments() @ S
    deviations = np.linalg.norm(rows, axis=1)
    # Far out of lock there are slopes again, because the noise averages the sine to nothing.
    largest = deviations[loop.arguments()[:, 1:].any(axis=1)].max(initial=0.0)
    if largest > LARGEST_DEVIATION:
        raise UnstableLoopError(
            "the loop is not in lock: by statistical linearisation the argument of its sine has a "
            f"standard deviation of {largest:.3g} rad"
        )
    # The arguments of the sines that are not linear all the same span the first coordinates.
    gains = inverse @ loop.gains() / rate
    active = deviations**3 * np.linalg.norm(gains, axis=0) > _NEGLIGIBLE_REMAINDER
    rotation, arguments = np.linalg.qr(rows[active].T, mode="complete")
    S, inverse = S @ rotation, rotation.T @ inverse
    sines = zip(arguments.T, gains.T[active] @ rotation, slopes[active], strict=True)
    return WhitenedLoop(
        drift=inverse @ (loop.linearised_drift(*slopes) / rate) @ S,
        sines=tuple(Sine(row[:2], gain, slope) for row, gain, slope in sines),
        phase=S[0],
        filtered=S[0] - loop.filtered @ S[1:],
        smoothed=S[0] - loop.smoothed @ S[1:],
        phase_decay=loop.phase_decay / rate,
        phase_variance=loop.phase_diffusion**2 / (2 * loop.phase_decay),
        delay=loop.delay * rate,
        rounding=rounding,
    )


def slopes_of_lock(loop: Loop, rate: float) -> Matrix:
    """Return the slopes of statistical linearisation, iterated from slopes of one."""
    S, inverse = _error_coordinates(loop)
    rows = loop.arguments() @ S
    return linearisation.equivalent_slopes(
        np.ones(2),
        lambda slopes: ((rows @ _root(loop, slopes, rate, S, inverse)) ** 2).sum(axis=1),
        linearisation.of_sine,
        tolerance=_SLOPE_TOLERANCE,
    )


def _white_coordinates(loop: Loop, slopes: Matrix, rate: float) -> tuple[Matrix, Matrix, float]:
    """Return S with P = S S', a left inverse, and how far from I the covariance is behind it.

    What does not move has no coordinate. A triangular factor, unlike one of eigenvectors, does not
    mix coordinates of different rates.
    """
    from_error, to_error = _error_coordinates(loop)
    root = _root(loop, slopes, rate, from_error, to_error)
    deviations = np.linalg.norm(root, axis=1)
    deviations[deviations == 0.0] = 1.0
    triangle, order = qr((root / deviations[:, None]).T, mode="r", pivoting=True)
    rank = np.count_nonzero(np.abs(triangle.diagonal()) > _NEGLIGIBLE_DEVIATION)
    scaled = np.empty((len(root), rank))
    scaled[order] = triangle[:rank].T
    S = from_error * deviations @ scaled
    moving = (to_error / deviations[:, None])[order[:rank]]
    inverse = solve_triangular(triangle[:rank, :rank].T, moving, lower=True)
    white = _root(loop, slopes, rate, S, inverse)
    rounding = np.abs(white @ white.T - np.eye(rank)).max(initial=0.0)
    if rounding > _LARGEST_ROUNDING:
        raise ArithmeticError(_ILL_CONDITIONED)
    return S, inverse, rounding


def _root(loop: Loop, slopes: Matrix, rate: float, S: Matrix, inverse: Matrix) -> Matrix:
    """Return a root of the stationary covariance of the linear loop in the coordinates S.

    It tells small deviations from none, down to rounding; the covariance only their squares.
    """
    drift = loop.linearised_drift(*slopes)
    check_stationary(np.linalg.eigvals(drift))
    noise = inverse @ loop.noise_gains() / math.sqrt(rate)
    try:
        return stationary_root(inverse @ (drift / rate) @ S, noise)
    except UnstableLoopError:  # the eigenvalues are stable
        raise ArithmeticError(_ILL_CONDITIONED) from None


def _error_coordinates(loop: Loop) -> tuple[Matrix, Matrix]:
    """Return coordinates with the argument of the detector's sine for the phase, and their inverse.

    The phase may wander far, and the estimate with it; their difference does not.
    """
    S, inverse = np.eye(1 + loop.order), np.eye(1 + loop.order)
    S[0, 1:], inverse[0, 1:] = loop.reference, -loop.reference
    return S, inverse
