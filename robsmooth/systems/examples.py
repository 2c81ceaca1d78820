"""Examples of systems that drift or resonate."""

import math

from robsmooth._support import validation
from robsmooth.systems.channels import Uncertainty
from robsmooth.systems.system import UncertainSystem


def random_walk(diffusion: float = 1.0, noise: float = 1.0) -> UncertainSystem:
    """Return a measured random walk: the phase of a laser against a perfect reference.

    Parameters
    ----------
    diffusion : float, the walk's variance in a second, in its squared unit
    noise : float, the intensity of the measurement's noise

    Examples
    --------
    >>> rs.baselines.optimal_fixed_lag_error(rs.examples.random_walk(), delay=0.1).round(4)
    array([[0.9094]])
    """
    root = math.sqrt(validation.positive("diffusion", diffusion))
    D21 = [[0.0, validation.positive("noise", noise)]]
    return UncertainSystem([[0.0]], [[root, 0.0]], [[1.0]], [[1.0]], D21)


def clock(
    phase_noise: float = 1.0, frequency_noise: float = 0.1, noise: float = 1.0
) -> UncertainSystem:
    """Return a clock: noise and a frequency, which walks at random, drive a phase.

    Parameters
    ----------
    phase_noise, frequency_noise : float, the intensities of the noises that drive these two
    noise : float, that of the phase's measurement

    Examples
    --------
    >>> rs.baselines.kalman_bucy(rs.examples.clock()).poles.round(3)
    array([-0.336, -0.942])
    """
    phase = math.sqrt(validation.positive("phase_noise", phase_noise))
    frequency = math.sqrt(validation.positive("frequency_noise", frequency_noise))
    return UncertainSystem(
        A=[[0.0, 1.0], [0.0, 0.0]],
        B1=[[phase, 0.0, 0.0], [0.0, frequency, 0.0]],
        C0=[[1.0, 0.0]],
        C2=[[1.0, 0.0]],
        D21=[[0.0, 0.0, validation.positive("noise", noise)]],
    )


def resonant_phase(
    frequency: float = 1e3,
    damping: float = 0.05,
    rms: float = 0.25,
    noise: float = 1.0 / 600.0,
    uncertainty: float = 0.02,
) -> UncertainSystem:
    r"""Return a phase from a mirror on its resonance, whose frequency is uncertain.

    .. math:: \ddot\theta + 2\zeta\omega\dot\theta + \omega^2(1 + 2\epsilon\Delta)\,\theta = f

    The states are :math:`\theta` and :math:`\dot\theta/\omega`.

    Parameters
    ----------
    frequency : float, of the resonance, Hz
    damping : float, :math:`\zeta`
    rms : float, of the phase, rad
    noise : float, intensity of the measurement's noise, rad s^(1/2)
    uncertainty : float, :math:`\epsilon`: to which the frequency is known, relatively

    Examples
    --------
    >>> plant = rs.augment(rs.examples.resonant_phase(), delay=2e-4, order=4)
    >>> rs.judge(rs.minimax_smoother(plant)).certified < 0.25**2
    True
    """
    omega = 2.0 * math.pi * validation.positive("frequency", frequency)
    damping = validation.positive("damping", damping)
    force = validation.positive("rms", rms) * math.sqrt(4.0 * damping * omega)
    stiffness = 2.0 * validation.positive("uncertainty", uncertainty) * omega / force
    return UncertainSystem(
        A=[[0.0, omega], [-omega, -2.0 * damping * omega]],
        B1=[[0.0, 0.0], [force, 0.0]],
        C0=[[1.0, 0.0]],
        C2=[[1.0, 0.0]],
        D21=[[0.0, validation.positive("noise", noise)]],
        uncertainties=[Uncertainty([[0.0], [force]], [[stiffness, 0.0]], [[0.0]])],
    )
