r"""The compiled loop of the published protocol: Euler-Maruyama, and the errors at the end.

One step of a path, with the coefficients of `robsmooth.homodyne.montecarlo.schemes.EulerStep`:

.. math::

    \varphi &\leftarrow \varphi + a\varphi + q\,g_2,\\
    \hat x &\leftarrow \hat x + F\hat x + b_c\sin(c\hat x) + b_s[\sin(\varphi - r\hat x) + w g_1] .

The state of `LANES` paths, a *block*, lies row after row in one flat array: row 0 the phase, rows 1
to n the estimator's state. The order n is passed as the length of a tuple, hence known when the
kernel is compiled: the sums over states are unrolled, the loop over lanes is vectorised, and a
lane's state stays in registers for a step. Each order is compiled once and kept on disk. What is
called is inlined by numba: compiled again at each level it is linked into, it would lose registers.

`simulate_blocks` is the only entry point. Each block writes its own part of the result, so the
result does not depend on the number of threads, nor on how blocks are shared out over calls.
"""

import numpy as np
from numba import njit, prange

from robsmooth._support.kernels import kept
from robsmooth.homodyne.montecarlo.lanes import TURN, shared_sources, slip
from robsmooth.homodyne.montecarlo.noise import (
    DRAWS,
    LANES,
    WORDS,
    fill_gaussians,
    fma,
    seed_lanes,
    sine,
    with_item,
)

CHUNK = 32  # steps for which noise is drawn ahead (32 KiB), and between two looks at the lock
OUTPUTS = 3  # of a path: squared filtered and smoothed error at the end, and cycle slips
FILTERED, SMOOTHED, SLIPS = range(OUTPUTS)
SOURCES = shared_sources()


def rows(order: int) -> int:
    """Rows of `LANES` numbers that a block's state takes."""
    return 1 + order


@njit(inline="always")
def euler_steps(order, coefficients, steps, state, gaussians):
    """Advance a block by `steps` steps with the noise of `fill_gaussians`."""
    n = len(order)
    reference, copy, sine_gain, copy_gain = n * n, n * n + n, n * n + 2 * n, n * n + 3 * n
    noise = coefficients[n * n + 4 * n]
    decay, diffusion = coefficients[n * n + 4 * n + 1], coefficients[n * n + 4 * n + 2]
    for step in range(steps):
        draw = step * DRAWS * LANES
        for lane in range(LANES):
            phase = state[lane]
            error = phase
            copied = coefficients[copy] * state[LANES + lane]
            x = order
            for j in range(n):
                x = with_item(x, j, state[(1 + j) * LANES + lane])
                error = fma(-coefficients[reference + j], x[j], error)
                if j > 0:
                    copied = fma(coefficients[copy + j], x[j], copied)
            phase = fma(decay, phase, phase)
            state[lane] = fma(diffusion, gaussians[draw + LANES + lane], phase)
            measured = fma(noise, gaussians[draw + lane], sine(error))
            predicted = sine(copied)
            for i in range(n):
                y = x[i]
                for j in range(n):
                    y = fma(coefficients[i * n + j], x[j], y)
                y = fma(coefficients[copy_gain + i], predicted, y)
                y = fma(coefficients[sine_gain + i], measured, y)
                state[(1 + i) * LANES + lane] = y


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
        for lane in range(LANES):
            away = np.float64(state[lane]) - turns[lane]
            for j in range(n):
                away = fma(-readout[2, j], np.float64(state[(1 + j) * LANES + lane]), away)
            passed = slip(away)
            turns[lane] += TURN * passed
            result[SLIPS, lane] += abs(passed)


@njit
def collect(order, readout, state, delayed, result):
    """Write the squared errors: against the phase, and against the phase `delayed`, a delay ago."""
    for lane in range(LANES):
        filtered, smoothed = np.float64(state[lane]), np.float64(delayed[lane])
        for j in range(len(order)):
            x = np.float64(state[(1 + j) * LANES + lane])
            filtered = fma(-readout[0, j], x, filtered)
            smoothed = fma(-readout[1, j], x, smoothed)
        result[FILTERED, lane] = filtered * filtered
        result[SMOOTHED, lane] = smoothed * smoothed


@njit(inline="always")
def simulate_block(order, coefficients, readout, schedule, seed, first_path, state, result):
    """Simulate paths `first_path` to `first_path + LANES - 1`, from zero to the end."""
    before, delay = schedule
    generator = np.empty(WORDS * LANES, np.uint32)
    gaussians = np.empty(CHUNK * DRAWS * LANES, np.float32)
    delayed = np.empty(LANES, state.dtype)
    turns = np.zeros(LANES)

    seed_lanes(seed, first_path, generator)
    state[:] = 0
    result[:] = 0
    advance(order, coefficients, readout, before, state, generator, gaussians, turns, result)
    delayed[:] = state[:LANES]
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
    coefficients : (n * n + 4 * n + 3,) array
        `EulerStep.coefficients`, in the precision of `states`.
    readout : (3, n) array of float64
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    schedule : tuple of 2 int
        Steps before the phase is recorded, and after it: the delay.
    seed : uint64
    first_block : int
        Block b holds the paths ``b * LANES`` to ``(b + 1) * LANES - 1``.
    states : (blocks, rows(n) * LANES) array of float32 or float64
        Work space; its type is the precision of the simulation.
    results : (blocks, OUTPUTS, LANES) array of float64
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
            np.uint64(first_block + block) * np.uint64(LANES),
            states[block],
            results[block],
        )
