r"""The compiled loop of the published protocol: Euler-Maruyama, and the errors at the end.

One step of a path, with the `Coefficients`:

.. math::

    \varphi &\leftarrow \varphi + a\varphi + q\,g_2,\\
    \hat x &\leftarrow \hat x + F\hat x + b_c\sin(c\hat x) + b_s[\sin(\varphi - r\hat x) + w g_1] .

`BLOCK` paths are simulated side by side in vector registers. The order n is the length of the tuple
`order`, which the compiler knows: it unrolls the sums over states, vectorises the loop over paths,
and keeps the state of a path in registers for a step. Each order is compiled once and kept on disk.
Numba inlines the callees, because linked ones use registers worse.
"""

from collections import namedtuple

import numpy as np
from numba import njit, prange
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.extending import register_jitable

from robsmooth._support.kernels import kept
from robsmooth.homodyne.loop import Loop
from robsmooth.simulation import noise
from robsmooth.simulation.noise import BLOCK, DRAWS, SOURCES, TURN, WORDS, fma, sine, slip

CHUNK = 32  # steps for which noise is drawn ahead (32 KiB), and between two looks at the lock
OUTPUTS = 3  # of a path: squared filtered and smoothed error at the end, and cycle slips
FILTERED, SMOOTHED, SLIPS = range(OUTPUTS)
UNDAMPED = 1e-12  # of a mode's rate: less damping is rounding

# Of a step; in a kernel, where each begins in the flat array of all.
Coefficients = namedtuple(
    "Coefficients", "increments reference copy sine_gain copy_gain noise decay diffusion"
)


@register_jitable
def indices(n):
    """Return where the coefficients begin; in a kernel these are constants."""
    v = n * n  # where the vectors begin
    s = v + 4 * n  # and the scalars
    return Coefficients(0, v, v + n, v + 2 * n, v + 3 * n, s, s + 1, s + 2)


def coefficients_of(loop: Loop, step: float) -> Coefficients:
    """Return the coefficients of a step, in s."""
    root, tiny = np.sqrt(step), np.finfo(np.float32).tiny
    coefficients = Coefficients(
        step * loop.drift[1:, 1:],  # (n, n), F
        -loop.arguments[0, 1:],  # (n,), r
        loop.arguments[1, 1:],  # (n,), c
        *(step * loop.gains[1:].T),  # (n,) each, b_s and b_c
        noise=loop.sine_noise / root,  # w
        decay=step * loop.drift[0, 0],  # a
        diffusion=root * loop.noise[0, 0],  # q
    )
    # processors are slow with numbers that are denormal in single precision
    return Coefficients(*(np.where(np.abs(part) < tiny, 0.0, part) for part in coefficients))


def longest_stable_step(loop: Loop) -> float:
    """Return the least step, s, that lets a decaying mode grow, |1 + lambda step| > 1, or inf."""
    modes = np.linalg.eigvals(loop.linearised_drift())
    decaying = modes[modes.real < -UNDAMPED * np.abs(modes)]
    return float((-2.0 * decaying.real / np.abs(decaying) ** 2).min(initial=np.inf))


@njit(inline="always")
def euler_steps(order, coefficients, steps, state, gaussians):
    """Advance a block by `steps` steps with the noise of `fill_gaussians`."""
    n = len(order)
    at = indices(n)
    shot_noise = coefficients[at.noise]
    decay, diffusion = coefficients[at.decay], coefficients[at.diffusion]
    for step in range(steps):
        draw = step * DRAWS * BLOCK
        for path in range(BLOCK):
            phase = state[path]
            error = phase
            copied = coefficients[at.copy] * state[BLOCK + path]
            x = order
            for j in range(n):
                x = tuple_setitem(x, j, state[(1 + j) * BLOCK + path])
                error = fma(-coefficients[at.reference + j], x[j], error)
                if j > 0:
                    copied = fma(coefficients[at.copy + j], x[j], copied)
            phase = fma(decay, phase, phase)
            state[path] = fma(diffusion, gaussians[draw + BLOCK + path], phase)
            measured = fma(shot_noise, gaussians[draw + path], sine(error))
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
        noise.fill_gaussians(generator, count, gaussians)
        euler_steps(order, coefficients, count, state, gaussians)
        done += count
        for path in range(BLOCK):
            away = np.float64(state[path]) - turns[path]
            for j in range(n):
                away = fma(-readout[2 * n + j], np.float64(state[(1 + j) * BLOCK + path]), away)
            passed = slip(away)
            turns[path] += TURN * passed
            result[SLIPS * BLOCK + path] += abs(passed)


@njit
def collect(order, readout, state, delayed, result):
    """Write the squared errors against the phase now, and against `delayed`, that a delay ago."""
    n = len(order)
    for path in range(BLOCK):
        filtered, smoothed = np.float64(state[path]), np.float64(delayed[path])
        for j in range(n):
            x = np.float64(state[(1 + j) * BLOCK + path])
            filtered = fma(-readout[j], x, filtered)
            smoothed = fma(-readout[n + j], x, smoothed)
        result[FILTERED * BLOCK + path] = filtered * filtered
        result[SMOOTHED * BLOCK + path] = smoothed * smoothed


@njit(inline="always")
def simulate_block(order, coefficients, readout, schedule, seed, first_path, result):
    """Simulate paths `first_path` to `first_path + BLOCK - 1`, from zero to the end."""
    before, delay = schedule
    generator = np.empty(WORDS * BLOCK, np.uint32)
    gaussians = np.empty(CHUNK * DRAWS * BLOCK, np.float32)
    state = np.zeros((1 + len(order)) * BLOCK, coefficients.dtype)  # phase, then estimator
    delayed = np.empty(BLOCK, state.dtype)
    turns = np.zeros(BLOCK)
    noise.seed_paths(seed, first_path, generator)
    result[:] = 0
    advance(order, coefficients, readout, before, state, generator, gaussians, turns, result)
    delayed[:] = state[:BLOCK]
    advance(order, coefficients, readout, delay, state, generator, gaussians, turns, result)
    collect(order, readout, state, delayed, result)


@kept(parallel=True, nogil=True)
def simulate_blocks(order, coefficients, readout, schedule, seed, first, results, code=SOURCES):
    """Simulate consecutive blocks: block b has the paths from b BLOCK on.

    The rows of the readout are the filtered and the smoothed estimate and the oscillator's phase.
    The schedule has the steps before the delayed phase is recorded, and those of the delay. The
    results, (blocks, OUTPUTS * BLOCK), depend neither on threads nor on the split into calls.
    """
    for block in prange(results.shape[0]):
        path = np.uint64(first + block) * np.uint64(BLOCK)
        simulate_block(order, coefficients, readout, schedule, seed, path, results[block])
