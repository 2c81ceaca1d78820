"""What an estimator does in one sample of a record, and the loop over samples."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robsmooth._numerics.steps import responses
from robsmooth._support.blas import one_thread
from robsmooth._support.kernels import kept
from robsmooth.estimators.copies import call


class Samples(NamedTuple):
    """Samples of a record, and what is known beside them."""

    y: NDArray[np.float64]  # (N, l), nan where it is missing
    reference: NDArray[np.float64]  # (N, copies)
    inputs: NDArray[np.float64]  # (N, p)
    intervals: NDArray[np.float64] | None  # (N,) their lengths, s, where these are not dt


class Steps(NamedTuple):
    """The transposed matrices of a step, for each pattern of missing channels."""

    transition: NDArray[np.float64]  # (patterns, n, n), phi_0
    measurement: NDArray[np.float64]  # (patterns, l, n), phi_1 h B_y
    copies: NDArray[np.float64]  # (patterns, copies, n), phi_1 h B_mu
    correction: NDArray[np.float64]  # (patterns, copies, n), phi_2 h B_mu


class Record(NamedTuple):
    """The samples of a record, with zeros for what is missing."""

    y: NDArray[np.float64]  # (N, l)
    reference: NDArray[np.float64]  # (N, copies)
    starts: NDArray[np.intp]  # segment s has the samples from starts[s] to starts[s + 1] ...
    patterns: NDArray[np.intp]  # ... and the matrices of patterns[s]


@one_thread
def steps_of(estimator: Any, running: list[int], dt: float, missing: NDArray[np.bool_]) -> Steps:
    """Return the matrices of a step; C_2 x_hat + D mu is in the place of what is missing."""
    system = estimator.plant.system
    B_y, B_mu = np.hsplit(estimator.B_c, [system.l])
    _, _, D = system.stacked(system.nonlinearities)
    gain = B_y * missing
    inputs = np.hstack([B_y * ~missing, (B_mu + gain @ D)[:, running]])
    A = estimator.A_c.copy()
    A[:, : estimator.plant.n] += gain @ estimator.plant.C2_tilde[: system.l]
    transition, held, ramp = responses(A, inputs, dt)
    copies = slice(system.l, None)
    matrices = (transition, held[:, : system.l], held[:, copies], ramp[:, copies])
    return Steps(*(np.ascontiguousarray(matrix.T)[None] for matrix in matrices))


def sizes_of(*counts: int) -> tuple[tuple[float, ...], ...]:
    """Return tuples of these lengths, which the compiler knows, unlike those of arrays."""
    return tuple((0.0,) * count for count in counts)


@kept()
def advance(sizes, functions, steps, C_nu, readout, record, state, result):
    """Take all samples of a `Record`, write `state` and `result`; return whether all is finite."""
    states, measurements, outputs, g = len(sizes[0]), len(sizes[1]), len(sizes[2]), len(sizes[3])
    x = np.empty((2, states))  # now, and at the end of the sample
    mu, mu_end = np.empty(g), np.empty(g)
    x[0] = state
    for segment in range(len(record.patterns)):
        p = record.patterns[segment]
        for k in range(record.starts[segment], record.starts[segment + 1]):
            for i in range(states):
                x[1, i] = 0.0
            for j in range(measurements):
                for i in range(states):
                    x[1, i] += steps.measurement[p, j, i] * record.y[k, j]
            for j in range(states):
                for i in range(states):
                    x[1, i] += steps.transition[p, j, i] * x[0, j]
            if g > 0:
                _copies(functions, C_nu, x[0], record.reference[k], mu)
                for j in range(g):
                    for i in range(states):
                        x[1, i] += steps.copies[p, j, i] * mu[j]
                _copies(functions, C_nu, x[1], record.reference[k], mu_end)
                for j in range(g):
                    for i in range(states):
                        x[1, i] += steps.correction[p, j, i] * (mu_end[j] - mu[j])
            for i in range(states):
                x[0, i] = x[1, i]
            for i in range(outputs):
                estimate = 0.0
                for j in range(states):
                    estimate += readout[i, j] * x[0, j]
                result[k, i] = estimate
    finite = True
    for i in range(states):
        finite = finite and np.isfinite(x[0, i])
        state[i] = x[0, i]
    return finite


@kept()
def step(
    sizes,
    functions,
    transition,
    measurement,
    copies,
    correction,
    C_nu,
    readout,
    y,
    reference,
    starts,
    patterns,
    state,
    following,
    result,
):
    """Take the one sample of y, write the state that follows; return whether all is finite."""
    steps = Steps(transition, measurement, copies, correction)
    record = Record(y, reference, starts, patterns)
    following[:] = state
    return advance(sizes, functions, steps, C_nu, readout, record, following, result)


@kept()
def _copies(functions, C_nu, x, reference, values):
    """Write what the copies give at a state."""
    for i in range(len(functions)):
        argument = -reference[i]
        for j in range(len(x)):
            argument += C_nu[i, j] * x[j]
        values[i] = call(functions[i], argument)
