r"""The compiled loop of the ergodic protocol: a second-order scheme with a linear control.

A step is :math:`L_hK_h`: the exact step of the statistically linearised loop, then the kick of the
sines less their slopes; `docs/source/simulation.md` has both, and slips and the control variate.
The state of a block is :math:`\phi`, the estimator's part of the control y, and
:math:`d = \hat x - y`, which starts at zero and has no noise of its own.
"""

from collections import namedtuple

import numpy as np
from numba import njit, prange
from numba.extending import register_jitable

from robsmooth._numerics.lyapunov import noise_root, square_root
from robsmooth._numerics.steps import responses
from robsmooth._numerics.vectors import BLOCK, LANES, add_product, fma, is_set, load, store
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.kernels import kept
from robsmooth.homodyne.loop import Loop
from robsmooth.simulation import noise
from robsmooth.simulation.noise import DRAWS, SOURCES, TURN, WORDS, sine

CHUNK = 8  # steps for which noise is drawn ahead
# Of a path: time averages of the loop and of its control, cycle slips, turns away.
FILTERED, SMOOTHED, CONTROL_FILTERED, CONTROL_SMOOTHED, CONTROL_FOURTH, SLIPS, TURNS = range(7)
OUTPUTS = TURNS + 1
ERRORS, CONTROLS = slice(FILTERED, CONTROL_FILTERED), slice(CONTROL_FILTERED, SLIPS)
MEANS = (0.0,) * SLIPS
SLOPE_TOLERANCE = 1e-3  # of the control's slopes, which need not be the best
QUARTER_TURN = TURN / 4

# Of a step with m Gaussians; in a kernel, where each begins in the flat array of all.
Coefficients = namedtuple(
    "Coefficients", "control difference gains arguments curvatures slopes start"
)


@register_jitable
def indices(n, m):
    """Return where the coefficients begin; in a kernel these are constants."""
    difference = (1 + n) * (1 + n + m)
    gains = difference + n * (n + 3)
    arguments, curvatures = gains + 2 * n, gains + 4 * n
    return Coefficients(0, difference, gains, arguments, curvatures, curvatures + 4, curvatures + 6)


def coefficients_of(loop: Loop, step: float, slopes: tuple[float, float]) -> Coefficients:
    """Return the coefficients of a step, in s; the slopes are those of the control."""
    drift = loop.linearised_drift(*slopes)
    transition, push, _ = responses(drift, -slopes[0] * loop.gains[:, :1], step)
    triangle = noise_root(drift, loop.noise, step)
    root = square_root(triangle @ triangle.T)  # the triangle would give other paths for a seed
    root = np.pad(root, ((0, 0), (0, -len(root) % DRAWS)))  # Gaussians come in pairs
    gains, arguments = step * loop.gains[1:], loop.arguments[:, 1:]
    of_state = transition[1:, 1:]
    return Coefficients(
        np.hstack([transition, root]),  # (1 + n, 1 + n + m), of the control: Phi, root of cov eta
        np.hstack([of_state, of_state @ gains, push[1:]]),  # (n, n + 3), by x, kick and T
        gains,  # (n, 2), h b_s and h b_c
        arguments,  # (2, n), -r and c
        arguments @ gains,  # (2, 2)
        slopes,  # rho_s, rho_c
        start=square_root(loop.covariance(*slopes)),  # the control is stationary
    )


def control_slopes(loop: Loop) -> tuple[float, float]:
    """Return the equivalent slopes, or one: the means of the control are exact for any slopes."""
    try:
        return loop.equivalent_slopes(SLOPE_TOLERANCE)
    except UnstableLoopError:
        return 1.0, 1.0


@njit(inline="always")
def find_kick(at, coefficients, phase, y, d, turns):
    """Return the kick's terms of first and of second order along h b_s, h b_c, and T."""
    sine_slope, copy_slope = coefficients[at.slopes], coefficients[at.slopes + 1]
    e, v = add_product(coefficients, at.arguments, y, (phase, 0.0))
    e, v = add_product(coefficients, at.arguments, d, (e, v))
    # Half of the kick ends a step, with its T; half starts the next, with a new T.
    nearest = noise.whole_turns(e)
    s = fma(-sine_slope, fma(turns + nearest, -0.5, e), sine(e))
    c = fma(-copy_slope, v, sine(v))
    e_moves, v_moves = add_product(coefficients, at.curvatures, (s, c), (0.0, 0.0))
    bend_s = (sine(e + QUARTER_TURN) - sine_slope) * e_moves
    bend_c = (sine(v + QUARTER_TURN) - copy_slope) * v_moves
    return s, c, bend_s, bend_c, nearest


@njit(inline="always")
def collect(readout, phase, delayed, y, x_less_y, path, result):
    """Add the errors of paths and of their control; count cycle slips."""
    control = add_product(readout, 0, y, (phase, delayed, phase))
    filtered, smoothed, lock = add_product(readout, 0, x_less_y, control)
    square = control[0] * control[0]
    a, b, c, d, e = load(result, path, MEANS)
    sums = (fma(filtered, filtered, a), fma(smoothed, smoothed, b), c + square)
    store(result, path, (*sums, fma(control[1], control[1], d), fma(square, square, e)))
    noise.count_slips(lock, SLIPS * BLOCK + path, result)


@njit(inline="always")
def take_step(model, gaussians, path, state, delayed, sample, result):
    """Advance paths of a block by a step; first collect their errors, if they are a sample."""
    order, pair, coefficients, readout = model
    n = len(order)
    at, zero = indices(n, len(pair)), order[:1]
    (phase,), y = load(state, path, zero), load(state, BLOCK + path, order)
    d = load(state, (1 + n) * BLOCK + path, order)
    (turns,) = load(state, (1 + 2 * n) * BLOCK + path, zero)
    s, c, bend_s, bend_c, turns = find_kick(at, coefficients, phase, y, d, turns)
    if sample:
        half = fma(bend_s, 0.125, 0.5 * s), fma(bend_c, 0.125, 0.5 * c)
        halfway = add_product(coefficients, at.gains, half, d)
        collect(readout, phase, delayed, y, halfway, path, result)
    g = load(gaussians, path, pair)
    control = add_product(coefficients, at.control, (phase, *y, *g), zero + order)
    kicked = (*d, fma(bend_s, 0.5, s), fma(bend_c, 0.5, c), turns)
    d = add_product(coefficients, at.difference, kicked, order)
    store(state, path, (*control, *d, turns))


@njit
def simulate_block(order, pair, coefficients, readout, schedule, seed, first_path, result, stop):
    """Simulate paths `first_path` to `first_path + BLOCK - 1`, from a stationary start."""
    warm_up, delay, steps = schedule
    n, m = len(order), len(pair)
    model, zero, start = (order, pair, coefficients, readout), order[:1], indices(n, m).start
    generator = noise.aligned(WORDS * BLOCK, np.uint32)
    gaussians = noise.aligned(CHUNK * m * BLOCK, np.float32)
    state = noise.aligned(2 * (1 + n) * BLOCK, coefficients.dtype)  # phase, y, d, T
    history = noise.aligned((delay + 1) * BLOCK, coefficients.dtype)  # of the phase, a ring
    result[:] = 0
    noise.seed_paths(seed, first_path, generator)
    noise.fill_gaussians(generator, m // DRAWS, gaussians)
    for path in range(0, BLOCK, LANES):
        g = load(gaussians, path, zero + order)
        store(state, path, add_product(coefficients, start, g, zero + order))

    last = warm_up + steps
    for chunk in range(1 + last // CHUNK):
        if is_set(stop):
            break
        noise.fill_gaussians(generator, CHUNK * (m // DRAWS), gaussians)
        # The last sample is at the start of a step, whose end is not used.
        for step in range(min(CHUNK, 1 + last - chunk * CHUNK)):
            now = chunk * CHUNK + step
            record, before = now % (delay + 1) * BLOCK, (now + 1) % (delay + 1) * BLOCK
            draws = gaussians[step * m * BLOCK :]
            for path in range(0, BLOCK, LANES):
                store(history, record + path, load(state, path, zero))
                (delayed,) = load(history, before + path, zero)
                take_step(model, draws, path, state, delayed, now >= warm_up, result)
    for i in range(SLIPS * BLOCK):
        result[i] /= steps + 1


@kept(parallel=True, nogil=True)
def simulate_blocks(
    order, pair, coefficients, readout, schedule, seed, first, results, stop, code=SOURCES
):
    """Simulate consecutive blocks, as `euler.simulate_blocks` does.

    The schedule has the steps of the warm-up, of the delay, at most as many, and those whose ends
    are sampled. The length of `pair` is the number of Gaussians of a step.
    """
    for block in prange(results.shape[0]):
        path = np.uint64(first + block) * np.uint64(BLOCK)
        result = results[block]
        simulate_block(order, pair, coefficients, readout, schedule, seed, path, result, stop)
