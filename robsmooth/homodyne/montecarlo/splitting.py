r"""The compiled loop of the ergodic protocol: a second-order scheme with a linear control.

The statistically linearised loop is :math:`dz = Az\,dt + dn` for :math:`z = (\varphi, \hat x)`. Its
step over a time h is exact,

.. math::

    L_h: z \leftarrow \Phi z + \eta,\qquad \Phi = e^{Ah},\quad
    \operatorname{cov}\eta = \int_0^h e^{As}Qe^{A's}\,ds,

and the sines less their slopes are a kick,

.. math::

    K_h: \hat x \leftarrow \hat x + h F + \tfrac12 h^2 DF\,F,\qquad
    F = b_s(\sin e - \rho_s e) + b_c(\sin v - \rho_c v),

with :math:`e = \varphi - r\hat x` and :math:`v = c\hat x`. Strang's composition
:math:`K_{h/2}L_hK_{h/2}` is of second order in h, and exact where the loop is linear. Steps are
taken as :math:`L_hK_h`; a sample is read after a further :math:`K_{h/2}`, which is not kept.

A path that has slipped is linearised about the point where it is locked now: with T the multiple of
:math:`2\pi` nearest to e, the kick has :math:`\rho_s(e - T)` for :math:`\rho_s e`, and the exact
step adds :math:`-\rho_sT\int_0^h e^{As}\,ds\,b_s`.

The control variate is the linear loop :math:`y \leftarrow \Phi y + \eta` with the same noise, from
its stationary law: its moments are known. The state of a block is :math:`\varphi`, the estimator's
part of y, and :math:`d = \hat x - y`, which starts at zero and has no noise of its own.
"""

from collections import namedtuple

import numpy as np
from numba import njit, prange
from numba.cpython.unsafe.tuple import tuple_setitem
from numba.extending import register_jitable

from robsmooth._numerics.lyapunov import noise_root, square_root
from robsmooth._numerics.steps import responses
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.kernels import kept
from robsmooth.homodyne.loop import Loop
from robsmooth.simulation import noise
from robsmooth.simulation.noise import BLOCK, DRAWS, SOURCES, TURN, WORDS, fma, sine, slip

CHUNK = 8  # steps for which noise is drawn ahead
# Of a path: time averages of the loop and of its control, cycle slips, turns away.
FILTERED, SMOOTHED, CONTROL_FILTERED, CONTROL_SMOOTHED, CONTROL_FOURTH, SLIPS, TURNS = range(7)
OUTPUTS = TURNS + 1
ERRORS, CONTROLS = slice(FILTERED, CONTROL_FILTERED), slice(CONTROL_FILTERED, SLIPS)

# Of a step with m Gaussians; in a kernel, where each begins in the flat array of all.
Coefficients = namedtuple(
    "Coefficients",
    "transition root sine_gain copy_gain reference copy sine_response copy_response push "
    "slopes curvatures quarter_turn start",
)
# Where the rows of BLOCK numbers begin in a block's state. Control and difference, y and d, have n.
# The kick has terms of first and second order along h b_s and h b_c; turns are T.
Rows = namedtuple(
    "Rows",
    "phase control difference sine_first sine_second copy_first copy_second delayed turns end",
)


@register_jitable
def indices(n, m):
    """Return where the coefficients begin; in a kernel these are constants."""
    root = (1 + n) * (1 + n)
    v = root + (1 + n) * m  # where the vectors begin
    s = v + 7 * n  # and the scalars
    vectors = (v, v + n, v + 2 * n, v + 3 * n, v + 4 * n, v + 5 * n, v + 6 * n)
    return Coefficients(0, root, *vectors, s, s + 2, s + 6, s + 7)


@register_jitable
def rows_of(n):
    """Return where the rows begin; in a kernel these are constants."""
    b, kick = BLOCK, (1 + 2 * n) * BLOCK
    last = (kick + 3 * b, kick + 4 * b, kick + 5 * b, kick + 6 * b)
    return Rows(0, b, (1 + n) * b, kick, kick + b, kick + 2 * b, *last)


def coefficients_of(loop: Loop, step: float, slopes: tuple[float, float]) -> Coefficients:
    """Return the coefficients of a step, in s; the slopes are those of the control."""
    drift = loop.linearised_drift(*slopes)
    transition, push, _ = responses(drift, -slopes[0] * loop.gains[:, :1], step)
    triangle = noise_root(drift, loop.noise, step)
    root = square_root(triangle @ triangle.T)  # the triangle would give other paths for a seed
    root = np.pad(root, ((0, 0), (0, -len(root) % DRAWS)))  # Gaussians come in pairs
    gains, arguments = step * loop.gains[1:].T, loop.arguments[:, 1:] * [[-1], [1]]
    return Coefficients(
        transition,  # (1 + n, 1 + n), Phi
        root,  # (1 + n, m), of the covariance of eta
        *gains,  # (n,) each, h b_s and h b_c
        *arguments,  # (n,) each, r and c
        *(gains @ transition[1:, 1:].T),  # (n,) each, the gains after the transition
        push[1:],  # (n,), of the exact step by T
        slopes,  # rho_s, rho_c
        arguments @ gains.T,  # r h b_s, r h b_c, c h b_s, c h b_c
        quarter_turn=np.pi / 2,
        start=square_root(loop.covariance(*slopes)),  # the control is stationary
    )


def control_slopes(loop: Loop) -> tuple[float, float]:
    """Return the equivalent slopes, or one: the means of the control are exact for any slopes."""
    try:
        return loop.equivalent_slopes()
    except UnstableLoopError:
        return 1.0, 1.0


@njit
def find_kick(pair, copy, order, coefficients, state):
    """Write the kick's terms of first and of second order along h b_s, and along h b_c."""
    n = len(order)
    row, at = rows_of(n), indices(n, len(pair))
    sine_slope, copy_slope = coefficients[at.slopes], coefficients[at.slopes + 1]
    r_s, r_c = coefficients[at.curvatures], coefficients[at.curvatures + 1]
    c_s, c_c = coefficients[at.curvatures + 2], coefficients[at.curvatures + 3]
    quarter_turn = coefficients[at.quarter_turn]
    for path in range(BLOCK):
        e = state[row.phase + path]
        v = e - e
        for j in range(n):
            k = j * BLOCK + path
            x = state[row.control + k] + state[row.difference + k]
            e = fma(-coefficients[at.reference + j], x, e)
            if len(copy) > 0:
                v = fma(coefficients[at.copy + j], x, v)
        # Half of the kick ends a step, with its T; half starts the next, with a new T.
        turns = noise.whole_turns(e)
        s = fma(-sine_slope, fma(turns + state[row.turns + path], -0.5, e), sine(e))
        state[row.turns + path] = turns
        state[row.sine_first + path] = s
        bend = sine_slope - sine(e + quarter_turn)
        if len(copy) > 0:
            q = fma(-copy_slope, v, sine(v))
            state[row.copy_first + path] = q
            state[row.sine_second + path] = bend * fma(r_s, s, r_c * q)
            bend = sine(v + quarter_turn) - copy_slope
            state[row.copy_second + path] = bend * fma(c_s, s, c_c * q)
        else:
            state[row.sine_second + path] = bend * (r_s * s)


@njit
def split_step(pair, copy, order, coefficients, gaussians, state):
    """Advance a block by the kick of `find_kick` and the exact step."""
    n, m = len(order), len(pair)
    row, at = rows_of(n), indices(n, m)
    for path in range(BLOCK):
        phase = state[row.phase + path]
        kick_s = fma(state[row.sine_second + path], 0.5, state[row.sine_first + path])
        kick_c = fma(state[row.copy_second + path], 0.5, state[row.copy_first + path])
        y = d = order
        g = pair
        for j in range(n):
            y = tuple_setitem(y, j, state[row.control + j * BLOCK + path])
            d = tuple_setitem(d, j, state[row.difference + j * BLOCK + path])
        for j in range(m):
            g = tuple_setitem(g, j, gaussians[j * BLOCK + path])
        for i in range(n):
            of_state, of_noise = at.transition + (1 + i) * (1 + n), at.root + (1 + i) * m
            of_y = coefficients[of_state] * phase
            of_d = coefficients[at.push + i] * state[row.turns + path]
            of_d = fma(coefficients[at.sine_response + i], kick_s, of_d)
            if len(copy) > 0:
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
def collect(pair, copy, order, coefficients, readout, state, result):
    """Add the errors of a block and of its control after half a kick; count cycle slips."""
    n = len(order)
    row, at = rows_of(n), indices(n, len(pair))
    for path in range(BLOCK):
        kick_s = 0.5 * state[row.sine_first + path] + 0.125 * state[row.sine_second + path]
        kick_c = 0.5 * state[row.copy_first + path] + 0.125 * state[row.copy_second + path]
        control_filtered = np.float64(state[row.phase + path])
        control_smoothed = np.float64(state[row.delayed + path])
        lock = control_filtered
        filtered = smoothed = lock - lock
        for j in range(n):
            y = np.float64(state[row.control + j * BLOCK + path])
            d = np.float64(state[row.difference + j * BLOCK + path])
            d = fma(kick_s, coefficients[at.sine_gain + j], d)
            if len(copy) > 0:
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
def simulate_block(pair, copy, order, coefficients, readout, schedule, seed, first_path, result):
    """Simulate paths `first_path` to `first_path + BLOCK - 1`, from a stationary start."""
    warm_up, delay, steps = schedule
    n, m = len(order), len(pair)
    row, at = rows_of(n), indices(n, m)
    generator = np.empty(WORDS * BLOCK, np.uint32)
    gaussians = np.empty(CHUNK * m * BLOCK, np.float32)
    state = np.zeros(row.end, coefficients.dtype)
    history = np.zeros((delay + 1, BLOCK), state.dtype)  # the phase at the last steps, a ring
    result[:] = 0
    noise.seed_paths(seed, first_path, generator)
    noise.fill_gaussians(generator, m // DRAWS, gaussians)
    for i in range(1 + n):
        for j in range(1 + n):
            for path in range(BLOCK):
                k = i * BLOCK + path
                root = coefficients[at.start + i * (1 + n) + j]
                state[k] = fma(root, gaussians[j * BLOCK + path], state[k])

    last = warm_up + steps
    for chunk in range(1 + last // CHUNK):
        noise.fill_gaussians(generator, CHUNK * (m // DRAWS), gaussians)
        # The last sample is at the start of a step, whose end is not used.
        for step in range(min(CHUNK, 1 + last - chunk * CHUNK)):
            find_kick(pair, copy, order, coefficients, state)
            now = chunk * CHUNK + step
            record, delayed = history[now % (delay + 1)], history[(now + 1) % (delay + 1)]
            record[:] = state[row.phase : row.phase + BLOCK]
            state[row.delayed : row.delayed + BLOCK] = delayed
            if now >= warm_up:
                collect(pair, copy, order, coefficients, readout, state, result)
            draws_of_step = gaussians[step * m * BLOCK :]
            split_step(pair, copy, order, coefficients, draws_of_step, state)
    result[: SLIPS * BLOCK] /= steps + 1


@kept(parallel=True, nogil=True)
def simulate_blocks(
    pair, copy, order, coefficients, readout, schedule, seed, first, results, code=SOURCES
):
    """Simulate consecutive blocks, as `euler.simulate_blocks` does.

    The schedule has the steps of the warm-up, of the delay, at most as many, and those whose ends
    are sampled. The lengths of `pair` and `copy` are the numbers of Gaussians of a step, and of
    sines besides the first, one or none.
    """
    for block in prange(results.shape[0]):
        path = np.uint64(first + block) * np.uint64(BLOCK)
        simulate_block(
            pair, copy, order, coefficients, readout, schedule, seed, path, results[block]
        )
