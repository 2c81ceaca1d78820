"""The library itself, through its public call."""

from functools import partial

import numba

from benchmarks.problem import STEP, Peer, Problem, Sample, Simulate
from robsmooth import homodyne, monte_carlo

WIDTH = 1920  # a multiple of all sensible numbers of paths in a block


def prepare(problem: Problem, precision: str) -> Simulate:
    """Return `monte_carlo` on one thread."""

    def simulate(paths: int, steps: int, seed: int) -> Sample:
        numba.set_num_threads(1)
        result = monte_carlo(
            homodyne.PAPER,
            problem.smoother,
            protocol="paper",
            runs=paths,
            duration=steps * STEP,
            step=STEP,
            seed=seed,
            precision=precision,
        )
        if result.path_steps != paths * steps:
            raise ValueError(f"{paths} paths of {steps} steps became {result.path_steps} steps")
        return Sample(paths, result.filtered, result.smoothed)

    return simulate


PEERS = tuple(
    Peer(f"robsmooth, {precision}", partial(prepare, precision=precision), WIDTH)
    for precision in ("single", "mixed")
)
