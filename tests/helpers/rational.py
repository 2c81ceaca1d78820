"""Covariances in exact arithmetic, or to 200 digits: floats are rationals."""

from decimal import Decimal, localcontext
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


def exact_noise(A, B, span):
    """The integral of e^{As} BB' e^{A's} from 0 to the span, for these floats, to 200 digits.

    A is lower triangular, with distinct eigenvalues a: in the coordinates of the eigenvectors V the
    integrand is a sum of exponentials.
    """
    n = len(A)
    with localcontext(prec=200):
        A, B = ([[Decimal(float(x)) for x in row] for row in matrix] for matrix in (A, B))
        span, a = Decimal(float(span)), [A[i][i] for i in range(n)]
        V = [[Decimal(i == j) for j in range(n)] for i in range(n)]
        for j in range(n):
            for i in range(j + 1, n):
                V[i][j] = sum(A[i][k] * V[k][j] for k in range(j, i)) / (a[j] - a[i])
        gains = []  # V^-1 B
        for i in range(n):
            known = [sum(V[i][k] * gains[k][c] for k in range(i)) for c in range(len(B[i]))]
            gains.append([x - y for x, y in zip(B[i], known, strict=True)])
        W = np.zeros((n, n), dtype=object)
        for i in range(n):
            for j in range(n):
                rate = a[i] + a[j]
                power = sum(x * y for x, y in zip(gains[i], gains[j], strict=True))
                W[i, j] = power * ((rate * span).exp() - 1) / rate
        V = np.array(V, dtype=object)
        return (V @ W @ V.T).astype(float)


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
