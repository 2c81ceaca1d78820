r"""The time-varying Kalman filter in discrete time, and fixed-lag smoothing of its innovations.

With the state :math:`x_k` at the beginning of sample k, a sample and its noises

.. math::

    x_{k+1} = \Phi x_k + d_k + w_k, \qquad y_k = H x_k + h_k + v_k, \qquad
    \operatorname{cov}\begin{bmatrix}w\\v\end{bmatrix} = \begin{bmatrix}Q & S\\ S' & R\end{bmatrix},

the innovation :math:`e_k = y_k - h_k - H\hat x_k` of covariance :math:`\Sigma = HPH' + R` gives

.. math::

    \hat x_{k+1} = \Phi\hat x_k + d_k + Ke_k, \qquad K = (\Phi PH' + S)\Sigma^{-1}, \qquad
    \Psi = \Phi - KH .

Known at the end of sample k, the state d samples before is :math:`\hat x_j + P_jr` and has the
covariance :math:`P_j - P_jNP_j`, where the innovations since then are gathered backward from
:math:`r = 0,\ N = 0` (P. de Jong, "Smoothing and interpolation with the state-space model",
J. Am. Stat. Assoc. 84(408), 1989):

.. math::

    r \leftarrow H'\Sigma^{-1}e_i + \Psi_i'r, \qquad N \leftarrow H'\Sigma^{-1}H + \Psi_i'N\Psi_i .

Rows of a missing measurement are left out of H. What a copy gives, :math:`\mu =
\psi(C_\nu\hat x - r)`, is taken at the beginning of a sample and, predicted, at its end, and held
to be linear in time.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_STEADY = 1e-15  # of the variances: a covariance that changes by less stays as it is


class Sampled(NamedTuple):
    """The system in discrete time: the model that is run, and that of the gain."""

    transition: Floats  # (N, N) of the model
    measurement: Floats  # (l, N)
    copies: Floats  # (2, N, g) what a copy's first value does to the state, and its change
    of_copies: Floats  # (2, l, g) and to the measurement
    arguments: Floats  # (g, N) C_nu
    Phi: Floats  # (N, N) ...
    H: Floats  # (l, N) ...
    Q: Floats  # (N, N) ...
    S: Floats  # (N, l) ...
    R: Floats  # (l, l) ... of the gain's


class Memory(NamedTuple):
    """What is kept between samples: the state, and a ring of those in the longest lag."""

    x: Floats  # (N,)
    P: Floats  # (N, N)
    gain: Floats  # (N, l), of the sample before
    weighted: Floats  # (N, l) H' times the inverse of its innovation's covariance
    closed: Floats  # (N, N)
    pattern: NDArray[np.bool_]  # (l,) which of its measurements were there
    # samples taken, how many of the last had one covariance, whether the deviations are known, when
    # the parts of r were last divided, and last brought up to date
    counts: NDArray[np.int64]
    states: Floats  # (ring, N)
    covariances: Floats  # (ring, N, N)
    errors: Floats  # (ring, N) H' inverse e
    informations: Floats  # (ring, N, N) H' inverse H
    transitions: Floats  # (ring, N, N)
    deviations: Floats  # (lags, m), as long as nothing changes
    # r of the longest lag in two parts: from each sample to the last of a time, and since that
    sums: Floats  # (ring, N)
    maps: Floats  # (ring, N, N) what the second part is multiplied by
    since: Floats  # (N,)
    since_map: Floats  # (N, N)


@njit
def _gains(sampled, P, present):
    """Return gain, H' times the inverse of the innovation's covariance, Psi and the next P."""
    H, l = sampled.H, len(sampled.H)  # noqa: E741
    rows = np.flatnonzero(present)
    inverse = np.zeros((l, l))
    if len(rows):
        covariance = H @ np.ascontiguousarray(P @ H.T) + sampled.R
        some = np.empty((len(rows), len(rows)))
        for i in range(len(rows)):
            for j in range(len(rows)):
                some[i, j] = covariance[rows[i], rows[j]]
        found = np.linalg.inv(some)
        for i in range(len(rows)):
            for j in range(len(rows)):
                inverse[rows[i], rows[j]] = found[i, j]
    gain = (sampled.Phi @ np.ascontiguousarray(P @ H.T) + sampled.S) @ inverse
    closed = sampled.Phi - gain @ H
    cross = sampled.S @ np.ascontiguousarray(gain.T)
    following = closed @ P @ np.ascontiguousarray(closed.T) + sampled.Q - cross - cross.T
    following += gain @ sampled.R @ np.ascontiguousarray(gain.T)
    return gain, np.ascontiguousarray(H.T) @ inverse, closed, (following + following.T) / 2


@njit
def _same(P, following):
    for i in range(len(P)):
        for j in range(len(P)):
            if abs(following[i, j] - P[i, j]) > _STEADY * np.sqrt(P[i, i] * P[j, j]):
                return False
    return True


@njit
def _add(result, matrix, vector, sign):
    for i in range(len(result)):
        for j in range(len(vector)):
            result[i] += sign * matrix[i, j] * vector[j]


@njit
def advance(copies, sampled, memory, readout, lags, y, known, drive, reference, result, spread):
    """Take samples; write the estimates, (rows, lags, m), and where `spread` has rows, deviations.

    Row k of `known` is taken off the measurement, `drive` goes to the state, NaN is missing.
    """
    g, l, n, ring = len(sampled.arguments), y.shape[1], len(memory.x), len(memory.states)  # noqa: E741
    mu, change, arguments = np.zeros(g), np.zeros(g), np.zeros(g)
    error, following, present = np.zeros(l), np.zeros(n), np.zeros(l, dtype=np.bool_)
    for k in range(len(y)):
        x = memory.x
        following[:] = drive[k]
        _add(following, sampled.transition, x, 1.0)
        error[:] = y[k]
        error -= known[k]
        _add(error, sampled.measurement, x, -1.0)
        if copies is not None:
            arguments[:] = -reference[k]
            _add(arguments, sampled.arguments, x, 1.0)
            copies(arguments, mu)
            _add(following, sampled.copies[0], mu, 1.0)
            arguments[:] = -reference[k]
            _add(arguments, sampled.arguments, following, 1.0)
            copies(arguments, change)
            change -= mu
            _add(following, sampled.copies[1], change, 1.0)
            _add(error, sampled.of_copies[0], mu, -1.0)
            _add(error, sampled.of_copies[1], change, -1.0)
        changed = memory.counts[1] == 0
        for i in range(l):
            present[i] = not np.isnan(y[k, i])
            changed = changed or present[i] != memory.pattern[i]
            if not present[i]:
                error[i] = 0.0
        slot = memory.counts[0] % max(ring, 1)
        if ring:
            memory.states[slot], memory.covariances[slot] = x, memory.P
        if changed:
            gain, weighted, closed, after = _gains(sampled, memory.P, present)
            memory.gain[:], memory.weighted[:], memory.closed[:] = gain, weighted, closed
            memory.pattern[:] = present
            memory.counts[1] = 1 if _same(memory.P, after) else 0
            memory.P[:] = after
        else:
            memory.counts[1] += 1
        _add(following, memory.gain, error, 1.0)
        memory.x[:] = following
        if ring:
            memory.transitions[slot], memory.errors[slot] = memory.closed, 0.0
            _add(memory.errors[slot], memory.weighted, error, 1.0)
            if len(spread):
                memory.informations[slot] = memory.weighted @ sampled.H
        memory.counts[0] += 1
        if len(lags) == 1 and lags[0] == ring and 0 < ring <= memory.counts[0]:
            read_longest(memory, readout, result[k, 0])
        else:
            read(memory, readout, lags, result[k])
        if len(spread):
            if memory.counts[1] <= ring + 1 or memory.counts[2] == 0:
                _spread(memory, readout, lags, memory.deviations)
            spread[k] = memory.deviations
        memory.counts[2] = len(spread) > 0


@njit
def read_longest(memory, readout, result):
    """Write the estimate at the longest lag; the work does not grow with the lag.

    The innovations' sum is that of two parts: the second grows with each sample, and becomes part
    of the first when that is used up.
    """
    samples, ring, n = memory.counts[0], len(memory.states), len(memory.x)
    oldest, newest = samples % ring, (samples - 1) % ring
    if memory.counts[4] != samples - 1 or memory.counts[3] <= samples - ring:
        memory.sums[newest], memory.maps[newest] = (
            memory.errors[newest],
            memory.transitions[newest].T,
        )
        for d in range(2, ring + 1):
            slot, after = (samples - d) % ring, (samples - d + 1) % ring
            memory.sums[slot], memory.maps[slot] = memory.errors[slot], 0.0
            for i in range(n):
                for j in range(n):
                    moved = memory.transitions[slot, j, i]
                    memory.sums[slot, i] += moved * memory.sums[after, j]
                    for c in range(n):
                        memory.maps[slot, i, c] += moved * memory.maps[after, j, c]
        memory.since[:], memory.since_map[:], memory.counts[3] = 0.0, np.eye(n), samples
    else:
        _add(memory.since, memory.since_map, memory.errors[newest], 1.0)
        memory.since_map[:] = memory.since_map @ np.ascontiguousarray(memory.transitions[newest].T)
    memory.counts[4] = samples
    r, state = memory.sums[oldest].copy(), memory.states[oldest].copy()
    _add(r, memory.maps[oldest], memory.since, 1.0)
    _add(state, memory.covariances[oldest], r, 1.0)
    result[:] = 0.0
    _add(result, readout, state, 1.0)


@njit
def read(memory, readout, lags, result):
    """Write the estimates at some lags, in samples, which ascend."""
    samples, ring, n = memory.counts[0], len(memory.states), len(memory.x)
    r, before, done = np.zeros(n), np.zeros(n), 0
    for at in range(len(lags)):
        if lags[at] > samples:
            result[at] = np.nan
            continue
        for d in range(done + 1, lags[at] + 1):
            slot = (samples - d) % ring
            before[:] = r
            for i in range(n):
                r[i] = memory.errors[slot, i]
                for j in range(n):
                    r[i] += memory.transitions[slot, j, i] * before[j]
        done = lags[at]
        if done == 0:
            before[:] = memory.x
        else:
            slot = (samples - done) % ring
            before[:] = memory.states[slot]
            _add(before, memory.covariances[slot], r, 1.0)
        result[at] = 0.0
        _add(result[at], readout, before, 1.0)


@njit
def _spread(memory, readout, lags, result):
    """Write the standard deviations of the errors of these estimates."""
    samples, ring, n = memory.counts[0], len(memory.states), len(memory.x)
    information, done = np.zeros((n, n)), 0
    for at in range(len(lags)):
        if lags[at] > samples:
            result[at] = np.nan
            continue
        for d in range(done + 1, lags[at] + 1):
            slot = (samples - d) % ring
            closed = memory.transitions[slot]
            information = np.ascontiguousarray(closed.T) @ information @ closed
            information += memory.informations[slot]
        done = lags[at]
        covariance = memory.P.copy()
        if done > 0:
            P = memory.covariances[(samples - done) % ring]
            covariance = P - P @ information @ P
        for i in range(len(readout)):
            result[at, i] = np.sqrt(max(readout[i] @ covariance @ readout[i], 0.0))
