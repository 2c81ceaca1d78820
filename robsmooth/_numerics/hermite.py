r"""Normalised Hermite polynomials of several variables, and operators between them.

With :math:`a_i = \partial/\partial\xi_i` and its adjoint :math:`a_i^*` under :math:`N(0, I)`,
:math:`a_ih_\alpha = \sqrt{\alpha_i}\,h_{\alpha - e_i}`; :math:`\xi_i` is :math:`a_i + a_i^*`.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh_tridiagonal

_ZERO_ENTRY = 1e-15  # of a matrix, relative to its largest entry, below which it is zero


def multiplication_matrix(
    function: Callable[[NDArray], NDArray], factor: float, degree: int
) -> NDArray[np.float64]:
    """Return the matrix of multiplication with function(factor x) between h_0 ... h_degree.

    The eigenvectors of the matrix of x, in a larger basis, are Gauss-Hermite quadrature.
    """
    nodes = 2 * degree + 40
    x, vectors = eigh_tridiagonal(np.zeros(nodes), np.sqrt(np.arange(1.0, nodes)))
    vectors = vectors[: degree + 1]
    matrix = vectors * function(factor * x) @ vectors.T
    matrix[np.abs(matrix) < _ZERO_ENTRY * np.abs(matrix).max()] = 0.0
    return matrix


class HermiteBasis:
    """The polynomials of d variables up to a total degree, in graded order.

    Those of degree one are in the order of the variables. A number that is linear in the exponents
    sorts them: a step in the exponents changes all these numbers by the same.
    """

    def __init__(self, dimension: int, degree: int):
        self.dimension, self.degree = dimension, degree
        variables = range(dimension)
        choose = itertools.combinations_with_replacement
        products = (product for k in range(1 + degree) for product in choose(variables, k))
        self.indices = np.array([[factors.count(k) for k in variables] for factors in products])
        self.degrees = self.indices.sum(axis=1)
        self.even, self.odd = (np.flatnonzero(self.degrees % 2 == k) for k in (0, 1))  # positions
        digits = (degree + 1) ** np.arange(dimension, -1, -1)
        self._digits = digits[0] - digits[1:]  # first the degree, then the first exponents
        self._numbers = self.indices @ self._digits

        self.lowering = []  # a_1 ... a_d
        for exponents, step in zip(self.indices.T, -np.eye(dimension, dtype=int), strict=True):
            columns = np.flatnonzero(exponents)
            rows = self._after(columns, step)
            self.lowering.append(self._array(np.sqrt(exponents[columns]), columns, rows))
        self.coordinates = [a + a.T for a in self.lowering]  # multiplications with xi_1 ... xi_d

    def _after(self, positions, step) -> NDArray[np.int_]:
        """Return the positions of the polynomials after a step in the first exponents."""
        numbers = self._numbers[positions] + step @ self._digits[: len(step)]
        return np.searchsorted(self._numbers, numbers)

    def _array(self, values, columns, rows) -> sparse.csr_array:
        return sparse.csr_array((values, (rows, columns)), shape=2 * self.indices.shape[:1])

    def derivative(self, direction: NDArray[np.float64]) -> sparse.csr_array:
        """The derivative along a direction."""
        return sum(part * a for part, a in zip(direction, self.lowering, strict=True))

    def multiplication(self, factors: list[NDArray[np.float64]]) -> sparse.csr_array:
        """Multiplication with f_1(xi_1) f_2(xi_2) ..., exact, from the matrix of each f_k."""
        all_bands = range(-self.degree, self.degree + 1)
        bands = ([s for s in all_bands if f.diagonal(-s).any()] for f in factors)
        exponents, parts = self.indices[:, : len(factors)], []
        for step in itertools.product(*bands):
            room = self.degrees + sum(step) <= self.degree
            columns = np.flatnonzero(room & (exponents + step >= 0).all(axis=1))
            start = exponents[columns]
            moved = start + step
            values = math.prod(f[moved[:, k], start[:, k]] for k, f in enumerate(factors))
            parts.append((values, columns, self._after(columns, step)))
        return self._array(*map(np.concatenate, zip(*parts, strict=True)))
