"""The coefficients of one step of a path, as the kernels take them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from robsmooth._numerics.exponential import responses
from robsmooth._numerics.lyapunov import noise_root, square_root
from robsmooth._support.errors import UnstableLoopError
from robsmooth.homodyne.loop import Loop
from robsmooth.homodyne.montecarlo import splitting


@dataclass(frozen=True, eq=False)
class EulerStep:
    """A step of `robsmooth.homodyne.montecarlo.euler`.

    Attributes
    ----------
    coefficients : (n * n + 4 * n + 3,) array
        Increments of the estimator (n, n), reference, copy, gains of the measured and of the copied
        sine (n each); the noise that adds to the measured sine; decay and diffusion of the phase.
    readout : (3, n) array
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    """

    coefficients: NDArray[np.float64]
    readout: NDArray[np.float64]

    @classmethod
    def of(cls, loop: Loop, step: float) -> "EulerStep":
        """Return the step of the Euler-Maruyama scheme over `step` seconds."""
        root = np.sqrt(step)
        parts = [
            step * loop.drift.ravel(),
            loop.reference,
            loop.copy,
            step * loop.sine_gain,
            step * loop.copy_gain,
            [loop.sine_noise / root, -step * loop.phase_decay, root * loop.phase_diffusion],
        ]
        coefficients = np.concatenate(parts)
        # Rounding noise, some of it denormal in single precision: processors are slow with those.
        coefficients[np.abs(coefficients) < np.finfo(np.float32).tiny] = 0.0
        return cls(coefficients, _readout(loop))


@dataclass(frozen=True, eq=False)
class SplittingStep:
    """A step of `robsmooth.homodyne.montecarlo.splitting`, its start, and its control's means.

    Attributes
    ----------
    copies : bool
        Whether the estimator's copy of the nonlinearity has any effect.
    start : (1 + n, 1 + n) array
        A root of the stationary covariance of the control.
    coefficients : array
        Laid out as `robsmooth.homodyne.montecarlo.splitting` says.
    readout : (3, n) array
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    control : (3,) array
        Exact means of the control's squared filtered error, squared smoothed error, and fourth
        power of the filtered error; rad^2 and rad^4.
    """

    copies: bool
    start: NDArray[np.float64]
    coefficients: NDArray[np.float64]
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
        root = np.zeros((1 + loop.order, splitting.draws(loop.order)))
        root[:, : 1 + loop.order] = square_root(noise @ noise.T)
        gains = step * loop.gains()[1:].T
        arguments = np.vstack([loop.reference, loop.copy])
        products = arguments @ gains.T
        coefficients = [
            transition,
            root,
            gains,
            arguments,
            gains @ transition[1:, 1:].T,
            np.array(slopes),
            products,
            np.array([np.pi / 2]),
            push[1:],
        ]
        filtered, smoothed = control_mean_squares(loop, drift, P)
        return cls(
            copies=bool(loop.copy.any() and loop.copy_gain.any()),
            start=square_root(P),
            coefficients=np.concatenate([part.ravel() for part in coefficients]),
            readout=_readout(loop),
            control=np.array([filtered, smoothed, 3 * filtered**2]),  # it is Gaussian
        )


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
