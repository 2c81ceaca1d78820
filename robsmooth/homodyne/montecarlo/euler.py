r"""The compiled loop of the published protocol: Euler-Maruyama, and the errors at the end.

One step of a path, with the coefficients of
`robsmooth.homodyne.montecarlo.layout.EulerCoefficients`:

.. math::

    \varphi &\leftarrow \varphi + a\varphi + q\,g_2,\\
    \hat x &\leftarrow \hat x + F\hat x + b_c\sin(c\hat x) + b_s[\sin(\varphi - r\hat x) + w g_1] .

`BLOCK` paths are simulated side by side in vector registers. The order n is passed as the length of
a tuple, hence known when the kernel is compiled: the sums over states are unrolled, the loop over
paths is vectorised, and the state of a path stays in registers for a step. Each order is compiled
once and kept on disk. What is called is inlined by numba: compiled again at each level it is linked
into, it would lose registers.

`simulate_blocks` is the only entry point. Each block writes its own part of the result, so the
result does not depend on the number of threads, nor on how blocks are shared out over calls.
"""

import numpy as np
from numba import njit, prange

from robsmooth._support.kernels import kept
from robsmooth.homodyne.montecarlo.kernels import TURN, shared_sources, slip
from robsmooth.homodyne.montecarlo.layout import euler_indices
from robsmooth.homodyne.montecarlo.noise import (
    BLOCK,
    DRAWS,
    WORDS,
    fill_gaussians,
    fma,
    seed_paths,
    sine,
    with_item,
)

CHUNK = 32  # steps for which noise is drawn ahead (32 KiB), and between two looks at the lock
OUTPUTS = 3  # of a path: squared filtered and smoothed error at the end, and cycle slips
FILTERED, SMOOTHED, SLIPS = range(OUTPUTS)
SOURCES = shared_sources()


@njit(inline="always")
def euler_steps(order, coefficients, steps, state, gaussians):
    """Advance a block by `steps` steps with the noise of `fill_gaussians`."""
    n = len(order)
    at = euler_indices(n)
    noise = coefficients[at.noise]
    decay, diffusion = coefficients[at.decay], coefficients[at.diffusion]
    for step in range(steps):
        draw = step * DRAWS * BLOCK
        for path in range(BLOCK):
            phase = state[path]
            error = phase
            copied = coefficients[at.copy] * state[BLOCK + path]
            x = order
            for j in range(n):
                x = with_item(x, j, state[(1 + j) * BLOCK + path])
                error = fma(-coefficients[at.reference + j], x[j], error)
                if j > 0:
                    copied = fma(coefficients[at.copy + j], x[j], copied)
            phase = fma(decay, phase, phase)
            state[path] = fma(diffusion, gaussians[draw + BLOCK + path], phase)
            measured = fma(noise, gaussians[draw + path], sine(error))
            predicted = sine(copied)
            for i in range(n):
                y = x[i]
                for j in range(n):
                    y = fma(coefficients[at.increments + i * n + j], x[j], y)
                y = fma(coefficients[at.copy_gain + i], predicted, y)
                y = fma(coefficients[at.sine_gain + i], measured, y)
                state[(1 + i) * BLOCK + path] = y


@njit(inline="always")
def advance(order, coefficients, readout, steps, state, generator, gaussians, turns, result):
    """Advance a block by `steps` steps, and count its cycle slips."""
    n = len(order)
    done = 0
    while done < steps:
        count = min(CHUNK, steps - done)
        fill_gaussians(generator, count, gaussians)
        euler_steps(order, coefficients, count, state, gaussians)
        done += count
        for path in range(BLOCK):
            away = np.float64(state[path]) - turns[path]
            for j in range(n):
                away = fma(-readout[2, j], np.float64(state[(1 + j) * BLOCK + path]), away)
            passed = slip(away)
            turns[path] += TURN * passed
            result[SLIPS, path] += abs(passed)


@njit
def collect(order, readout, state, delayed, result):
    """Write the squared errors: against the phase, and against the phase `delayed`, a delay ago."""
    for path in range(BLOCK):
        filtered, smoothed = np.float64(state[path]), np.float64(delayed[path])
        for j in range(len(order)):
            x = np.float64(state[(1 + j) * BLOCK + path])
            filtered = fma(-readout[0, j], x, filtered)
            smoothed = fma(-readout[1, j], x, smoothed)
        result[FILTERED, path] = filtered * filtered
        result[SMOOTHED, path] = smoothed * smoothed


@njit(inline="always")
def simulate_block(order, coefficients, readout, schedule, seed, first_path, state, result):
    """Simulate paths `first_path` to `first_path + BLOCK - 1`, from zero to the end."""
    before, delay = schedule
    generator = np.empty(WORDS * BLOCK, np.uint32)
    gaussians = np.empty(CHUNK * DRAWS * BLOCK, np.float32)
    delayed = np.empty(BLOCK, state.dtype)
    turns = np.zeros(BLOCK)

    seed_paths(seed, first_path, generator)
    state[:] = 0
    result[:] = 0
    advance(order, coefficients, readout, before, state, generator, gaussians, turns, result)
    delayed[:] = state[:BLOCK]
    advance(order, coefficients, readout, delay, state, generator, gaussians, turns, result)
    collect(order, readout, state, delayed, result)


@kept(parallel=True, nogil=True)
def simulate_blocks(
    order,
    coefficients,
    readout,
    schedule,
    seed,
    first_block,
    states,
    results,
    sources=SOURCES,
):
    """Simulate as many consecutive blocks as `results` has room for.

    Parameters
    ----------
    order : tuple of n zeros
        Of the type of `states`; only its length counts.
    coefficients : array
        `EulerCoefficients` in a flat array, in the precision of `states`.
    readout : (3, n) array of float64
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    schedule : tuple of 2 int
        Steps before the phase is recorded, and after it: the delay.
    seed : uint64
    first_block : int
        Block b holds the paths ``b * BLOCK`` to ``(b + 1) * BLOCK - 1``.
    states : (blocks, euler_state_size(n)) array of float32 or float64
        Work space; its type is the precision of the simulation.
    results : (blocks, OUTPUTS, BLOCK) array of float64
        Written: the squared errors at the end, and the number of cycle slips.
    sources : str
        Not to be given.
    """
    for block in prange(results.shape[0]):
        simulate_block(
            order,
            coefficients,
            readout,
            schedule,
            seed,
            np.uint64(first_block + block) * np.uint64(BLOCK),
            states[block],
            results[block],
        )
