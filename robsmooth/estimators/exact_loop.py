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

With the Cholesky factor :math:`\Sigma = LL'`, the normalised innovations :math:`L^{-1}e_k` are
white with the covariance I, where the record is one of the model. Rows of a missing measurement are
left out of H.

Where modes V of the state are not known at the start, :math:`x_0 = \hat x_0 + V\delta`, the filter
runs with :math:`\delta = 0` until the innovations determine it (the same author, "The diffuse
Kalman filter", Ann. Stat. 19(2), 1991). With :math:`V \leftarrow \Psi V`, they are
:math:`e_k - HV\delta`, and :math:`\delta` and its covariance, added to estimate and covariance, are
those of least squares.

What a copy gives, :math:`\mu =
\psi(C_\nu\hat x - r)`, is taken at the beginning of a sample and, predicted, at its end, and held
to be linear in time.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from robsmooth._support.kernels import kept

Floats = NDArray[np.float64]
_STEADY = 1e-15  # of the variances: a covariance that changes by less stays as it is
_KNOWN = 1e-6  # delta is determined where its variance, in its own units, is below one over this
# Times the noise of a sample: where more than this is not known of a state, its smoothed estimate
# would be the difference of numbers that are too large.
_MOST = 1e10


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
    white: Floats  # (l, l) the inverse of its L, with zeros for what is missing
    seen: Floats  # (l, N) that times H
    closed: Floats  # (N, N) Psi
    pattern: NDArray[np.bool_]  # (l,) which of its measurements were there
    # samples taken, how many of the last had one covariance, from which on the state is known or -1
    counts: NDArray[np.int64]
    unknown: Floats  # (N, d) V, of what is not known until then
    information: Floats  # (d, d) the inverse of delta's covariance
    score: Floats  # (d,) that times delta
    states: Floats  # (ring, N)
    covariances: Floats  # (ring, N, N)
    errors: Floats  # (ring, N) `seen`' times the normalised innovation
    sights: Floats  # (ring, l, N) `seen`
    transitions: Floats  # (ring, N, N)
    lost: NDArray[np.bool_]  # (ring,) of which too little is known


@kept()
def _gains(sampled, P, present):
    """Return gain, the inverse of L, Psi, the next P, and whether P is too large to smooth."""
    H, l = sampled.H, len(sampled.H)  # noqa: E741
    rows = np.flatnonzero(present)
    white, lost = np.zeros((l, l)), False
    covariance = H @ np.ascontiguousarray(P @ H.T) + sampled.R
    for i in range(l):
        lost = lost or covariance[i, i] > _MOST * sampled.R[i, i]
    if len(rows):
        some = np.empty((len(rows), len(rows)))
        for i in range(len(rows)):
            for j in range(len(rows)):
                some[i, j] = covariance[rows[i], rows[j]]
        root = np.linalg.inv(np.linalg.cholesky(some))
        for i in range(len(rows)):
            for j in range(i + 1):
                white[rows[i], rows[j]] = root[i, j]
    inverse = np.ascontiguousarray(white.T) @ white
    gain = (sampled.Phi @ np.ascontiguousarray(P @ H.T) + sampled.S) @ inverse
    closed = sampled.Phi - gain @ H
    cross = sampled.S @ np.ascontiguousarray(gain.T)
    following = closed @ P @ np.ascontiguousarray(closed.T) + sampled.Q - cross - cross.T
    following += gain @ sampled.R @ np.ascontiguousarray(gain.T)
    return gain, white, closed, (following + following.T) / 2, lost


@kept()
def _same(P, following):
    for i in range(len(P)):
        for j in range(len(P)):
            if not abs(following[i, j] - P[i, j]) <= _STEADY * np.sqrt(P[i, i] * P[j, j]):
                return False
    return True


@kept()
def _add(result, matrix, vector, sign):
    for i in range(len(result)):
        for j in range(len(vector)):
            result[i] += sign * matrix[i, j] * vector[j]


@njit
def advance(copies, sampled, memory, readout, lags, within, given, result, spread, normalised):
    """Take samples; write the estimates, (rows, lags, m), deviations and normalised innovations.

    The latter two are not wanted where they have no rows. Row k of `known` is taken off the
    measurement, `drive` goes to the state, NaN is missing. `within` is one where the estimates are
    of a time within the sample before, else zero.
    """
    y, known, drive, reference = given
    g, l, n, ring = len(sampled.arguments), y.shape[1], len(memory.x), len(memory.states)  # noqa: E741
    mu, change, arguments = np.zeros(g), np.zeros(g), np.zeros(g)
    error, following, present = np.zeros(l), np.zeros(n), np.zeros(l, dtype=np.bool_)
    z, deviations = np.zeros(l), np.zeros((len(lags), len(readout)))
    for k in range(len(y)):
        x = memory.x
        for i in range(n):
            following[i] = drive[k, i]
        _add(following, sampled.transition, x, 1.0)
        for i in range(l):
            error[i], z[i] = y[k, i] - known[k, i], 0.0
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
        slot, known_in_ring = memory.counts[0] % max(ring, 1), memory.counts[1] > ring
        if ring:
            for i in range(n):
                memory.states[slot, i] = x[i]
            if not known_in_ring:
                memory.covariances[slot] = memory.P
        if changed:
            gain, white, closed, after, lost = _gains(sampled, memory.P, present)
            if ring:
                memory.lost[slot] = lost
            memory.gain[:], memory.white[:], memory.closed[:] = gain, white, closed
            memory.seen[:] = white @ sampled.H
            memory.pattern[:] = present
            memory.counts[1] = 1 if _same(memory.P, after) else 0
            memory.P[:] = after
        else:
            memory.counts[1] += 1
        _add(following, memory.gain, error, 1.0)
        for i in range(n):
            x[i] = following[i]
        _add(z, memory.white, error, 1.0)
        if len(normalised):
            normalised[k] = np.where(present, z, np.nan)
        if ring:
            for i in range(n):
                memory.errors[slot, i] = 0.0
                for j in range(l):
                    memory.errors[slot, i] += memory.seen[j, i] * z[j]
            if changed or not known_in_ring:
                memory.transitions[slot], memory.sights[slot] = memory.closed, memory.seen
        memory.counts[0] += 1
        if memory.counts[2] < 0:
            _determine(memory, z)
            normalised[k : k + 1] = np.nan
        read(memory, readout, lags, within, result[k])
        if len(spread):
            if k == 0 or memory.counts[1] <= ring + 1:
                spread_of(memory, readout, lags, within, deviations)
            spread[k] = deviations


@kept()
def advance_linear(sampled, memory, readout, lags, within, given, result, spread, normalised):
    """Do as `advance` without copies; it need not be compiled anew."""
    advance(None, sampled, memory, readout, lags, within, given, result, spread, normalised)


@kept()
def _determine(memory, z):
    """Add what a sample tells of delta; where that is enough, add delta to the estimate."""
    seen = memory.seen @ memory.unknown
    memory.information[:] += seen.T @ seen
    _add(memory.score, seen.T, z, 1.0)
    memory.unknown[:] = memory.closed @ memory.unknown
    if np.linalg.eigvalsh(memory.information)[0] > _KNOWN:
        inverse = np.linalg.inv(memory.information)
        _add(memory.x, memory.unknown @ inverse, memory.score, 1.0)
        memory.P[:] += memory.unknown @ inverse @ memory.unknown.T
        memory.counts[1], memory.counts[2] = 0, memory.counts[0]


@kept()
def _known(memory):
    """Return for how many samples the state has been known."""
    return memory.counts[0] - memory.counts[2] if memory.counts[2] >= 0 else -1


@kept()
def read(memory, readout, lags, within, result):
    """Write the estimates at some lags, in samples, which ascend."""
    samples, ring, n = memory.counts[0], len(memory.states), len(memory.x)
    known = _known(memory)
    r, before, done, slot = np.zeros(n), np.zeros(n), 0, samples % max(ring, 1)
    for at in range(len(lags)):
        if lags[at] + within > known:
            result[at] = np.nan
            continue
        for _ in range(done, lags[at]):
            slot = (slot if slot else ring) - 1
            for i in range(n):
                before[i] = r[i]
            for i in range(n):
                r[i] = memory.errors[slot, i]
                for j in range(n):
                    r[i] += memory.transitions[slot, j, i] * before[j]
        done = lags[at]
        if done == 0:
            for i in range(n):
                before[i] = memory.x[i]
        else:
            for i in range(n):
                before[i] = memory.states[slot, i]
            _add(before, memory.covariances[slot], r, 1.0)
        for i in range(len(readout)):
            result[at, i] = 0.0
            for j in range(n):
                result[at, i] += readout[i, j] * before[j]
            if done > 0 and memory.lost[slot]:
                result[at, i] = np.nan


@kept()
def spread_of(memory, readout, lags, within, result):
    """Write the standard deviations of the errors of these estimates."""
    samples, ring, n = memory.counts[0], len(memory.states), len(memory.x)
    information, done = np.zeros((n, n)), 0
    for at in range(len(lags)):
        if lags[at] + within > _known(memory):
            result[at] = np.nan
            continue
        for d in range(done + 1, lags[at] + 1):
            slot = (samples - d) % ring
            closed = memory.transitions[slot]
            information = np.ascontiguousarray(closed.T) @ information @ closed
            information += np.ascontiguousarray(memory.sights[slot].T) @ memory.sights[slot]
        done = lags[at]
        covariance = memory.P.copy()
        if done > 0:
            P = memory.covariances[(samples - done) % ring]
            covariance = P - P @ information @ P
        lost = done > 0 and memory.lost[(samples - done) % ring]
        for i in range(len(readout)):
            variance = max(readout[i] @ covariance @ readout[i], 0.0)
            result[at, i] = np.nan if lost else np.sqrt(variance)
