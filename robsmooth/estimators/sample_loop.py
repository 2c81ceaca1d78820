r"""The time-varying Kalman filter in discrete time, and the fixed-lag smoother of its innovations.

`docs/source/records.md` has the equations, with the letters of the code. In short,
:math:`x_{k+1} = \Phi x_k + d_k + w_k`, :math:`y_k = H x_k + h_k + v_k`, the innovation e has the
covariance :math:`\Sigma = LL'`, :math:`\Psi = \Phi - KH`, and the smoothed state is
:math:`\hat x_j + P_jr` with the covariance :math:`P_j - P_jNP_j`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robsmooth._support.kernels import kept
from robsmooth.estimators.copies import call

Floats = NDArray[np.float64]
NEVER = 2**62  # samples, more than any record has
_STEADY = 1e-15  # of the variances: a smaller change of the covariance counts as none
_KNOWN = 1e-6  # of the information on delta, in its own units: above this it is determined
_MOST = 1e10  # times a sample's noise: of a larger P, rounding would spoil smoothed estimates


class Samples(NamedTuple):
    """Samples of a record."""

    y: Floats  # (N, l), nan where it is missing
    reference: Floats  # (N, copies)
    inputs: Floats  # (N, p)
    intervals: Floats | None  # (N,) s; None: dt


class Sampled(NamedTuple):
    """Matrices for K lengths of samples: rows of the state at the end, then of the measurement."""

    interval: Floats  # (K,) s
    model: Floats  # (K, n + l, n + d) of state and drive, by the model that predicts
    # The drive: the copies' values at the beginning, their changes until the end, known inputs.
    gain: Floats  # (K, n + l, n) Phi and H, by the model that gives the gain
    noise: Floats  # (K, n + l, n + l) Q and S, S' and R, by the same


class Within(NamedTuple):
    """The same for the state at T times within samples."""

    model: Floats  # (T, n, n + d)
    gain: Floats  # (T, n, n) Phi_tau
    noise: Floats  # (T, n, n + n + l) covariances of w_tau with itself, w and v


class Memory(NamedTuple):
    """The samples within the longest lag, in a ring; its last row is of now."""

    states: Floats  # (ring + 1, n + d) the state before a sample, and its drive
    covariances: Floats  # (ring + 1, n, n) P
    closed: Floats  # (ring + 1, n, n + l) Psi and K; in the last row those of the sample before
    seen: Floats  # (ring + 1, l, n + l) inverse of L times H and I; zeros where y is missing
    innovations: Floats  # (ring + 1, l) normalised
    intervals: Floats  # (ring + 1,) s
    lost: NDArray[np.bool_]  # (ring + 1,) whether P is too large to smooth
    pattern: NDArray[np.bool_]  # (l,) which measurements the sample before had
    # samples taken; how many of the last had one covariance; after how many the state was known,
    # or `NEVER`; whether any had a length other than dt
    counts: NDArray[np.int64]
    unknown: Floats  # (n, u) V
    information: Floats  # (u, u) the inverse of delta's covariance
    score: Floats  # (u,) information times delta


def empty_memory(n: int, l: int, d: int, ring: int, unknown: Floats) -> Memory:  # noqa: E741
    """Return a memory without samples."""
    rows, u = ring + 1, unknown.shape[1]
    shapes = (n + d,), (n, n), (n, n + l), (l, n + l), (l,), ()  # of the rows of each ring
    rings = [np.zeros((rows, *shape)) for shape in shapes]
    lost, pattern = np.zeros(rows, dtype=bool), np.zeros(l, dtype=bool)
    counts = np.array([0, 0, NEVER if u else 0, 0])
    information, score = np.zeros((u, u)), np.zeros(u)
    return Memory(*rings, lost, pattern, counts, unknown.copy(), information, score)


class Reading(NamedTuple):
    """Which estimates are read after each sample. A single row of lags is for all samples."""

    readout: Floats  # (m, n)
    lags: NDArray[np.int64]  # (rows or 1, L) samples from the estimate to the end, ascending
    times: NDArray[np.int64]  # (rows or 1, L) index in `within`; -1: the beginning of the sample
    within: Within


@kept()
def _gains(gain, noise, P, present):
    """Return Psi and K, `seen`, the next P, and whether P is too large to smooth."""
    n, l = len(P), len(present)  # noqa: E741
    rows, white = np.flatnonzero(present), np.zeros((l, l))
    through = gain @ P @ np.ascontiguousarray(gain.T) + noise  # of the state and the measurement
    lost = (np.diag(through)[n:] > _MOST * np.diag(noise)[n:]).any()
    if len(rows):
        root = np.linalg.inv(np.linalg.cholesky(through[n:, n:][rows][:, rows]))
        for i in range(len(rows)):
            for j in range(i + 1):
                white[rows[i], rows[j]] = root[i, j]
    inverse = np.ascontiguousarray(white.T) @ white
    closing = np.eye(n, n + l)  # I and -K, of the state and the measurement
    closing[:, n:] = -np.ascontiguousarray(through[:n, n:]) @ inverse
    closed = np.hstack((closing @ gain, -closing[:, n:]))
    seen = np.hstack((white @ np.ascontiguousarray(gain[n:]), white))
    after = closed[:, :n].copy() @ P @ np.ascontiguousarray(closed[:, :n].T)
    after += closing @ noise @ np.ascontiguousarray(closing.T)
    return closed, seen, (after + after.T) / 2, lost


@kept()
def _add(result, matrix, vector):
    """Add the first rows and columns of a matrix, as many as needed, times a vector."""
    for i in range(len(result)):
        for j in range(len(vector)):
            result[i] += matrix[i, j] * vector[j]


@kept()
def _copies(functions, arguments, x, reference, k, values, first):
    """Write the copies' outputs at state x into `values`, from entry `first` on."""
    for i in range(len(functions)):
        argument = -reference[k, i]
        for j in range(arguments.shape[1]):
            argument += arguments[i, j] * x[j]
        of_copy = values[first + i : first + i + 1]
        of_copy[0] = argument
        call(functions[i], 0.0, of_copy, of_copy)


@kept()
def _predict(functions, arguments, model, state, inputs, reference, k, following):
    """Write the drive behind the state, and the predicted state and measurement."""
    n, g = arguments.shape[1], len(functions)
    for i in range(inputs.shape[1]):
        state[n + 2 * g + i] = inputs[k, i]
    for i in range(g):
        state[n + g + i] = 0.0
    if g:
        _copies(functions, arguments, state, reference, k, state, n)
        following[:] = 0.0
        _add(following, model, state)
        _copies(functions, arguments, following, reference, k, state, n + g)
        for i in range(g):
            state[n + g + i] -= state[n + i]
    following[:] = 0.0
    _add(following, model, state)


@kept()
def advance(functions, arguments, sampled, kinds, memory, reading, given, results, first, last):
    """Take some rows; write estimates, (rows, lags, m), their deviations, normalised innovations.

    Deviations and innovations without rows are not written. Return False before a sample that makes
    the state infinite: the memory is then as the sample before left it.
    """
    y, inputs, reference = given
    result, spread, normalised = results
    states, innovations, counts = memory.states, memory.innovations, memory.counts
    now, l, n = len(states) - 1, y.shape[1], arguments.shape[1]  # noqa: E741
    error, z, following = np.zeros(l), np.zeros(l), np.zeros(n + l)
    present, state, P = np.zeros(l, dtype=np.bool_), states[now], memory.covariances[now]
    closed, seen, after, lost = memory.closed[now], memory.seen[now], P, memory.lost[now]
    kind, model = 0, sampled.model[0]
    only_now = reading.lags.shape == (1, 1) and reading.lags[0, 0] == 0 and counts[2] == 0
    for k in range(first, last):
        if len(kinds):
            kind = kinds[k]
            model = sampled.model[kind]
        _predict(functions, arguments, model, state, inputs, reference, k, following)
        changed = counts[1] == 0 or sampled.interval[kind] != memory.intervals[now]
        for i in range(l):
            present[i] = not np.isnan(y[k, i])
            changed = changed or present[i] != memory.pattern[i]
            error[i] = y[k, i] - following[n + i] if present[i] else 0.0
        if changed:
            closed, seen, after, lost = _gains(sampled.gain[kind], sampled.noise[kind], P, present)
        finite = True
        for i in range(n):
            for j in range(l):
                following[i] += closed[i, n + j] * error[j]
            finite = finite and np.isfinite(following[i])
        if not finite or (changed and not np.isfinite(after).all()):
            return False
        for i in range(l):
            z[i] = 0.0
            for j in range(i + 1):
                z[i] += seen[i, n + j] * error[j]
        if now:
            slot, known_in_ring = counts[0] % now, counts[1] > now
            for i in range(len(state)):
                states[slot, i] = state[i]
            for i in range(l):
                innovations[slot, i] = z[i]
            if not known_in_ring:
                memory.covariances[slot] = P
            if changed or not known_in_ring:
                memory.closed[slot], memory.seen[slot], memory.lost[slot] = closed, seen, lost
                memory.intervals[slot] = sampled.interval[kind]
        if changed:
            memory.closed[now], memory.seen[now], memory.lost[now] = closed, seen, lost
            closed, seen = memory.closed[now], memory.seen[now]
            memory.pattern[:], memory.intervals[now] = present, sampled.interval[kind]
            counts[1] = 1
            for i in range(n):
                for j in range(n):
                    if not abs(after[i, j] - P[i, j]) <= _STEADY * np.sqrt(P[i, i] * P[j, j]):
                        counts[1] = 0
            P[:] = after
        else:
            counts[1] += 1
        for i in range(n):
            state[i] = following[i]
        counts[0] += 1
        if len(normalised):
            for i in range(l):
                normalised[k, i] = z[i] if present[i] else np.nan
        if counts[2] == NEVER:
            _determine(memory, z)
            normalised[k : k + 1] = np.nan
        if only_now:
            for i in range(len(reading.readout)):
                result[k, 0, i] = 0.0
                for j in range(n):
                    result[k, 0, i] += reading.readout[i, j] * state[j]
        else:
            read(memory, reading, k, result[k])
        if len(spread):
            if k == 0 or counts[1] <= now + 1 or len(reading.lags) > 1:
                spread_of(memory, reading, k, spread[k])
            else:
                spread[k] = spread[k - 1]
    return True


@kept()
def hold(sizes, model, y, state, readout, result):
    """Do as `advance` where only y drives the state; faster, for the sizes are compiled in.

    A state that is not finite is not kept.
    """
    n, measurements, outputs = len(sizes[0]), len(sizes[1]), len(sizes[2])
    x = np.zeros((2, n))  # now, and at the end of the sample
    # NumPy's assignment takes 2 s to compile, with the texts of its errors
    for i in range(n):
        x[0, i] = state[i]
    for k in range(len(y)):
        for i in range(n):
            x[1, i] = 0.0
        for j in range(n):
            for i in range(n):
                x[1, i] += model[j, i] * x[0, j]
        for j in range(measurements):
            for i in range(n):
                x[1, i] += model[n + j, i] * y[k, j]
        for i in range(n):
            x[0, i] = x[1, i]
        for i in range(outputs):
            result[k, 0, i] = 0.0
            for j in range(n):
                result[k, 0, i] += readout[i, j] * x[0, j]
    finite = np.isfinite(x[0]).all()
    for i in range(n):
        state[i] = x[0, i] if finite else state[i]
    return finite


@kept()
def step(
    functions, arguments, interval, model,
    states, covariances, closed, seen, innovations, intervals, lost, pattern, counts,
    readout, lags, times, within_model, within_gain, within_noise,
    y, inputs, reference, result,
):  # fmt: skip
    """Take a sample without gaps, with the gain of the one before; return False for any other."""
    # The arrays are separate arguments because numba unpacks a tuple slowly.
    usual = counts[1] > 0 and counts[2] != NEVER and not counts[3] and interval[0] == intervals[-1]
    for i in range(len(pattern)):
        usual = usual and pattern[i] and np.isfinite(y[0, i])
    if not usual:
        return False
    now = covariances[-1]
    sampled = Sampled(interval, model, covariances, covariances)  # the gain is known
    rings = states, covariances, closed, seen, innovations, intervals, lost
    memory = Memory(*rings, pattern, counts, now, now, states[-1])
    reading = Reading(readout, lags, times, Within(within_model, within_gain, within_noise))
    given, results = (y, inputs, reference), (result, result[:0], y[:0])
    kinds, rows = np.empty(0, dtype=np.int64), (np.int64(0), np.int64(1))  # typed as elsewhere
    return advance(functions, arguments, sampled, kinds, memory, reading, given, results, *rows)


@kept()
def _determine(memory, z):
    """Add a sample's information on delta; once delta is determined, add it to the estimate."""
    n = len(memory.unknown)
    seen = np.ascontiguousarray(memory.seen[-1][:, :n]) @ memory.unknown
    memory.information[:] += seen.T @ seen
    _add(memory.score, seen.T, z)
    memory.unknown[:] = np.ascontiguousarray(memory.closed[-1][:, :n]) @ memory.unknown
    if np.linalg.eigvalsh(memory.information)[0] > _KNOWN:
        inverse = np.linalg.inv(memory.information)
        _add(memory.states[-1][:n], memory.unknown @ inverse, memory.score)
        memory.covariances[-1][:] += memory.unknown @ inverse @ memory.unknown.T
        memory.counts[1], memory.counts[2] = 0, memory.counts[0]


@kept()
def read(memory, reading, row, result):
    """Write the estimates at the lags of a row."""
    samples, ring, n = memory.counts[0], len(memory.states) - 1, reading.readout.shape[1]
    row, l = min(row, len(reading.lags) - 1), memory.innovations.shape[1]  # noqa: E741
    known, done, slot = samples - memory.counts[2], 0, samples % max(ring, 1)
    r, later, part, x = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    closed, seen, innovations = memory.closed, memory.seen, memory.innovations
    for at in range(reading.lags.shape[1]):
        lag, time = reading.lags[row, at], reading.times[row, at]
        if lag > known:
            result[at] = np.nan
            continue
        for _ in range(done, lag):
            slot = (slot if slot else ring) - 1
            for i in range(n):
                later[i], r[i] = r[i], 0.0
            for j in range(n):
                for i in range(n):
                    r[i] += closed[slot, j, i] * later[j]
            for j in range(l):
                for i in range(n):
                    r[i] += seen[slot, j, i] * innovations[slot, j]
        done = lag
        part[:] = 0.0
        if lag:
            _add(part, memory.covariances[slot], r)
        before = memory.states[slot if lag else ring]
        if time < 0:
            x[:] = before[:n] + part
        else:
            with_noise = np.zeros(n + l)
            _add(with_noise, seen[slot].T, innovations[slot])
            _add(with_noise, closed[slot].T, -later)
            with_noise = np.concatenate((np.zeros(n), later, with_noise[n:]))
            x[:] = 0.0
            _add(x, reading.within.model[time], before)
            _add(x, reading.within.gain[time], part)
            _add(x, reading.within.noise[time], with_noise)
        result[at] = np.nan if lag and memory.lost[slot] else 0.0
        _add(result[at], reading.readout, x)


@kept()
def spread_of(memory, reading, row, result):
    """Write the standard deviations of the errors of these estimates."""
    samples, ring, n = memory.counts[0], len(memory.states) - 1, reading.readout.shape[1]
    row = min(row, len(reading.lags) - 1)
    known, done, slot = samples - memory.counts[2], 0, samples % max(ring, 1)
    N = later = np.zeros((n, n))
    for at in range(reading.lags.shape[1]):
        lag, time = reading.lags[row, at], reading.times[row, at]
        if lag > known:
            result[at] = np.nan
            continue
        for _ in range(done, lag):
            slot, later = (slot if slot else ring) - 1, N
            closed = np.ascontiguousarray(memory.closed[slot][:, :n])
            seen = np.ascontiguousarray(memory.seen[slot][:, :n])
            N = np.ascontiguousarray(closed.T) @ later @ closed
            N += np.ascontiguousarray(seen.T) @ seen
        done = lag
        P = memory.covariances[slot if lag else ring]
        covariance = P - P @ N @ P if lag else P.copy()
        if time >= 0:
            gain, noise = reading.within.gain[time], reading.within.noise[time]
            through = np.hstack((gain @ P, noise[:, 2 * n :]))
            onto = through @ np.ascontiguousarray(memory.seen[slot].T)
            through[:, n:] *= -1.0
            into = through @ np.ascontiguousarray(memory.closed[slot].T) + noise[:, n : 2 * n]
            covariance = gain @ P @ np.ascontiguousarray(gain.T) + noise[:, :n]
            covariance -= into @ later @ np.ascontiguousarray(into.T)
            covariance -= onto @ np.ascontiguousarray(onto.T)
        for i in range(len(reading.readout)):
            variance = max(reading.readout[i] @ covariance @ reading.readout[i], 0.0)
            result[at, i] = np.nan if lag and memory.lost[slot] else np.sqrt(variance)
