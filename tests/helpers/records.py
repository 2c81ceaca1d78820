"""Records of a linear system, and what is to be known from them, by independent routes."""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from robsmooth._numerics.lyapunov import noise_root


def in_samples(system, dt):
    """Return what a sample does to the state and to the integral of the measurement, with noise."""
    n, l = system.n, system.l  # noqa: E741
    whole = np.block([[system.A, np.zeros((n, l))], [system.C2, np.zeros((l, l))]])
    root = noise_root(whole, np.vstack([system.B1, system.D21]), dt)
    return expm(dt * whole)[:, :n], root


def simulated(system, dt, rows, rng, start):
    """Return samples and states at their ends, (rows, l) and (rows, n), from a state."""
    through, root = in_samples(system, dt)
    x, ends = start, []
    for noise in rng.standard_normal((rows, root.shape[1])):
        ends.append(through @ x + root @ noise)
        x = ends[-1][: system.n]
    ends = np.array(ends)
    return ends[:, system.n :] / dt, ends[:, : system.n]


def conditioned(
    system, dt, y, delay, covariance, parts=1, whole=False, counts=None, instants=False
):
    """Return estimates of w and their deviations, given all samples so far, or the whole record.

    All noises of the record are one Gaussian vector; each estimate is its mean given the samples.
    A sample has so many parts, of which a whole number is in the delay; or it has counts of them.
    It is a mean, or of the instant at its end, with the noise of a mean over `dt`. The state at the
    start has the mean zero; without a covariance nothing is known of it, and it is that of least
    squares.
    """
    counts = [parts] * len(y) if counts is None else counts
    within = replace(system, C2=0.0 * system.C2) if instants else system
    through, root = in_samples(within, dt / parts)
    n, width, ends = system.n, root.shape[1], np.cumsum(counts)
    total = n + ends[-1] * width
    states, seen = [np.zeros((n, total))], []
    states[0][:, :n] = np.eye(n) if covariance is None else np.linalg.cholesky(covariance)
    integral = np.zeros((system.l, total))
    for i in range(ends[-1]):
        end = through @ states[-1]
        end[:, n + i * width : n + (i + 1) * width] += root
        states.append(end[:n])
        integral = integral + end[n:]
        if i + 1 in ends:
            length = counts[len(seen)] * dt / parts
            noise = integral / np.sqrt(length * dt)
            seen.append(system.C2 @ states[-1] + noise if instants else integral / length)
            integral = 0.0 * integral
    found = np.full((2, len(y), system.m), np.nan)
    for k in range(len(y)):
        at = ends[k] - round(delay / dt * parts)
        if at < 0:
            continue
        last = len(y) if whole else k + 1
        rows, values = np.vstack(seen[:last]), y[:last].ravel()
        there = np.isfinite(values)
        rows, values, w = rows[there], values[there], system.C0 @ states[at]
        X, W, free = rows[:, :n], w[:, :n], n if covariance is None else 0
        rows, w = rows[:, free:], w[:, free:]
        gain = np.linalg.solve(rows @ rows.T, rows @ w.T).T
        variance = w @ w.T - gain @ rows @ w.T
        estimate = gain @ values
        if covariance is None:
            weighted = np.linalg.solve(rows @ rows.T, X).T
            start = np.linalg.inv(weighted @ X)
            W = W - gain @ X
            estimate, variance = (
                estimate + W @ start @ weighted @ values,
                variance + W @ start @ W.T,
            )
        found[0, k], found[1, k] = estimate, np.sqrt(np.diag(variance))
    return found


def rauch_tung_striebel(system, dt, y, covariance):
    """Return the fixed-interval smoother's means and covariances at the ends of the samples.

    The textbook's recursion, for the state and the integral of the measurement over a sample.
    """
    through, root = in_samples(system, dt)
    n, l = system.n, system.l  # noqa: E741
    F = np.hstack([through, np.zeros((n + l, l))])
    H = np.hstack([np.zeros((l, n)), np.eye(l) / dt])
    m, P = np.zeros(n + l), np.zeros((n + l, n + l))
    P[:n, :n] = covariance
    filtered = []
    for sample in y:
        ahead, P_ahead = F @ m, F @ P @ F.T + root @ root.T
        there = np.isfinite(sample)
        S = H[there] @ P_ahead @ H[there].T
        gain = np.linalg.solve(S, H[there] @ P_ahead).T
        m = ahead + gain @ (sample[there] - H[there] @ ahead)
        P = P_ahead - gain @ S @ gain.T
        filtered.append((m, P, ahead, P_ahead))
    means, covariances = [m[:n]], [P[:n, :n]]
    for (m_f, P_f, *_), (*_, ahead, P_ahead) in zip(filtered[-2::-1], filtered[:0:-1], strict=True):
        back = np.linalg.solve(P_ahead, F @ P_f).T
        m, P = m_f + back @ (m - ahead), P_f + back @ (P - P_ahead) @ back.T
        means.append(m[:n])
        covariances.append(P[:n, :n])
    return np.array(means[::-1]), np.array(covariances[::-1])
