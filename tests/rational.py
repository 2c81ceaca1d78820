"""Lyapunov's equation in exact rational arithmetic: floats are rationals, so nothing is rounded."""

from fractions import Fraction

import numpy as np


def exact_covariance(A, Q):
    """The exact solution of AP + PA' + Q = 0 for these floats, rounded once at the end."""
    n = len(A)
    pairs = [(i, j) for i in range(n) for j in range(i, n)]
    index = {pair: number for number, pair in enumerate(pairs)}
    A, Q = ([[Fraction(float(x)) for x in row] for row in matrix] for matrix in (A, Q))
    rows = []
    for i, j in pairs:
        row = [Fraction(0)] * len(pairs) + [-Q[i][j]]
        for k in range(n):
            row[index[min(k, j), max(k, j)]] += A[i][k]
            row[index[min(i, k), max(i, k)]] += A[j][k]
        rows.append(row)
    solution = eliminate(rows)
    P = np.empty((n, n))
    for (i, j), value in zip(pairs, solution, strict=True):
        P[i, j] = P[j, i] = float(value)
    return P


def eliminate(rows):
    """Gauss and Jordan's elimination of rows [matrix, right-hand side]."""
    size = len(rows)
    for pivot in range(size):
        best = max(range(pivot, size), key=lambda r: abs(rows[r][pivot]))
        rows[pivot], rows[best] = rows[best], rows[pivot]
        head = rows[pivot]
        head[pivot:] = [value / head[pivot] for value in head[pivot:]]
        for row in rows:
            if row is not head and row[pivot]:
                factor = row[pivot]
                row[pivot:] = [
                    x - factor * h for x, h in zip(row[pivot:], head[pivot:], strict=True)
                ]
    return [row[-1] for row in rows]
