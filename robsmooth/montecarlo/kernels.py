r"""The compiled loop: Euler-Maruyama steps of many paths, and the errors read out along the way.

One step of a path, with the coefficients of `robsmooth.montecarlo.schemes.EulerLoop`:

.. math::

    \varphi &\leftarrow \varphi + a\varphi + q\,g_2,\\
    \hat x &\leftarrow \hat x + F\hat x + b_s\sin(\varphi - r\hat x) + b_c\sin(c\hat x) + b_w g_1 .

The state of `LANES` paths, a *block*, lies row after row in one flat array: row 0 the phase, rows 1
to n the estimator's state, then the two sines and the estimator's next state. The order n is passed
as the length of a tuple, hence known when the kernel is compiled: the sums over states are unrolled
and the loops over lanes vectorised. Each order is compiled once and kept on disk.

`simulate_blocks` is the only entry point. Each block writes its own part of the result, so the
result does not depend on the number of threads, nor on how blocks are shared out over calls.
"""

import hashlib
from pathlib import Path

import numpy as np
from numba import njit, prange

from robsmooth.montecarlo import noise
from robsmooth.montecarlo.noise import DRAWS, LANES, WORDS, fill_gaussians, fma, seed_lanes, sine

CHUNK = 64  # steps for which noise is drawn ahead: 16 KiB
OUTPUTS = 3  # of a path: mean squared filtered and smoothed error, and whether it lost lock
FILTERED, SMOOTHED, SLIPPED = range(OUTPUTS)
HALF_TURN = np.pi


def rows(order: int) -> int:
    """Rows of `LANES` numbers that a block's state takes."""
    return 3 + 2 * order


@njit
def euler_steps(order, phase_step, estimator_step, steps, state, gaussians):
    """Advance a block by `steps` steps with the noise of `fill_gaussians`."""
    n = len(order)
    decay, diffusion = phase_step[0], phase_step[1]
    increments = estimator_step[:n]
    reference = estimator_step[n]
    copy = estimator_step[n + 1]
    sine_gain = estimator_step[n + 2]
    copy_gain = estimator_step[n + 3]
    noise_gain = estimator_step[n + 4]
    row_measured, row_predicted = (1 + n) * LANES, (2 + n) * LANES
    row_next = (3 + n) * LANES
    for step in range(steps):
        draw = step * DRAWS * LANES
        for lane in range(LANES):
            phase = state[lane]
            error = phase
            copied = phase - phase
            for j in range(n):
                x = state[(1 + j) * LANES + lane]
                error = fma(-reference[j], x, error)
                copied = fma(copy[j], x, copied)
            state[row_measured + lane] = sine(error)
            state[row_predicted + lane] = sine(copied)
            phase = fma(decay, phase, phase)
            state[lane] = fma(diffusion, gaussians[draw + LANES + lane], phase)
        for i in range(n):
            for lane in range(LANES):
                x = state[(1 + i) * LANES + lane]
                for j in range(n):
                    x = fma(increments[i, j], state[(1 + j) * LANES + lane], x)
                x = fma(sine_gain[i], state[row_measured + lane], x)
                x = fma(copy_gain[i], state[row_predicted + lane], x)
                x = fma(noise_gain[i], gaussians[draw + lane], x)
                state[row_next + i * LANES + lane] = x
        for i in range(n * LANES):
            state[LANES + i] = state[row_next + i]


@njit
def advance(order, phase_step, estimator_step, steps, state, generator, gaussians):
    """Advance a block by `steps` steps."""
    done = 0
    while done < steps:
        count = min(CHUNK, steps - done)
        fill_gaussians(generator, count, gaussians)
        euler_steps(order, phase_step, estimator_step, count, state, gaussians)
        done += count


@njit
def collect(order, readout, state, delayed, result):
    """Add the squared errors of a block, and note the paths that are out of lock.

    The filtered error is taken against the phase, the smoothed one against the phase `delayed`, a
    delay ago. Out of lock: the phase is more than half a turn from the local oscillator's.
    """
    for lane in range(LANES):
        filtered = np.float64(state[lane])
        smoothed = np.float64(delayed[lane])
        lock = np.float64(state[lane])
        for j in range(len(order)):
            x = np.float64(state[(1 + j) * LANES + lane])
            filtered = fma(-readout[0, j], x, filtered)
            smoothed = fma(-readout[1, j], x, smoothed)
            lock = fma(-readout[2, j], x, lock)
        result[FILTERED, lane] += filtered * filtered
        result[SMOOTHED, lane] += smoothed * smoothed
        if abs(lock) > HALF_TURN:
            result[SLIPPED, lane] = 1.0


@njit
def simulate_block(
    order, phase_step, estimator_step, readout, schedule, seed, first_path, state, result
):
    """Simulate paths `first_path` to `first_path + LANES - 1`, from zero to the last sample."""
    start, stride, lag, samples = schedule
    generator = np.empty(WORDS * LANES, np.uint32)
    gaussians = np.empty(CHUNK * DRAWS * LANES, np.float32)
    history = np.empty((lag + 1, LANES), state.dtype)  # the phase at the last samples, a ring

    seed_lanes(seed, first_path, generator)
    for i in range(state.size):
        state[i] = 0
    for output in range(OUTPUTS):
        for lane in range(LANES):
            result[output, lane] = 0
    advance(order, phase_step, estimator_step, start, state, generator, gaussians)
    for sample in range(lag + samples):
        if sample > 0:
            advance(order, phase_step, estimator_step, stride, state, generator, gaussians)
        newest = sample % (lag + 1)
        for lane in range(LANES):
            history[newest, lane] = state[lane]
        if sample >= lag:
            collect(order, readout, state, history[(sample - lag) % (lag + 1)], result)
    for lane in range(LANES):
        result[FILTERED, lane] /= samples
        result[SMOOTHED, lane] /= samples


@njit(parallel=True, cache=True)
def simulate_blocks(
    order, phase_step, estimator_step, readout, schedule, seed, first_block, states, results
):
    """Simulate as many consecutive blocks as `results` has room for.

    Parameters
    ----------
    order : tuple of n int
        Only its length counts.
    phase_step, estimator_step, readout : (2,), (n + 5, n) and (3, n) arrays
        The coefficients `EulerLoop.phase_step`, `.estimator_step` and `.readout`; the first two in
        the precision of `states`, the last in float64.
    schedule : tuple of 4 int
        A `Schedule`: steps before the first sample of the phase, steps between samples, the delay
        in samples, number of samples of the errors.
    seed : uint64
    first_block : int
        Block b holds the paths ``b * LANES`` to ``(b + 1) * LANES - 1``.
    states : (blocks, rows(n) * LANES) array of float32 or float64
        Work space; its type is the precision of the simulation.
    results : (blocks, OUTPUTS, LANES) array of float64
        Written: mean over the samples of the squared errors; 1 where a sample was out of lock.
    """
    for block in prange(results.shape[0]):
        simulate_block(
            order,
            phase_step,
            estimator_step,
            readout,
            schedule,
            seed,
            np.uint64(first_block + block) * np.uint64(LANES),
            states[block],
            results[block],
        )


def sources_digest() -> str:
    """Digest of all that is compiled here: this module and `robsmooth.montecarlo.noise`."""
    sources = (Path(__file__), Path(noise.__file__))
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


# numba keeps compiled code for as long as this one file is unchanged, but noise.py is in it too.
simulate_blocks._cache._cache_file._source_stamp = sources_digest()
