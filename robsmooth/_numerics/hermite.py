r"""Normalised Hermite polynomials of several variables, and operators between them.

They are orthonormal under :math:`N(0, I)`: with :math:`a_i = \partial/\partial\xi_i` and
:math:`a_i^*` its adjoint, :math:`a_ih_\alpha = \sqrt{\alpha_i}\,h_{\alpha - e_i}`, and
multiplication with :math:`\xi_i` is :math:`a_i + a_i^*`.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh_tridiagonal
from scipy.special import comb

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
    r"""The polynomials of d variables up to a total degree.

    In graded order, the degree-one polynomials as their variables. With the tails :math:`s_k =
    \alpha_k + \dots + \alpha_d` the position of :math:`h_\alpha` is :math:`\sum_k\binom{s_k + d -
    k}{d - k + 1}`.
    """

    def __init__(self, dimension: int, degree: int):
        self.dimension, self.degree = dimension, degree
        indices = np.zeros((1, 0), int)
        for _ in range(dimension):
            room = 1 + degree - indices.sum(axis=1)
            first = np.cumsum(room) - room
            new = np.arange(room.sum()) - np.repeat(first, room)
            indices = np.column_stack([np.repeat(indices, room, axis=0), new])
        d, s = dimension - np.arange(dimension)[:, None], np.arange(degree + 1)
        self._table = comb(s + d - 1, d, exact=False).round().astype(int)
        self.indices = indices[np.argsort(self._positions(indices))]

        self.degrees = self.indices.sum(axis=1)
        # the positions of the polynomials of even and of odd degree
        self.even, self.odd = (np.flatnonzero(self.degrees % 2 == k) for k in (0, 1))
        self.identity = sparse.eye_array(len(indices))
        lowering = [self._lowering(axis) for axis in range(dimension)]
        self.lowering = sparse.vstack(lowering, format="csr")  # a_1 ... a_d, one above the other
        self.coordinates = [a + a.T for a in lowering]  # multiplications with xi_1 ... xi_d

    def _positions(self, indices: NDArray[np.int_]) -> NDArray[np.int_]:
        tails = np.cumsum(indices[:, ::-1], axis=1)[:, ::-1]
        return self._table[np.arange(self.dimension), tails].sum(axis=1)

    def _lowering(self, axis: int) -> sparse.csr_array:
        columns = np.flatnonzero(self.indices[:, axis])
        lower = self.indices[columns]
        values = np.sqrt(lower[:, axis])
        lower[:, axis] -= 1
        return self._array(values, self._positions(lower), columns)

    def _array(self, values, rows, columns) -> sparse.csr_array:
        size = len(self.indices)
        return sparse.csr_array((values, (rows, columns)), shape=(size, size))

    def derivative(self, direction: NDArray[np.float64]) -> sparse.csr_array:
        """The derivative along a direction."""
        return sparse.kron(direction[None, :], self.identity, format="csr") @ self.lowering

    def multiplication(self, factors: list[NDArray[np.float64]]) -> sparse.csr_array:
        """Multiplication with f_1(xi_1) f_2(xi_2) ..., from the matrices of one variable: exact."""
        all_bands = range(-self.degree, self.degree + 1)
        bands = ([s for s in all_bands if f.diagonal(-s).any()] for f in factors)
        axes = slice(len(factors))
        rows, columns, values = [], [], []
        for shifts in itertools.product(*bands):
            room = self.degrees + sum(shifts) <= self.degree
            inside = np.flatnonzero(room & (self.indices[:, axes] + shifts >= 0).all(axis=1))
            start = self.indices[inside]
            moved = start.copy()
            moved[:, axes] += shifts
            entries = (f[moved[:, k], start[:, k]] for k, f in enumerate(factors))
            rows.append(self._positions(moved))
            columns.append(inside)
            values.append(math.prod(entries))
        return self._array(*(np.concatenate(part) for part in (values, rows, columns)))
