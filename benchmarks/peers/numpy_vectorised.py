"""NumPy, all paths of a chunk in one array.

A step is two small matrix products and two calls besides: the rows of one array are the phase, the
state, both sines and both draws, and the next phase and state are a product of all of them. That is
half as long again as fast as a call for each sum. Of NumPy's generators SFC64 is the fastest, and
this width the best.
"""

from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.problem import Peer, Problem, Sample, Simulate, chunks, segments

WIDTH = 4096


def matrices(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix of the sines' arguments and that of the step."""
    n = problem.order
    arguments = np.zeros((2, 1 + n))
    arguments[0] = np.concatenate([[1.0], -problem.reference])
    arguments[1, 1:] = problem.copy
    step = np.zeros((1 + n, 1 + n + 4))
    step[0, 0], step[0, -1] = 1 + problem.decay, problem.diffusion
    step[1:, 1 : 1 + n] = np.eye(n) + problem.drift
    for column, gain in enumerate((problem.sine_gain, problem.copy_gain, problem.noise_gain)):
        step[1:, 1 + n + column] = gain
    return arguments, step


def advance(arguments, step, now: np.ndarray, steps: int, generator) -> np.ndarray:
    """Take `steps` steps from `now`; return where they lead."""
    states = step.shape[0]
    spare = np.empty_like(now)
    for _ in range(steps):
        sines, draws = now[states : states + 2], now[states + 2 :]
        np.matmul(arguments, now[:states], out=sines)
        np.sin(sines, out=sines)
        generator.standard_normal(dtype=now.dtype, out=draws)
        np.matmul(step, now, out=spare[:states])
        now, spare = spare, now
    return now


def prepare(problem: Problem, real: type) -> Simulate:
    """Return the simulation in float32 or float64, on one thread."""
    arguments, step = (matrix.astype(real) for matrix in matrices(problem))

    def simulate(paths: int, steps: int, seed: int) -> Sample:
        generator = np.random.Generator(np.random.SFC64(seed))
        first, second = segments(problem, steps)
        ends = []
        with threadpool_limits(1):
            for _ in range(chunks(paths, WIDTH)):
                now = np.zeros((step.shape[1], WIDTH), real)
                now = advance(arguments, step, now, first, generator)
                delayed = now[0].copy()
                now = advance(arguments, step, now, second, generator)
                ends.append(np.vstack([delayed, now[: step.shape[0]]]))
        delayed, phase, *state = np.hstack(ends)
        return problem.sample(phase, delayed, state)

    return simulate


PEERS = tuple(
    Peer(f"NumPy, {real.__name__}", partial(prepare, real=real), WIDTH)
    for real in (np.float32, np.float64)
)
