"""Systems in which robustness pays, for the tests of the designs, and the same in other units."""

import numpy as np

import robsmooth as rs

EXAMPLE = rs.homodyne.PAPER.uncertain_system()
DRIVE = rs.Uncertainty(B=[[1], [0]], C=[[0, 0.3]], D=[[0]])
GAIN = rs.Uncertainty(B=[[0], [0]], C=[[10, 0]], D=[[1]])


def cancelling(*uncertainties):
    """A sensor that sees the difference of two states, nearly their derivative."""
    A, B1, C2 = [[0, -1], [1, -0.5]], [[-2, 0], [1, 0]], [[-100, 100]]
    return rs.UncertainSystem(A, B1, [[1, 0]], C2, [[0, 1]], uncertainties)


def of_gain(size, decay=0.0):
    """A signal of unit bandwidth that is measured with an uncertain gain."""
    gain = rs.Uncertainty(B=[[0]], C=[[size]], D=[[1]])
    rate = rs.Uncertainty(B=[[1]], C=[[decay]], D=[[0]])
    return rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 0.1]], [gain, rate])


def referenced():
    """A signal seen with a strong disturbance, of which a second sensor has a gain within 10%."""
    noise = np.hstack([np.zeros((2, 2)), np.sqrt(1e-3) * np.eye(2)])
    gain = rs.Uncertainty(B=[[0], [0]], C=[[0, 0.1]], D=[[0], [1]])
    B1 = [[np.sqrt(2), 0, 0, 0], [0, 20, 0, 0]]
    return rs.UncertainSystem([[-1, 0], [0, -2]], B1, [[1, 0]], [[1, 1], [0, 1]], noise, [gain])


def driven(size, seen=False):
    """A resonance with a nonlinear restoring force, and an uncertainty that sees its states."""
    force = rs.Nonlinearity(B=[[0], [1]], C=[[1, 0]], D=[[0]], lipschitz=size)
    damping = rs.Uncertainty(B=[[0], [1]], C=[[0, 0.1]], D=[[0]])
    A, B1 = [[0, 1], [-0.8, -0.5]], [[0, 0], [0.5, 0]]
    uncertain = [damping] if seen else []
    return rs.UncertainSystem(A, B1, [[1, 0]], [[1, 0]], [[0, 0.1]], uncertain, [force])


def in_other_units(system, time, x, y):
    """The same system with time, states and measurements in other units."""
    root, x, y = np.sqrt(time), np.asarray(x)[:, None], np.asarray(y)[:, None]
    channels = [
        rs.Uncertainty(B=root * c.B / x, C=root * c.C * x.T, D=c.D / y)
        for c in system.uncertainties
    ]
    return rs.UncertainSystem(
        time * system.A / x * x.T, root * system.B1 / x, system.C0 * x.T,
        root * system.C2 / y * x.T, system.D21 / y, channels,
    )  # fmt: skip


def classical(plant, copies):
    """The classical smoother of a plant."""
    return rs.baselines.fixed_lag_smoother(plant.system, plant.delay, plant.order, copies)


def worst(estimator, output="smoothed"):
    """The worst constant error of an estimator in a real loop."""
    return rs.worst_case(estimator, output, loop="real").mean_square


def resonance(size, noise):
    """A resonance of quality 10 and unit variance, whose squared frequency is known to `size`."""
    A, B1 = [[0.0, 1.0], [-1.0, -0.1]], [[0.0, 0.0], [np.sqrt(0.2), 0.0]]
    detuning = rs.Uncertainty([[0.0], [1.0]], [[size, 0.0]], [[0.0]])
    return rs.UncertainSystem(A, B1, [[1.0, 0.0]], [[1.0, 0.0]], [[0.0, noise]], [detuning])
