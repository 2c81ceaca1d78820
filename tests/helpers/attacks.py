"""Uncertainties that are admissible and not constant, and the errors that they make."""

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

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


def switching_error(smoother, Deltas, dwell, output="guaranteed", loop="real"):
    """The mean square error where Delta takes each of some values for a time, again and again.

    It is the mean over a period of the periodic solution of dP/dt = A P + P A' + B B', exactly.
    Every such Delta is admissible where its values are. The error must be without delay.
    """
    opened = open_loop(smoother, output, loop)
    assert opened.delay == 0.0
    noise = opened.B @ opened.B.T
    whole, gathered, pieces = np.eye(len(opened.A)), np.zeros_like(opened.A), []
    for Delta in Deltas:
        A = opened.A + opened.inputs @ Delta @ opened.outputs
        transition, stationary = expm(A * dwell), solve_continuous_lyapunov(A, -noise)
        gathered = stationary + transition @ (gathered - stationary) @ transition.T
        whole = transition @ whole
        pieces.append((A, transition, stationary))
    if not np.abs(np.linalg.eigvals(whole)).max() < 1.0:
        return np.inf
    P, total = solve_discrete_lyapunov(whole, gathered), np.zeros_like(opened.A)
    for A, transition, stationary in pieces:
        end = stationary + transition @ (P - stationary) @ transition.T
        total += solve_continuous_lyapunov(A, end - P - dwell * noise)
        P = end
    error = opened.truth - opened.estimate
    return float(np.trace(error @ total @ error.T) / (dwell * len(pieces)))
