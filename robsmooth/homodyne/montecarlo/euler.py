"""The compiled loop of the published protocol: Euler-Maruyama, and the errors at the end.

`docs/source/simulation.md` has the step, with the names of `Coefficients`. The order n is the
length of the tuple `order`, which the compiler knows. Each order is compiled once and kept on disk.
Numba inlines the callees, because linked ones use registers worse.
"""

from collections import namedtuple

import numpy as np
from numba import njit, prange
from numba.extending import register_jitable

from robsmooth._numerics.vectors import BLOCK, LANES, add_product, fma, is_set, load, store
from robsmooth._support.kernels import kept
from robsmooth.homodyne.loop import Loop
from robsmooth.simulation import noise
from robsmooth.simulation.noise import DRAWS, SOURCES, WORDS, sine

CHUNK = 32  # steps for which noise is drawn ahead (16 KiB), and between two looks at the lock
# Of a path: squared filtered and smoothed error at the end, cycle slips, turns away.
FILTERED, SMOOTHED, SLIPS, TURNS = range(4)
OUTPUTS = TURNS + 1
UNDAMPED = 1e-12  # of a mode's rate: less damping is rounding

# Of a step; in a kernel, where each begins in the flat array of all.
Coefficients = namedtuple("Coefficients", "arguments response noise decay diffusion")


@register_jitable
def indices(n):
    """Return where the coefficients begin; in a kernel these are constants."""
    scalars = 2 * n + n * (n + 2)
    return Coefficients(0, 2 * n, scalars, scalars + 1, scalars + 2)


def coefficients_of(loop: Loop, step: float) -> Coefficients:
    """Return the coefficients of a step, in s."""
    root, tiny = np.sqrt(step), np.finfo(np.float32).tiny
    coefficients = Coefficients(
        loop.arguments[:, 1:],  # (2, n), -r and c
        step * np.hstack([loop.drift[1:, 1:], loop.gains[1:, ::-1]]),  # (n, n + 2): F, b_c, b_s
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
    at, pair = indices(len(order)), (order[0], order[0])
    for step in range(steps):
        for path in range(0, BLOCK, LANES):
            g1, g2 = load(gaussians, step * DRAWS * BLOCK + path, pair)
            (phase,), x = load(state, path, order[:1]), load(state, BLOCK + path, order)
            error, copied = add_product(coefficients, at.arguments, x, (phase, 0.0))
            measured = fma(coefficients[at.noise], g1, sine(error))
            x = add_product(coefficients, at.response, (*x, sine(copied), measured), x)
            phase = fma(coefficients[at.decay], phase, phase)
            phase = fma(coefficients[at.diffusion], g2, phase)
            store(state, path, (phase, *x))


@njit(inline="always")
def advance(order, coefficients, readout, steps, state, generator, gaussians, result, stop):
    """Advance a block by `steps` steps, or to the `stop`, and count its cycle slips."""
    done = 0
    while done < steps and not is_set(stop):
        count = min(CHUNK, steps - done)
        noise.fill_gaussians(generator, count, gaussians)
        euler_steps(order, coefficients, count, state, gaussians)
        done += count
        for path in range(0, BLOCK, LANES):
            (phase,), x = load(state, path, order[:1]), load(state, BLOCK + path, order)
            _, _, lock = add_product(readout, 0, x, (0.0, 0.0, phase))
            noise.count_slips(lock, SLIPS * BLOCK + path, result)


@njit
def collect(order, readout, state, delayed, result):
    """Write the squared errors against the phase now, and against `delayed`, that a delay ago."""
    for path in range(0, BLOCK, LANES):
        (phase,), x = load(state, path, order[:1]), load(state, BLOCK + path, order)
        (before,) = load(delayed, path, order[:1])
        filtered, smoothed, _ = add_product(readout, 0, x, (phase, before, 0.0))
        store(result, FILTERED * BLOCK + path, (filtered * filtered, smoothed * smoothed))


@njit(inline="always")
def simulate_block(order, coefficients, readout, schedule, seed, first_path, result, stop):
    """Simulate paths `first_path` to `first_path + BLOCK - 1`, from zero to the end."""
    before, delay = schedule
    generator = noise.aligned(WORDS * BLOCK, np.uint32)
    gaussians = noise.aligned(CHUNK * DRAWS * BLOCK, np.float32)
    state = noise.aligned((1 + len(order)) * BLOCK, coefficients.dtype)  # phase, then estimator
    delayed = noise.aligned(BLOCK, coefficients.dtype)
    noise.seed_paths(seed, first_path, generator)
    result[:] = 0
    advance(order, coefficients, readout, before, state, generator, gaussians, result, stop)
    delayed[:] = state[:BLOCK]
    advance(order, coefficients, readout, delay, state, generator, gaussians, result, stop)
    collect(order, readout, state, delayed, result)


@kept(parallel=True, nogil=True)
def simulate_blocks(
    order, coefficients, readout, schedule, seed, first, results, stop, code=SOURCES
):
    """Simulate consecutive blocks: block b has the paths from b BLOCK on.

    The rows of the readout are filtered and smoothed estimate and oscillator's phase, all negative.
    The schedule has the steps before the delayed phase is recorded, and those of the delay. The
    results, (blocks, OUTPUTS * BLOCK), depend neither on threads nor on the split into calls.
    """
    for block in prange(results.shape[0]):
        path = np.uint64(first + block) * np.uint64(BLOCK)
        simulate_block(order, coefficients, readout, schedule, seed, path, results[block], stop)
