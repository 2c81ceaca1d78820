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
from robsmooth.homodyne.montecarlo.kernels import TURN, shared_sources, slip
from robsmooth.homodyne.montecarlo.layout import splitting_indices, splitting_rows
from robsmooth.homodyne.montecarlo.noise import (
    BLOCK,
    DRAWS,
    WORDS,
    fill_gaussians,
    fma,
    seed_paths,
    sine,
    whole_turns,
    with_item,
)

CHUNK = 8  # steps for which noise is drawn ahead
OUTPUTS = 7  # of a path: time averages of the loop and of its control, cycle slips, turns away
FILTERED, SMOOTHED, CONTROL_FILTERED, CONTROL_SMOOTHED, CONTROL_FOURTH, SLIPS, TURNS = range(
    OUTPUTS
)
ERRORS, CONTROLS = slice(FILTERED, CONTROL_FILTERED), slice(CONTROL_FILTERED, SLIPS)
SOURCES = shared_sources()


@njit
def find_kick(pair, copies, order, coefficients, state):
    """Write the kick's terms of first and of second order along h b_s, and along h b_c."""
    n = len(order)
    row, at = splitting_rows(n), splitting_indices(n, len(pair))
    sine_slope, copy_slope = coefficients[at.sine_slope], coefficients[at.copy_slope]
    r_s, r_c = coefficients[at.reference_of_sine], coefficients[at.reference_of_copy]
    c_s, c_c = coefficients[at.copy_of_sine], coefficients[at.copy_of_copy]
    quarter_turn = coefficients[at.quarter_turn]
    if copies:
        for path in range(BLOCK):
            e = state[row.phase + path]
            v = e - e
            for j in range(n):
                k = j * BLOCK + path
                x = state[row.control + k] + state[row.difference + k]
                e = fma(-coefficients[at.reference + j], x, e)
                v = fma(coefficients[at.copy + j], x, v)
            # Half of the kick ends a step, with that T; half starts the next, with a new one.
            turns = whole_turns(e)
            s = fma(-sine_slope, fma(turns + state[row.turns + path], -0.5, e), sine(e))
            state[row.turns + path] = turns
            q = fma(-copy_slope, v, sine(v))
            state[row.sine_first + path] = s
            state[row.copy_first + path] = q
            bend = sine_slope - sine(e + quarter_turn)
            state[row.sine_second + path] = bend * fma(r_s, s, r_c * q)
            bend = sine(v + quarter_turn) - copy_slope
            state[row.copy_second + path] = bend * fma(c_s, s, c_c * q)
    else:  # the same without q
        for path in range(BLOCK):
            e = state[row.phase + path]
            for j in range(n):
                k = j * BLOCK + path
                x = state[row.control + k] + state[row.difference + k]
                e = fma(-coefficients[at.reference + j], x, e)
            turns = whole_turns(e)
            s = fma(-sine_slope, fma(turns + state[row.turns + path], -0.5, e), sine(e))
            state[row.turns + path] = turns
            state[row.sine_first + path] = s
            state[row.sine_second + path] = (sine_slope - sine(e + quarter_turn)) * (r_s * s)


@njit
def split_step(pair, copies, order, coefficients, gaussians, state):
    """Advance a block by the kick that was found, and by the exact step after it."""
    n, m = len(order), len(pair)
    row, at = splitting_rows(n), splitting_indices(n, m)
    for path in range(BLOCK):
        phase = state[row.phase + path]
        kick_s = fma(state[row.sine_second + path], 0.5, state[row.sine_first + path])
        kick_c = fma(state[row.copy_second + path], 0.5, state[row.copy_first + path])
        y = d = order
        g = pair
        for j in range(n):
            y = with_item(y, j, state[row.control + j * BLOCK + path])
            d = with_item(d, j, state[row.difference + j * BLOCK + path])
        for j in range(m):
            g = with_item(g, j, gaussians[j * BLOCK + path])
        for i in range(n):
            of_state, of_noise = at.transition + (1 + i) * (1 + n), at.root + (1 + i) * m
            of_y = coefficients[of_state] * phase
            of_d = coefficients[at.push + i] * state[row.turns + path]
            of_d = fma(coefficients[at.sine_response + i], kick_s, of_d)
            if copies:
                of_d = fma(coefficients[at.copy_response + i], kick_c, of_d)
            for j in range(m):
                of_y = fma(coefficients[of_noise + j], g[j], of_y)
            for j in range(n):
                of_y = fma(coefficients[of_state + 1 + j], y[j], of_y)
                of_d = fma(coefficients[of_state + 1 + j], d[j], of_d)
            state[row.control + i * BLOCK + path] = of_y
            state[row.difference + i * BLOCK + path] = of_d
        phase = coefficients[at.transition] * phase
        for j in range(m):
            phase = fma(coefficients[at.root + j], g[j], phase)
        state[row.phase + path] = phase


@njit
def collect(pair, copies, order, coefficients, readout, state, result):
    """Add the errors of a block and of its control after half a kick; note cycle slips.

    The filtered error is taken against the phase, the smoothed one against the phase a delay ago.
    """
    n = len(order)
    row, at = splitting_rows(n), splitting_indices(n, len(pair))
    for path in range(BLOCK):
        kick_s = 0.5 * state[row.sine_first + path] + 0.125 * state[row.sine_second + path]
        kick_c = 0.5 * state[row.copy_first + path] + 0.125 * state[row.copy_second + path]
        control_filtered = np.float64(state[row.phase + path])
        control_smoothed = np.float64(state[row.delayed + path])
        lock = control_filtered
        filtered = smoothed = lock - lock
        for j in range(n):
            y = np.float64(state[row.control + j * BLOCK + path])
            d = fma(
                kick_s,
                coefficients[at.sine_gain + j],
                np.float64(state[row.difference + j * BLOCK + path]),
            )
            if copies:
                d = fma(kick_c, coefficients[at.copy_gain + j], d)
            control_filtered = fma(-readout[j], y, control_filtered)
            control_smoothed = fma(-readout[n + j], y, control_smoothed)
            filtered = fma(-readout[j], d, filtered)
            smoothed = fma(-readout[n + j], d, smoothed)
            lock = fma(-readout[2 * n + j], y + d, lock)
        filtered += control_filtered
        smoothed += control_smoothed
        square = control_filtered * control_filtered
        result[FILTERED * BLOCK + path] += filtered * filtered
        result[SMOOTHED * BLOCK + path] += smoothed * smoothed
        result[CONTROL_FILTERED * BLOCK + path] += square
        result[CONTROL_SMOOTHED * BLOCK + path] += control_smoothed * control_smoothed
        result[CONTROL_FOURTH * BLOCK + path] += square * square
        passed = slip(lock - result[TURNS * BLOCK + path])
        result[TURNS * BLOCK + path] += TURN * passed
        result[SLIPS * BLOCK + path] += abs(passed)


@njit
def simulate_block(
    pair, copies, order, coefficients, readout, schedule, seed, first_path, state, result
):
    """Simulate paths `first_path` to `first_path + BLOCK - 1`, from a stationary start."""
    start, stride, lag, samples = schedule
    n, m = len(order), len(pair)
    row, at = splitting_rows(n), splitting_indices(n, m)
    generator = np.empty(WORDS * BLOCK, np.uint32)
    gaussians = np.empty(CHUNK * m * BLOCK, np.float32)
    history = np.zeros((lag + 1, BLOCK), state.dtype)  # the phase at the last samples, a ring

    state[:] = 0
    result[:] = 0
    seed_paths(seed, first_path, generator)
    fill_gaussians(generator, m // DRAWS, gaussians)
    for i in range(1 + n):
        for j in range(1 + n):
            for path in range(BLOCK):
                k = i * BLOCK + path
                root = coefficients[at.start + i * (1 + n) + j]
                state[k] = fma(root, gaussians[j * BLOCK + path], state[k])

    sample, left = 0, start
    last = start + (lag + samples - 1) * stride
    for chunk in range(1 + last // CHUNK):
        fill_gaussians(generator, CHUNK * (m // DRAWS), gaussians)
        # The last sample is taken at the start of a step, which is then made for nothing.
        for step in range(min(CHUNK, 1 + last - chunk * CHUNK)):
            find_kick(pair, copies, order, coefficients, state)
            if left == 0:
                record, delayed = history[sample % (lag + 1)], history[(sample + 1) % (lag + 1)]
                for path in range(BLOCK):
                    record[path] = state[row.phase + path]
                    state[row.delayed + path] = delayed[path]
                if sample >= lag:
                    collect(pair, copies, order, coefficients, readout, state, result)
                sample += 1
                left = stride
            left -= 1
            draws_of_step = gaussians[step * m * BLOCK :]
            split_step(pair, copies, order, coefficients, draws_of_step, state)
    for i in range(SLIPS * BLOCK):
        result[i] /= samples


def state_size(n: int) -> int:
    """Return the size of the state of a block."""
    return splitting_rows(n).end


@kept(parallel=True, nogil=True)
def simulate_blocks(
    pair, copies, order, coefficients, readout, schedule, seed, first, states, results, code=SOURCES
):
    """Simulate consecutive blocks, as `euler.simulate_blocks` does, with a `Schedule`.

    Of `pair`, only the length counts: the Gaussians of a step. Without `copies`, there is no second
    sine.
    """
    for block in prange(results.shape[0]):
        path = np.uint64(first + block) * np.uint64(BLOCK)
        state, result = states[block], results[block]
        simulate_block(
            pair, copies, order, coefficients, readout, schedule, seed, path, state, result
        )
