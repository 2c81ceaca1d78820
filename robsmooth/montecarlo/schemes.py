"""The coefficients of one step of a path, as `robsmooth.montecarlo.kernels` takes them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robsmooth.loop import Loop


@dataclass(frozen=True, eq=False)
class EulerLoop:
    """The coefficients of an Euler-Maruyama step, as `robsmooth.montecarlo.kernels` takes them.

    Parameters
    ----------
    phase_step : (2,) array
        Decay and diffusion of the phase in a step.
    estimator_step : (n + 5, n) array
        Increments of the estimator (n rows), reference, copy, and the gains of the measured sine,
        of the copied sine and of the noise.
    readout : (3, n) array
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    """

    phase_step: NDArray[np.float64]
    estimator_step: NDArray[np.float64]
    readout: NDArray[np.float64]


def euler(loop: Loop, step: float) -> EulerLoop:
    """Coefficients of the Euler-Maruyama scheme with steps of `step` seconds."""
    root = np.sqrt(step)
    return EulerLoop(
        phase_step=np.array([-step * loop.phase_decay, root * loop.phase_diffusion]),
        estimator_step=np.vstack(
            [
                step * loop.drift,
                loop.reference,
                loop.copy,
                step * loop.sine_gain,
                step * loop.copy_gain,
                root * loop.noise_gain,
            ]
        ),
        readout=np.vstack([loop.filtered, loop.smoothed, loop.oscillator]),
    )
