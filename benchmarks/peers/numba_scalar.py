"""numba as one would write it at first: a loop over paths and steps, float64, `np.random`."""

# ruff: noqa: NPY002 (inside a compiled function numba's own generator has NumPy's old names)

import numpy as np
from numba import njit

from benchmarks.problem import Peer, Problem, Sample, Simulate, segments


@njit
def steps_of_a_path(count, phase, x, following, decay, diffusion, drift, rows, gains):
    """Take `count` steps; return the phase. `x` is updated, `following` is work space."""
    n = len(x)
    for _ in range(count):
        error, copied = phase, 0.0
        for j in range(n):
            error -= rows[0, j] * x[j]
            copied += rows[1, j] * x[j]
        measured, predicted = np.sin(error), np.sin(copied)
        noise = np.random.standard_normal()
        for i in range(n):
            following[i] = x[i]
            for j in range(n):
                following[i] += drift[i, j] * x[j]
            following[i] += gains[0, i] * measured + gains[1, i] * predicted + gains[2, i] * noise
        for i in range(n):
            x[i] = following[i]
        phase += decay * phase + diffusion * np.random.standard_normal()
    return phase


@njit
def simulate_paths(seed, first, second, decay, diffusion, drift, rows, gains, ends):
    """Write delayed phase, phase and state of each path at its end to the columns of `ends`."""
    np.random.seed(seed)
    x, following = np.empty(drift.shape[0]), np.empty(drift.shape[0])
    for path in range(ends.shape[1]):
        x[:] = 0
        phase = steps_of_a_path(first, 0.0, x, following, decay, diffusion, drift, rows, gains)
        ends[0, path] = phase
        phase = steps_of_a_path(second, phase, x, following, decay, diffusion, drift, rows, gains)
        ends[1, path] = phase
        ends[2:, path] = x


def prepare(problem: Problem) -> Simulate:
    """Return the simulation; its first call compiles it."""
    rows = np.stack([problem.reference, problem.copy])
    gains = np.stack([problem.sine_gain, problem.copy_gain, problem.noise_gain])

    def simulate(paths: int, steps: int, seed: int) -> Sample:
        ends = np.empty((2 + problem.order, paths))
        simulate_paths(
            seed,
            *segments(problem, steps),
            problem.decay,
            problem.diffusion,
            problem.drift,
            rows,
            gains,
            ends,
        )
        return problem.sample(ends[1], ends[0], ends[2:])

    return simulate


PEERS = (Peer("numba, scalar loop", prepare, 10),)
