r"""The compiled loop of the ergodic protocol: a second-order scheme beside its linear control.

Statistically linearised, the loop is :math:`dz = Az\,dt + dn` for :math:`z = (\varphi, \hat x)`. A
step of that over a time h is taken exactly,

.. math::

    L_h: z \leftarrow \Phi z + \eta,\qquad \Phi = e^{Ah},\quad
    \operatorname{cov}\eta = \int_0^h e^{As}Qe^{A's}\,ds,

and what the sines differ from their slopes is a kick,

.. math::

    K_h: \hat x \leftarrow \hat x + h F + \tfrac12 h^2 DF\,F,\qquad
    F = b_s(\sin e - \rho_s e) + b_c(\sin v - \rho_c v),

with :math:`e = \varphi - r\hat x` and :math:`v = c\hat x`. Strang's composition
:math:`K_{h/2}L_hK_{h/2}` is of second order in h, and exact where the loop is linear. Steps are
taken as :math:`L_hK_h`; a sample is read after a further :math:`K_{h/2}`, which is not kept.

A path that has slipped is linearised about the point at which it is locked now: with T the multiple
of :math:`2\pi` nearest to e, the kick has :math:`e - T` in place of :math:`\rho_s e`'s e, and
:math:`-\rho_sT\int_0^h e^{As}\,ds\,b_s` is added to the exact step.

The same noise drives the linear loop :math:`y \leftarrow \Phi y + \eta` from its stationary law. It
is the control variate: its moments are known exactly, and the loop differs from it by little. The
state of a block is :math:`\varphi`, the estimator's part of y, and :math:`d = \hat x - y`, which
starts at zero and has no noise of its own.
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
    whole_turns,
    with_item,
)

CHUNK = 8  # steps for which noise is drawn ahead
OUTPUTS = 7  # of a path: time averages of the loop and of its control, cycle slips, turns away
FILTERED, SMOOTHED, CONTROL_FILTERED, CONTROL_SMOOTHED, CONTROL_FOURTH, SLIPS, TURNS = range(
    OUTPUTS
)
SOURCES = shared_sources()


# --- the layout of a block ------------------------------------------------------------------------
#
# All that a step writes lies in one flat array, and all that it reads in two more: the compiler
# must check at run time that arrays do not overlap, and with more of them it would not vectorise.
#
# state         rows of LANES numbers: phase | n of y | n of d | 2 terms of the kick along b_s
#               | 2 along b_c | the phase a delay ago | T
# coefficients  (1 + n, 1 + n) transition | (1 + n, m) root | (2, n) gains h b_s, h b_c
#               | (2, n) arguments r, c | (2, n) transition of the gains | 2 slopes
#               | r h b_s, r h b_c, c h b_s, c h b_c | a quarter turn | n of the step's push by T


def rows(order: int) -> int:
    """Rows of `LANES` numbers that a block's state takes."""
    return 7 + 2 * order


def draws(order: int) -> int:
    """Gaussians a step: one for each state, in pairs."""
    return DRAWS * -(-(1 + order) // DRAWS)


@njit
def find_kick(order, pair, copies, coefficients, state):
    """Write the kick's terms of first and of second order along h b_s, and along h b_c."""
    n, m = len(order), len(pair)
    first_s, second_s = (1 + 2 * n) * LANES, (2 + 2 * n) * LANES
    first_c, second_c = (3 + 2 * n) * LANES, (4 + 2 * n) * LANES
    row_turns = (6 + 2 * n) * LANES
    reference = (1 + n) * (1 + n + m) + 2 * n
    copy = reference + n
    slopes = copy + 3 * n
    sine_slope, copy_slope = coefficients[slopes], coefficients[slopes + 1]
    r_s, r_c = coefficients[slopes + 2], coefficients[slopes + 3]
    c_s, c_c = coefficients[slopes + 4], coefficients[slopes + 5]
    quarter_turn = coefficients[slopes + 6]
    if copies:
        for lane in range(LANES):
            e = state[lane]
            v = e - e
            for j in range(n):
                x = state[(1 + j) * LANES + lane] + state[(1 + n + j) * LANES + lane]
                e = fma(-coefficients[reference + j], x, e)
                v = fma(coefficients[copy + j], x, v)
            # Half of the kick ends a step, with that T; half starts the next, with a new one.
            turns = whole_turns(e)
            s = fma(-sine_slope, fma(turns + state[row_turns + lane], -0.5, e), sine(e))
            state[row_turns + lane] = turns
            q = fma(-copy_slope, v, sine(v))
            state[first_s + lane] = s
            state[first_c + lane] = q
            state[second_s + lane] = (sine_slope - sine(e + quarter_turn)) * fma(r_s, s, r_c * q)
            state[second_c + lane] = (sine(v + quarter_turn) - copy_slope) * fma(c_s, s, c_c * q)
    else:
        for lane in range(LANES):
            e = state[lane]
            for j in range(n):
                x = state[(1 + j) * LANES + lane] + state[(1 + n + j) * LANES + lane]
                e = fma(-coefficients[reference + j], x, e)
            turns = whole_turns(e)
            s = fma(-sine_slope, fma(turns + state[row_turns + lane], -0.5, e), sine(e))
            state[row_turns + lane] = turns
            state[first_s + lane] = s
            state[second_s + lane] = (sine_slope - sine(e + quarter_turn)) * (r_s * s)


@njit
def split_step(order, pair, copies, coefficients, gaussians, state):
    """Advance a block by the kick that was found, and by the exact step after it."""
    n, m = len(order), len(pair)
    first_s, second_s = (1 + 2 * n) * LANES, (2 + 2 * n) * LANES
    first_c, second_c = (3 + 2 * n) * LANES, (4 + 2 * n) * LANES
    root = (1 + n) * (1 + n)
    kicked = root + (1 + n) * m + 4 * n
    pushed = kicked + 2 * n + 7
    row_turns = (6 + 2 * n) * LANES
    for lane in range(LANES):
        phase = state[lane]
        kick_s = fma(state[second_s + lane], 0.5, state[first_s + lane])
        kick_c = fma(state[second_c + lane], 0.5, state[first_c + lane])
        y = d = order
        g = pair
        for j in range(n):
            y = with_item(y, j, state[(1 + j) * LANES + lane])
            d = with_item(d, j, state[(1 + n + j) * LANES + lane])
        for j in range(m):
            g = with_item(g, j, gaussians[j * LANES + lane])
        for i in range(n):
            row, of_noise = (1 + i) * (1 + n), root + (1 + i) * m
            of_y = coefficients[row] * phase
            of_d = coefficients[pushed + i] * state[row_turns + lane]
            of_d = fma(coefficients[kicked + i], kick_s, of_d)
            if copies:
                of_d = fma(coefficients[kicked + n + i], kick_c, of_d)
            for j in range(m):
                of_y = fma(coefficients[of_noise + j], g[j], of_y)
            for j in range(n):
                of_y = fma(coefficients[row + 1 + j], y[j], of_y)
                of_d = fma(coefficients[row + 1 + j], d[j], of_d)
            state[(1 + i) * LANES + lane] = of_y
            state[(1 + n + i) * LANES + lane] = of_d
        phase = coefficients[0] * phase
        for j in range(m):
            phase = fma(coefficients[root + j], g[j], phase)
        state[lane] = phase


@njit
def collect(order, pair, copies, coefficients, readout, state, result):
    """Add the errors of a block and of its control after half a kick; note cycle slips.

    The filtered error is taken against the phase, the smoothed one against the phase a delay ago.
    """
    n, m = len(order), len(pair)
    first_s, second_s = (1 + 2 * n) * LANES, (2 + 2 * n) * LANES
    first_c, second_c = (3 + 2 * n) * LANES, (4 + 2 * n) * LANES
    row_delayed = (5 + 2 * n) * LANES
    gains = (1 + n) * (1 + n + m)
    for lane in range(LANES):
        kick_s = 0.5 * state[first_s + lane] + 0.125 * state[second_s + lane]
        kick_c = 0.5 * state[first_c + lane] + 0.125 * state[second_c + lane]
        control_filtered = np.float64(state[lane])
        control_smoothed = np.float64(state[row_delayed + lane])
        lock = control_filtered
        filtered = smoothed = lock - lock
        for j in range(n):
            y = np.float64(state[(1 + j) * LANES + lane])
            d = fma(kick_s, coefficients[gains + j], np.float64(state[(1 + n + j) * LANES + lane]))
            if copies:
                d = fma(kick_c, coefficients[gains + n + j], d)
            control_filtered = fma(-readout[j], y, control_filtered)
            control_smoothed = fma(-readout[n + j], y, control_smoothed)
            filtered = fma(-readout[j], d, filtered)
            smoothed = fma(-readout[n + j], d, smoothed)
            lock = fma(-readout[2 * n + j], y + d, lock)
        filtered += control_filtered
        smoothed += control_smoothed
        square = control_filtered * control_filtered
        result[FILTERED * LANES + lane] += filtered * filtered
        result[SMOOTHED * LANES + lane] += smoothed * smoothed
        result[CONTROL_FILTERED * LANES + lane] += square
        result[CONTROL_SMOOTHED * LANES + lane] += control_smoothed * control_smoothed
        result[CONTROL_FOURTH * LANES + lane] += square * square
        passed = slip(lock - result[TURNS * LANES + lane])
        result[TURNS * LANES + lane] += TURN * passed
        result[SLIPS * LANES + lane] += abs(passed)


@njit
def simulate_block(
    order,
    pair,
    copies,
    start_root,
    coefficients,
    readout,
    schedule,
    seed,
    first_path,
    state,
    result,
):
    """Simulate paths `first_path` to `first_path + LANES - 1`, from a stationary start."""
    start, stride, lag, samples = schedule
    n, m = len(order), len(pair)
    row_delayed = (5 + 2 * n) * LANES
    generator = np.empty(WORDS * LANES, np.uint32)
    gaussians = np.empty(CHUNK * m * LANES, np.float32)
    history = np.zeros((lag + 1, LANES), state.dtype)  # the phase at the last samples, a ring

    for i in range(state.size):
        state[i] = 0
    for i in range(result.size):
        result[i] = 0
    seed_lanes(seed, first_path, generator)
    fill_gaussians(generator, m // DRAWS, gaussians)
    for i in range(1 + n):
        for j in range(1 + n):
            for lane in range(LANES):
                row = i * LANES + lane
                state[row] = fma(start_root[i, j], gaussians[j * LANES + lane], state[row])

    sample, left = 0, start
    last = start + (lag + samples - 1) * stride
    for chunk in range(1 + last // CHUNK):
        fill_gaussians(generator, CHUNK * (m // DRAWS), gaussians)
        # The last sample is taken at the start of a step, which is then made for nothing.
        for step in range(min(CHUNK, 1 + last - chunk * CHUNK)):
            find_kick(order, pair, copies, coefficients, state)
            if left == 0:
                record, delayed = history[sample % (lag + 1)], history[(sample + 1) % (lag + 1)]
                for lane in range(LANES):
                    record[lane] = state[lane]
                    state[row_delayed + lane] = delayed[lane]
                if sample >= lag:
                    collect(order, pair, copies, coefficients, readout, state, result)
                sample += 1
                left = stride
            left -= 1
            draws_of_step = gaussians[step * m * LANES :]
            split_step(order, pair, copies, coefficients, draws_of_step, state)
    for i in range(SLIPS * LANES):
        result[i] /= samples


@kept(parallel=True, nogil=True)
def simulate_blocks(
    order,
    pair,
    copies,
    start_root,
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
    order, pair : tuples of n zeros of the type of `states`, and of m of float32
        Only their lengths count: the estimator's order, and the Gaussians that a step takes.
    copies : bool
        Whether the second sine is there.
    start_root : (1 + n, 1 + n) array
    coefficients : array
        `SplittingStep.coefficients`, in the precision of `states`.
    readout : (3 n,) array of float64
        Rows of the filtered estimate, the smoothed estimate and the oscillator's phase.
    schedule : tuple of 4 int
        A `Schedule`.
    seed : uint64
    first_block : int
        Block b holds the paths ``b * LANES`` to ``(b + 1) * LANES - 1``.
    states : (blocks, rows(n) * LANES) array of float32 or float64
        Work space; its type is the precision of the simulation.
    results : (blocks, OUTPUTS * LANES) array of float64
        Written.
    sources : str
        Not to be given.
    """
    for block in prange(results.shape[0]):
        simulate_block(
            order,
            pair,
            copies,
            start_root,
            coefficients,
            readout,
            schedule,
            seed,
            np.uint64(first_block + block) * np.uint64(LANES),
            states[block],
            results[block],
        )
