"""JAX: `lax.scan` over the steps, compiled, float32, one thread.

Noise is drawn step by step; drawing it for some steps ahead, the "rbg" generators, unrolling and
other widths were no faster.
"""

from functools import partial

import numpy as np

from benchmarks.problem import Peer, Problem, Sample, Simulate, Unavailable, chunks, segments

WIDTH = 2048


def load():
    """Return the jax module."""
    try:
        import jax
    except ImportError:
        raise Unavailable("jax is not installed") from None
    return jax


def prepare(problem: Problem) -> Simulate:
    """Return the compiled simulation; another number of steps compiles it anew."""
    jax = load()
    k, n = problem.astype(np.float32), problem.order

    def dot(row, state):
        return sum(row[j] * state[j] for j in range(n))

    def step(carry, _):
        key, phase, state = carry
        key, own = jax.random.split(key)
        g1, g2 = jax.random.normal(own, (2, WIDTH))
        measured = jax.numpy.sin(phase - dot(k.reference, state))
        predicted = jax.numpy.sin(dot(k.copy, state))
        following = tuple(
            state[i]
            + dot(k.drift[i], state)
            + k.sine_gain[i] * measured
            + k.copy_gain[i] * predicted
            + k.noise_gain[i] * g1
            for i in range(n)
        )
        return (key, phase + k.decay * phase + k.diffusion * g2, following), None

    @partial(jax.jit, static_argnums=1)
    def chunk(key, steps):
        zero = jax.numpy.zeros(WIDTH, np.float32)
        first, second = segments(problem, steps)
        carry, _ = jax.lax.scan(step, (key, zero, (zero,) * n), length=first)
        (_, phase, state), _ = jax.lax.scan(step, carry, length=second)
        return phase, carry[1], jax.numpy.stack(state)

    def simulate(paths: int, steps: int, seed: int) -> Sample:
        keys = jax.random.split(jax.random.key(seed), chunks(paths, WIDTH))
        ends = [chunk(key, steps) for key in keys]
        return problem.sample(*(np.hstack(v) for v in zip(*ends, strict=True)))

    return simulate


PEERS = (Peer("JAX, float32", prepare, WIDTH),)
