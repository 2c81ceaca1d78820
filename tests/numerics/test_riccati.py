"""The Riccati solver: against SciPy's, closed forms, and its invariances."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_continuous_are

from robsmooth._numerics.riccati import RiccatiError, _certify, solve_riccati
from tests.helpers.strategies import orthogonal_matrix, seeds, stable_matrix

KINDS = ("positive", "semidefinite", "indefinite", "negative")


def pencil_solution(A, Q, S):
    """The stabilising solution of SciPy, by the ordered eigenvalues of the extended pencil."""
    weights, directions = np.linalg.eigh(S)
    used = np.abs(weights) > 1e-14 * np.abs(weights).max()
    B = directions[:, used] * np.sqrt(np.abs(weights[used]))
    return solve_continuous_are(A, B, Q, np.diag(np.sign(weights[used])))


def random_equation(rng, n, kind):
    """Data with a stabilising solution: Q follows from a chosen S and a stable closed loop."""
    signs = {
        "positive": np.ones(n),
        "semidefinite": np.r_[1.0, np.zeros(n - 1)],
        "indefinite": np.r_[1.0, -np.ones(n - 1)],
        "negative": -np.ones(n),
    }[kind]
    basis = orthogonal_matrix(rng, n)
    S = basis @ np.diag(signs * rng.uniform(0.3, 2.0, n)) @ basis.T
    X = rng.standard_normal((n, n))
    X = (X + X.T) / 2
    A = stable_matrix(rng, n) + S @ X
    Q = -(A.T @ X + X @ A - X @ S @ X)
    return A, Q, S, X


equations = st.tuples(seeds, st.integers(1, 6), st.sampled_from(KINDS)).map(
    lambda drawn: random_equation(np.random.default_rng(drawn[0]), *drawn[1:])
)


@given(equations)
def test_solution_is_the_one_the_equation_was_made_from(equation):
    A, Q, S, X = equation
    found = solve_riccati(A, Q, S)
    tolerance = 1e-6 * (1 + np.abs(X).max())  # conditioning: the closed loop may be slow
    assert_allclose(found.X, X, rtol=0, atol=tolerance)


@given(equations)
def test_solution_is_symmetric_stabilising_and_certified(equation):
    A, Q, S, _ = equation
    found = solve_riccati(A, Q, S)
    X = found.X
    assert_array_equal(X, X.T)
    terms = (A.T @ X, X @ A, Q, -X @ S @ X)
    assert np.linalg.norm(sum(terms)) < 1e-8 * sum(map(np.linalg.norm, terms))
    assert found.residual < 1e-12
    decay = -np.linalg.eigvals(A - S @ X).real.max()
    assert decay > 0
    assert found.decay_rate == pytest.approx(decay, rel=1e-9)
    smallest = np.linalg.eigvalsh(X).min() / np.linalg.norm(X)
    if abs(smallest) > 1e-9:  # its size is that in balancing units, its sign in any
        assert np.sign(found.smallest_eigenvalue) == np.sign(smallest)


@given(equations)
def test_solution_agrees_with_the_stable_subspace_of_the_hamiltonian(equation):
    A, Q, S, X = equation
    tolerance = 1e-6 * (1 + np.abs(X).max())
    assert_allclose(solve_riccati(A, Q, S).X, pencil_solution(A, Q, S), rtol=0, atol=tolerance)


@given(seeds, st.integers(1, 5))
def test_solution_agrees_with_python_control_for_a_control_problem(seed, n):
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, 2))
    C = rng.standard_normal((n, n))
    Q, R = C.T @ C, np.diag(rng.uniform(0.5, 2.0, 2))
    expected = control.care(A, B, Q, R)[0]
    X = solve_riccati(A, Q, B @ np.linalg.solve(R, B.T)).X
    assert_allclose(X, expected, rtol=0, atol=1e-7 * (1 + np.abs(expected).max()))


@given(equations)
def test_solution_agrees_with_slycot(equation):
    slycot = pytest.importorskip("slycot")
    A, Q, S, _ = equation
    found = solve_riccati(A, Q, S).X
    X = slycot.sb02md(len(A), A, S, Q, "C")[0]
    assert_allclose(found, X, rtol=0, atol=1e-7 * (1 + np.abs(X).max()))


@given(seeds, st.integers(1, 5))
def test_solution_agrees_with_python_control_by_slycot(seed, n):
    pytest.importorskip("slycot")
    rng = np.random.default_rng(seed)
    A, B, C = stable_matrix(rng, n), rng.standard_normal((n, 2)), rng.standard_normal((1, n))
    expected = control.care(A, B, C.T @ C, method="slycot")[0]
    found = solve_riccati(A, C.T @ C, B @ B.T).X
    assert_allclose(found, expected, rtol=0, atol=1e-9 * (1e-3 + np.abs(expected).max()))


@given(seeds, st.integers(1, 5))
def test_without_a_quadratic_term_the_equation_is_lyapunovs(seed, n):
    rng = np.random.default_rng(seed)
    A = stable_matrix(rng, n)
    Q = rng.standard_normal((n, n))
    Q = Q + Q.T
    X = solve_riccati(A, Q, np.zeros((n, n))).X
    # (I x A' + A' x I) vec X = -vec Q, by columns
    system = np.kron(np.eye(n), A.T) + np.kron(A.T, np.eye(n))
    expected = np.linalg.solve(system, -Q.ravel(order="F")).reshape((n, n), order="F")
    assert_allclose(X, expected, rtol=0, atol=1e-9 * (1 + np.abs(expected).max()))


def test_nothing_at_all_has_the_solution_zero():
    assert_array_equal(solve_riccati(-np.eye(2), np.zeros((2, 2)), np.zeros((2, 2))).X, 0)
    A = stable_matrix(np.random.default_rng(0), 2)
    assert_array_equal(solve_riccati(A, np.zeros((2, 2)), np.eye(2)).X, 0)


def scalar(a, q, s):
    one = np.ones((1, 1))
    return solve_riccati(a * one, q * one, s * one).X[0, 0]


@pytest.mark.parametrize("a", [-2.0, -1e-3, 3.0])
@pytest.mark.parametrize("q", [0.1, 5.0])
@pytest.mark.parametrize("s", [1e-8, 0.5, 1e8])
def test_scalar_equation_has_its_closed_form_for_positive_s(a, q, s):
    # 2 a x + q - s x^2 = 0 with a - s x < 0, written without cancellation
    root = np.sqrt(a * a + s * q)
    expected = (a + root) / s if a > 0 else q / (root - a)
    assert scalar(a, q, s) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("inside", [1e-1, 1e-3, 1e-6])
def test_scalar_equation_has_its_closed_form_inside_the_boundary_of_existence(inside, unit):
    # For s < 0 a stabilising solution exists while a^2 + s q > 0 (and a < 0).
    a, q = -1.0 * unit, 2.0
    s = -(a * a) * (1.0 - inside) / q
    expected = q / (np.sqrt(a * a + s * q) - a)
    assert scalar(a, q, s) == pytest.approx(expected, rel=1e-9 / np.sqrt(inside))


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("outside", [1e-6, 1e-3, 1e-1, 10.0])
def test_outside_the_boundary_of_existence_there_is_an_error_not_a_number(outside, unit):
    a, q = -1.0 * unit, 2.0
    s = -(a * a) * (1.0 + outside) / q
    with pytest.raises(RiccatiError):
        scalar(a, q, s)


@pytest.mark.parametrize("n", [2, 4])
@pytest.mark.parametrize("excess", [0.9, 0.999, 1.001, 1.1])
def test_boundary_of_existence_is_that_of_the_bounded_real_lemma(n, excess):
    # A'X + XA + C'C + X BB' X / level^2 = 0 is solvable if and only if |C (s - A)^-1 B| < level.
    rng = np.random.default_rng(n)
    A, B, C = stable_matrix(rng, n), rng.standard_normal((n, 1)), rng.standard_normal((1, n))
    omega = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 20001)])
    peak = max(abs((C @ np.linalg.solve(1j * w * np.eye(n) - A, B))[0, 0]) for w in omega)
    S = -B @ B.T / (excess * peak) ** 2
    if excess > 1:
        assert solve_riccati(A, C.T @ C, S).smallest_eigenvalue > -1e-9
    else:
        with pytest.raises(RiccatiError):
            solve_riccati(A, C.T @ C, S)


@pytest.mark.parametrize("A", [np.zeros((1, 1)), np.eye(1)])
def test_a_mode_that_nothing_stabilises_is_an_error(A):
    zero = np.zeros((1, 1))
    for Q in (zero, np.eye(1)):
        with pytest.raises(RiccatiError):
            solve_riccati(A, Q, zero)


@given(equations, st.integers(-60, 60), st.integers(-60, 60))
def test_units_that_are_powers_of_two_change_no_digit(equation, time, unit):
    A, Q, S, _ = equation
    t, p = 2.0**time, 2.0**unit
    scaled = solve_riccati(A * t, Q * (t * p), S * (t / p))
    plain = solve_riccati(A, Q, S)
    assert_array_equal(scaled.X, plain.X * p)
    assert scaled.decay_rate == plain.decay_rate * t


@given(equations, st.floats(-18, 18), st.floats(-18, 18))
def test_other_units_change_the_solution_by_rounding_only(equation, time, unit):
    A, Q, S, X = equation
    t, p = 10.0**time, 10.0**unit
    scaled = solve_riccati(A * t, Q * (t * p), S * (t / p)).X / p
    assert_allclose(scaled, X, rtol=0, atol=1e-6 * (1 + np.abs(X).max()))


@given(equations)
def test_solution_follows_a_change_of_coordinates(equation):
    A, Q, S, X = equation
    rng = np.random.default_rng(0)
    T = np.diag(10.0 ** rng.uniform(-2, 2, len(A))) @ orthogonal_matrix(rng, len(A))
    inverse = np.linalg.inv(T)  # x = T z
    found = solve_riccati(inverse @ A @ T, T.T @ Q @ T, inverse @ S @ inverse.T).X
    back = inverse.T @ found @ inverse
    assert_allclose(back, X, rtol=0, atol=1e-4 * (1 + np.abs(X).max()))


@pytest.mark.parametrize("s", [1.0, -1.0])
@pytest.mark.parametrize("q", 10.0 ** np.arange(-300, -1, 13))
def test_a_vanishing_quadratic_term_loses_no_digits(q, s):
    A = np.array([[-1.0, 0.3], [0.0, -2.0]])
    Q = np.array([[1.0, 0.5], [0.5, 1.0]])
    X = solve_riccati(A, q * Q, s * np.eye(2)).X / q
    # Newton's method on X/q with the small parameter q s, from scratch
    expected = np.zeros((2, 2))
    for _ in range(6):
        closed = A - q * s * expected
        system = np.kron(np.eye(2), closed.T) + np.kron(closed.T, np.eye(2))
        constant = Q + q * s * expected @ expected
        expected = np.linalg.solve(system, -constant.ravel()).reshape(2, 2)
    assert_allclose(X, expected, rtol=1e-9)


@pytest.mark.parametrize(
    "X, error, words",
    [
        ([[-1.0, 0.0], [0.0, -1.0]], 0.0, "does not stabilise"),  # the other root
        ([[3.0, 0.0], [0.0, 2.9]], 0.0, "residual"),
        ([[np.nan, 0.0], [0.0, 3.0]], 0.0, "residual"),
        ([[3.0, 0.0], [0.0, 3.0]], 2e-6, "estimated relative error of 2e-06"),
        ([[3.0, 0.0], [0.0, 3.0]], np.nan, "estimated relative error"),
    ],
)
def test_certificate_refuses_what_is_not_the_stabilising_solution(X, error, words):
    # 2 x + 3 - x^2 = 0 in each of two states: x = 3 stabilises, x = -1 does not
    two = np.eye(2)
    assert_allclose(_certify(two, 3 * two, two, 3 * two, 1e-7), (0.0, 3 / np.sqrt(18), 2.0))
    with pytest.raises(RiccatiError, match=words):
        _certify(two, 3 * two, two, np.array(X), error)
