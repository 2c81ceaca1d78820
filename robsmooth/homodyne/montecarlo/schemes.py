"""The coefficients of one step of a path, as the kernels take them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from robsmooth._numerics.exponential import responses
from robsmooth._numerics.lyapunov import noise_root, square_root
from robsmooth._support.errors import UnstableLoopError
from robsmooth.homodyne.loop import Loop
from robsmooth.homodyne.montecarlo.layout import (
    EulerCoefficients,
    SplittingCoefficients,
    draws_of_splitting,
)

_UNDAMPED = 1e-12  # of a mode's rate: less damping is rounding


@dataclass(frozen=True, eq=False)
class EulerStep:
    """A step of `robsmooth.homodyne.montecarlo.euler`.

    Attributes
    ----------
    coefficients : EulerCoefficients
    readout : (3, n) array
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    """

    coefficients: EulerCoefficients
    readout: NDArray[np.float64]

    @classmethod
    def of(cls, loop: Loop, step: float) -> "EulerStep":
        """Return the step of the Euler-Maruyama scheme over `step` seconds."""
        root = np.sqrt(step)
        coefficients = EulerCoefficients(
            increments=step * loop.drift,
            reference=loop.reference,
            copy=loop.copy,
            sine_gain=step * loop.sine_gain,
            copy_gain=step * loop.copy_gain,
            noise=loop.sine_noise / root,
            decay=-step * loop.phase_decay,
            diffusion=root * loop.phase_diffusion,
        )
        # Rounding noise, some of it denormal in single precision: processors are slow with those.
        tiny = np.finfo(np.float32).tiny
        coefficients = (np.where(np.abs(part) < tiny, 0.0, part) for part in coefficients)
        return cls(EulerCoefficients(*coefficients), _readout(loop))


@dataclass(frozen=True, eq=False)
class SplittingStep:
    """A step of `robsmooth.homodyne.montecarlo.splitting`, its start, and its control's means.

    Attributes
    ----------
    copies : bool
        Whether the estimator's copy of the nonlinearity has any effect.
    start : (1 + n, 1 + n) array
        A root of the stationary covariance of the control.
    coefficients : SplittingCoefficients
    readout : (3, n) array
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    control : (3,) array
        Exact means of the control's squared filtered error, squared smoothed error, and fourth
        power of the filtered error; rad^2 and rad^4.
    """

    copies: bool
    start: NDArray[np.float64]
    coefficients: SplittingCoefficients
    readout: NDArray[np.float64]
    control: NDArray[np.float64]

    @classmethod
    def of(cls, loop: Loop, step: float, slopes: tuple[float, float]) -> "SplittingStep":
        """Return the step of the splitting scheme over `step` seconds.

        Parameters
        ----------
        loop : Loop
        step : float
        slopes : tuple of 2 float
            Of the sines, in the control; see `control_slopes`.

        Raises
        ------
        UnstableLoopError
            Where the loop with these slopes has no stationary state.
        """
        drift, P = loop.linearised_drift(*slopes), loop.covariance(*slopes)
        transition, push, _ = responses(drift, -slopes[0] * loop.gains()[:, :1], step)
        noise = noise_root(drift, loop.noise_gains(), step)
        root = np.zeros((1 + loop.order, draws_of_splitting(loop.order)))
        # Not the triangular root itself: with that, a seed would have other paths.
        root[:, : 1 + loop.order] = square_root(noise @ noise.T)
        gains = step * loop.gains()[1:].T
        (r_s, r_c), (c_s, c_c) = np.vstack([loop.reference, loop.copy]) @ gains.T
        sine_response, copy_response = gains @ transition[1:, 1:].T
        coefficients = SplittingCoefficients(
            transition=transition,
            root=root,
            sine_gain=gains[0],
            copy_gain=gains[1],
            reference=loop.reference,
            copy=loop.copy,
            sine_response=sine_response,
            copy_response=copy_response,
            sine_slope=slopes[0],
            copy_slope=slopes[1],
            reference_of_sine=r_s,
            reference_of_copy=r_c,
            copy_of_sine=c_s,
            copy_of_copy=c_c,
            quarter_turn=np.pi / 2,
            push=push[1:],
        )
        filtered, smoothed = control_mean_squares(loop, drift, P)
        return cls(
            copies=bool(loop.copy.any() and loop.copy_gain.any()),
            start=square_root(P),
            coefficients=coefficients,
            readout=_readout(loop),
            control=np.array([filtered, smoothed, 3 * filtered**2]),  # it is Gaussian
        )


def longest_stable_step(loop: Loop) -> float:
    r"""Return the step from which on the Euler-Maruyama scheme lets a mode grow that decays, s.

    It multiplies a mode of the linearised loop with the eigenvalue :math:`\lambda` by
    :math:`1 + \lambda h` in a step. Infinity where no mode decays.
    """
    modes = np.linalg.eigvals(loop.linearised_drift())
    decaying = modes[modes.real < -_UNDAMPED * np.abs(modes)]
    return float((-2.0 * decaying.real / np.abs(decaying) ** 2).min(initial=np.inf))


def control_slopes(loop: Loop) -> tuple[float, float]:
    """Slopes of the sines in the control: those of statistical linearisation, where it has any.

    The control's means are exact for any slopes. These make it the nearest to the loop.
    """
    try:
        return loop.equivalent_slopes()
    except UnstableLoopError:
        return 1.0, 1.0


def control_mean_squares(loop: Loop, drift: NDArray, P: NDArray) -> tuple[float, float]:
    """Filtered and smoothed mean square errors of the linear loop with stationary covariance P."""
    filtered = np.concatenate([[1.0], -loop.filtered])
    smoothed = np.concatenate([[0.0], -loop.smoothed])
    cross = (expm(drift * loop.delay) @ P)[:, 0]  # of now and the phase a delay ago
    lagged = P[0, 0] + 2 * smoothed @ cross + smoothed @ P @ smoothed
    return float(filtered @ P @ filtered), float(lagged)


def _readout(loop: Loop) -> NDArray[np.float64]:
    return np.vstack([loop.filtered, loop.smoothed, loop.oscillator])
