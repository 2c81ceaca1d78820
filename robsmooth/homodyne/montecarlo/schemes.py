"""The coefficients of one step of a path, as the kernels take them."""

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


def euler_coefficients(loop: Loop, step: float) -> EulerCoefficients:
    """Return those of the Euler-Maruyama scheme over `step` seconds."""
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
    return EulerCoefficients(*(np.where(np.abs(part) < tiny, 0.0, part) for part in coefficients))


def splitting_coefficients(
    loop: Loop, step: float, slopes: tuple[float, float]
) -> SplittingCoefficients:
    """Return those of the splitting scheme over `step` seconds, the control with these slopes."""
    drift = loop.linearised_drift(*slopes)
    transition, push, _ = responses(drift, -slopes[0] * loop.gains()[:, :1], step)
    noise = noise_root(drift, loop.noise_gains(), step)
    root = np.zeros((1 + loop.order, draws_of_splitting(loop.order)))
    # Not the triangular root itself: with that, a seed would have other paths.
    root[:, : 1 + loop.order] = square_root(noise @ noise.T)
    gains = step * loop.gains()[1:].T
    (r_s, r_c), (c_s, c_c) = np.vstack([loop.reference, loop.copy]) @ gains.T
    sine_response, copy_response = gains @ transition[1:, 1:].T
    return SplittingCoefficients(
        transition=transition,
        root=root,
        sine_gain=gains[0],
        copy_gain=gains[1],
        reference=loop.reference,
        copy=loop.copy,
        sine_response=sine_response,
        copy_response=copy_response,
        push=push[1:],
        sine_slope=slopes[0],
        copy_slope=slopes[1],
        reference_of_sine=r_s,
        reference_of_copy=r_c,
        copy_of_sine=c_s,
        copy_of_copy=c_c,
        quarter_turn=np.pi / 2,
        start=square_root(loop.covariance(*slopes)),
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


def control_means(loop: Loop, slopes: tuple[float, float]) -> NDArray[np.float64]:
    """Means, rad^2 and rad^4, of the control's squared errors and fourth power of the filtered."""
    P = loop.covariance(*slopes)
    filtered = np.concatenate([[1.0], -loop.filtered])
    smoothed = np.concatenate([[0.0], -loop.smoothed])
    # covariance of now and the phase a delay ago
    cross = (expm(loop.linearised_drift(*slopes) * loop.delay) @ P)[:, 0]
    square = float(filtered @ P @ filtered)
    lagged = float(P[0, 0] + 2 * smoothed @ cross + smoothed @ P @ smoothed)
    return np.array([square, lagged, 3 * square**2])  # it is Gaussian
