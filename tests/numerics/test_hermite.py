"""Hermite polynomials and their operators, against quadrature in several variables."""

import itertools
import math

import numpy as np
import pytest
from numpy.polynomial import hermite_e
from numpy.testing import assert_allclose

from robsmooth._numerics.hermite import HermiteBasis, multiplication_matrix

NODES, WEIGHTS = hermite_e.hermegauss(60)
WEIGHTS = WEIGHTS / WEIGHTS.sum()


def values(basis, points):
    """The polynomials (polynomials, points) at points (points, variables)."""
    one = hermite_e.hermevander(points, basis.degree)
    one /= np.sqrt([math.factorial(k) for k in range(basis.degree + 1)])
    chosen = [one[:, k, basis.indices[:, k]] for k in range(basis.dimension)]
    return np.prod(chosen, axis=0).T


def grid(dimension):
    """Points (points, variables) and weights of N(0, I)."""
    points = np.array(list(itertools.product(NODES, repeat=dimension)))
    weights = np.array([math.prod(w) for w in itertools.product(WEIGHTS, repeat=dimension)])
    return points, weights


@pytest.mark.parametrize("factor", [0.3, -1.2])
def test_multiplication_with_a_function_of_one_variable_is_its_integrals(factor):
    basis = HermiteBasis(1, 6)
    h = values(basis, NODES[:, None])
    expected = h * (WEIGHTS * np.sin(factor * NODES)) @ h.T
    assert_allclose(multiplication_matrix(np.sin, factor, 6), expected, atol=1e-13)


@pytest.mark.parametrize(("dimension", "degree"), [(1, 7), (2, 5)])
def test_operators_are_their_integrals(dimension, degree):
    basis = HermiteBasis(dimension, degree)
    points, weights = grid(dimension)
    h = values(basis, points)
    assert_allclose(h * weights @ h.T, np.eye(len(h)), atol=1e-12)
    factors = [multiplication_matrix(np.cos, 0.4 + k, degree) for k in range(dimension)]
    function = np.prod([np.cos((0.4 + k) * points[:, k]) for k in range(dimension)], axis=0)
    product = basis.multiplication(factors).toarray()
    assert_allclose(product, h * (weights * function) @ h.T, atol=1e-12)
    for k, x in enumerate(basis.coordinates):
        assert_allclose(x.toarray(), h * (weights * points[:, k]) @ h.T, atol=1e-12)


def test_derivative_along_a_direction_is_that_of_differences():
    basis, direction = HermiteBasis(3, 4), np.array([0.3, -0.5, 0.8])
    points = np.random.default_rng(1).standard_normal((5, 3))
    step = 1e-5
    difference = values(basis, points + step * direction) - values(basis, points - step * direction)
    found = basis.derivative(direction).toarray().T @ values(basis, points)
    assert_allclose(found, difference / (2 * step), atol=1e-8)
