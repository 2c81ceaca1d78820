"""Uncertainties that are admissible and not constant, and the errors that they make."""

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from robsmooth.estimators.loop import open_loop


def all_pass_error(smoother, Delta, rate, output="guaranteed", loop="real"):
    """The mean square error where every channel passes Delta (rate - s)/(rate + s).

    It is causal and of the size of Delta at every frequency: admissible, also for copies, where it
    is the same for a nonlinearity and its copy. The error must be without delay.
    """
    opened = open_loop(smoother, output, loop)
    assert opened.delay == 0.0
    outputs, into = opened.outputs, opened.inputs @ Delta
    states = len(outputs)  # dz = (zeta - rate z) dt, and 2 rate z - zeta is what passes
    A = np.block(
        [
            [opened.A - into @ outputs, 2.0 * rate * into],
            [outputs, -rate * np.eye(states)],
        ]
    )
    B = np.vstack([opened.B, np.zeros((states, opened.B.shape[1]))])
    P = solve_continuous_lyapunov(A, -B @ B.T)[: len(opened.A), : len(opened.A)]
    if not np.linalg.eigvals(A).real.max() < 0.0:
        return np.inf
    error = opened.truth - opened.estimate
    return float(np.trace(error @ P @ error.T))
