"""Plain Python: a loop over paths, steps and states, with the standard library's noise."""

import random
from math import sin

import numpy as np

from benchmarks.problem import Peer, Problem, Sample, Simulate, segments


def prepare(problem: Problem) -> Simulate:
    """Return the simulation."""
    n = range(problem.order)
    decay, diffusion = problem.decay, problem.diffusion
    drift, reference, copy = (v.tolist() for v in (problem.drift, problem.reference, problem.copy))
    gains = np.stack([problem.sine_gain, problem.copy_gain, problem.noise_gain], 1).tolist()

    def advance(phase: float, x: list, steps: int, gauss) -> tuple[float, list]:
        for _ in range(steps):
            measured = sin(phase - sum(reference[j] * x[j] for j in n))
            predicted = sin(sum(copy[j] * x[j] for j in n))
            noise = gauss()
            x = [
                x[i]
                + sum(drift[i][j] * x[j] for j in n)
                + gains[i][0] * measured
                + gains[i][1] * predicted
                + gains[i][2] * noise
                for i in n
            ]
            phase += decay * phase + diffusion * gauss()
        return phase, x

    def simulate(paths: int, steps: int, seed: int) -> Sample:
        gauss = random.Random(seed).gauss
        first, second = segments(problem, steps)
        ends = []
        for _ in range(paths):
            delayed, x = advance(0.0, [0.0] * problem.order, first, gauss)
            phase, x = advance(delayed, x, second, gauss)
            ends.append([delayed, phase, *x])
        delayed, phase, *state = np.transpose(ends)
        return problem.sample(phase, delayed, state)

    return simulate


PEERS = (Peer("Python loop", prepare, 2),)
