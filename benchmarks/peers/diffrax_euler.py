"""diffrax: its Euler solver, one path a call under `vmap`, float32, one thread.

The Brownian path is the "unsafe" one, which no adaptive solver could use and which is ten times as
fast as the virtual tree. Time is in steps, which float32 counts exactly.
"""

import numpy as np

from benchmarks.peers.jax_scan import load
from benchmarks.problem import Peer, Problem, Sample, Simulate, Unavailable, chunks, segments

WIDTH = 4096


def prepare(problem: Problem) -> Simulate:
    """Return the compiled simulation; another number of steps compiles nothing."""
    jax = load()
    try:
        import diffrax
    except ImportError:
        raise Unavailable("diffrax is not installed") from None
    k, n = problem.astype(np.float32), problem.order
    noise = np.zeros((1 + n, 2), np.float32)
    noise[0, 1], noise[1:, 0] = k.diffusion, k.noise_gain

    def drift(t, y, _):
        phase, state = y[0], y[1:]
        measured = jax.numpy.sin(phase - k.reference @ state)
        predicted = jax.numpy.sin(k.copy @ state)
        moved = k.drift @ state + k.sine_gain * measured + k.copy_gain * predicted
        return jax.numpy.concatenate([k.decay * phase[None], moved])

    def solve(start, stop, y, key):
        path = diffrax.UnsafeBrownianPath(shape=(2,), key=key)
        terms = diffrax.MultiTerm(
            diffrax.ODETerm(drift), diffrax.ControlTerm(lambda t, y, _: noise, path)
        )
        options = {"max_steps": None, "adjoint": diffrax.DirectAdjoint()}
        return diffrax.diffeqsolve(
            terms, diffrax.Euler(), start, stop, np.float32(1), y, **options
        ).ys[0]

    def path(key, first, steps):
        one, two = jax.random.split(key)
        middle = solve(np.float32(0), first, jax.numpy.zeros(1 + n, np.float32), one)
        end = solve(first, steps, middle, two)
        return end[0], middle[0], end[1:]

    chunk = jax.jit(jax.vmap(path, in_axes=(0, None, None), out_axes=-1))

    def simulate(paths: int, steps: int, seed: int) -> Sample:
        first, _ = segments(problem, steps)
        keys = jax.random.split(jax.random.key(seed), (chunks(paths, WIDTH), WIDTH))
        ends = [chunk(some, np.float32(first), np.float32(steps)) for some in keys]
        return problem.sample(*(np.hstack(v) for v in zip(*ends, strict=True)))

    return simulate


PEERS = (Peer("diffrax, float32", prepare, WIDTH),)
