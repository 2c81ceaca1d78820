"""Covariances and their roots by doubling: against scipy, closed forms and exact arithmetic."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm, solve_continuous_lyapunov

from robsmooth import UnstableLoopError
from robsmooth._numerics.lyapunov import (
    check_certainty,
    covariances,
    noise_root,
    square_root,
    stationary_root,
)
from tests.helpers.rational import exact_covariance, exact_noise
from tests.helpers.strategies import orthogonal_matrix, seeds, stable_matrix


def random_data(seed, n):
    rng = np.random.default_rng(seed)
    return stable_matrix(rng, n), rng.standard_normal((n, 1 + n // 2))


problems = st.tuples(seeds, st.integers(1, 6)).map(lambda drawn: random_data(*drawn))


@given(problems)
def test_stationary_covariance_solves_lyapunovs_equation(problem):
    A, B = problem
    P = covariances(A, B).stationary
    expected = solve_continuous_lyapunov(A, -B @ B.T)
    assert_array_equal(P, P.T)
    assert_allclose(P, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@given(problems, st.floats(-4, 2))
def test_growth_and_transition_are_those_of_the_span(problem, exponent):
    A, B = problem
    span = 10.0**exponent
    found = covariances(A, B, span)
    E = expm(A * span)
    assert_allclose(found.transition, E, rtol=0, atol=1e-11 * max(1.0, np.abs(E).max()))
    P = found.stationary
    assert_allclose(found.grown, P - E @ P @ E.T, rtol=0, atol=1e-11 * np.abs(P).max())
    assert_allclose(P, covariances(A, B).stationary, rtol=0, atol=1e-13 * np.abs(P).max())


@pytest.mark.parametrize("span", 10.0 ** np.arange(-12, 13, 3))
@pytest.mark.parametrize("rate", [1e-9, 1.0, 1e9])
def test_one_state_has_its_closed_form_for_any_span(rate, span):
    found = covariances(np.array([[-rate]]), np.array([[np.sqrt(2.0)]]), span / rate)
    assert found.stationary[0, 0] * rate == pytest.approx(1.0, rel=1e-14)
    assert found.grown[0, 0] * rate == pytest.approx(-np.expm1(-2.0 * span), rel=1e-13)
    # a transition next to nothing is rounding, of the one that it started as
    assert found.transition[0, 0] == pytest.approx(np.exp(-span), rel=1e-13, abs=1e-15)


@pytest.mark.parametrize("fast", [1.0, 1e6, 1e12])
def test_a_slow_state_behind_a_fast_one_keeps_its_digits(fast):
    # the fast one is driven by noise, the slow one by it: P by substitution, from the top
    A, B = np.array([[-fast, 0.0], [fast, -1e-3]]), np.array([[np.sqrt(fast)], [0.0]])
    first = 0.5
    second = fast * first / (fast + 1e-3)
    third = fast * second / 1e-3
    expected = [[first, second], [second, third]]
    assert_allclose(covariances(A, B).stationary, expected, rtol=1e-13)


def test_many_systems_at_once_are_each_of_them():
    A, B = (np.array(several) for several in zip(*(random_data(i, 4) for i in range(5))))  # noqa: B905
    together = covariances(A, B, 0.3)
    for i in range(5):
        alone = covariances(A[i], B[i], 0.3)
        for name in ("stationary", "grown", "transition"):
            assert_allclose(getattr(together, name)[i], getattr(alone, name), rtol=0, atol=1e-12)


@given(problems, st.integers(-60, 60), seeds)
def test_units_change_rounding_only(problem, time, seed):
    A, B = problem
    t = 2.0**time
    units = 2.0 ** np.random.default_rng(seed).integers(-40, 40, len(A))
    other = A * t * units[:, None] / units, B * np.sqrt(t) * units[:, None]
    deviations = np.sqrt(np.diag(covariances(A, B).stationary))
    for span in (0.0, 0.5):
        plain, scaled = covariances(A, B, span), covariances(*other, span / t)
        for name in ("stationary", "grown"):
            found = getattr(scaled, name) / np.outer(units, units)
            error = (found - getattr(plain, name)) / np.outer(deviations, deviations)
            assert np.abs(error).max() < 1e-12


def test_what_nothing_drives_has_no_variance():
    A = np.array([[-1.0, 0.5, 0.0], [0.0, -2.0, 0.0], [0.3, 0.0, -1.0]])
    P = covariances(A, np.eye(3, 1), 0.2).stationary
    assert_array_equal(P[1], 0.0)
    assert P[2, 2] > 0.0
    for q in (0, 3):
        assert_array_equal(covariances(A, np.zeros((3, q)), 0.2).grown, 0.0)
    assert stationary_root(np.zeros((0, 0)), np.zeros((0, 2))).shape == (0, 0)


@pytest.mark.parametrize(
    "A",
    [
        [[1e-6]],
        [[0.0]],
        [[-1.0, 0.0], [0.0, 0.3]],  # no noise drives what is unstable
        [[0.1, 1.0], [-1.0, 0.1]],
    ],
)
def test_what_is_not_stable_is_refused(A):
    A = np.array(A)
    B = np.eye(len(A), 1)
    for span in (0.0, 1.0):
        with pytest.raises(UnstableLoopError, match="is not stable"):
            covariances(A, B, span)
    with pytest.raises(UnstableLoopError, match="is not stable"):
        stationary_root(A, B)


@pytest.mark.parametrize("rate", [0.3, 1.0, 7.0])
def test_an_oscillator_that_only_rounding_damps_is_not_certain(rate):
    A, B = np.array([[0.0, rate], [-rate, 0.0]]), np.eye(2)
    with pytest.raises((UnstableLoopError, ArithmeticError)):
        found = covariances(A, B)
        check_certainty("it", found.stationary, found.error)


@given(seeds, st.integers(1, 3), st.floats(0, 9), st.floats(-6, 6))
def test_estimated_error_is_not_below_the_true_one(seed, n, decades, noise):
    """Against the exact covariance of the same floats, with time constants decades apart."""
    rng = np.random.default_rng(seed)
    T = orthogonal_matrix(rng, n)
    A = T @ np.diag(-(10.0 ** rng.uniform(-decades, 0, n))) @ T.T
    B = 10.0**noise * rng.standard_normal((n, 1))
    found = covariances(A, B)
    exact = exact_covariance(A, B @ B.T)
    variances = np.diag(exact)
    true = np.abs(np.diag(found.stationary) - variances) / variances
    estimated = np.abs(np.diag(found.error)) / variances
    assert (true <= 30 * estimated + 1e-13).all()


def test_certainty_is_checked_variance_by_variance():
    P = np.diag([1.0, 1e-8])
    check_certainty("it", P, 0.9e-6 * P)
    check_certainty("it", np.zeros((2, 2)), np.zeros((2, 2)))
    with pytest.raises(ArithmeticError, match=r"^it is lost .* of 1e-08 has .* of 1e-10"):
        check_certainty("it", P, 1e-10 * np.eye(2))
    with pytest.raises(ArithmeticError):
        check_certainty("it", P, np.full((2, 2), np.nan))


@given(seeds, st.integers(1, 5), st.integers(1, 5))
def test_square_root_is_one_in_any_units(seed, n, rank):
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-30, 30, n)
    G = rng.standard_normal((n, rank)) * units[:, None]
    P = G @ G.T
    L = square_root(P)
    assert np.abs((L @ L.T - P) / np.outer(units, units)).max() < 1e-13 * n * rank
    assert_array_equal(square_root(np.zeros((n, n))), 0.0)


# --- roots ----------------------------------------------------------------------------------------


@given(problems, st.floats(-4, 2))
def test_roots_are_those_of_the_covariances(problem, exponent):
    A, B = problem
    span = 10.0**exponent
    found = covariances(A, B, span)
    for root, W in (
        (stationary_root(A, B), found.stationary),
        (noise_root(A, B, span), found.grown),
    ):
        assert_array_equal(root, np.tril(root))
        assert (np.diag(root) >= 0.0).all()
        size = np.sqrt(np.diag(W))
        assert np.abs((root @ root.T - W) / np.outer(size, size)).max() < 1e-13


@given(seeds, st.integers(1, 4), st.floats(0.1, 6), st.floats(-9, 9))
def test_noise_over_a_step_is_that_of_exact_arithmetic(seed, n, decades, exponent):
    """States behind each other, at rates decades apart, over a step of any length."""
    rng = np.random.default_rng(seed)
    rates = 10.0 ** rng.uniform(-decades, decades, n)
    units = 2.0 ** rng.integers(-40, 40, n)
    coupling = np.sqrt(np.outer(rates, rates)) * rng.standard_normal((n, n))
    A = (np.tril(coupling, -1) - np.diag(rates)) * units[:, None] / units
    B = np.sqrt(rates)[:, None] * rng.standard_normal((n, 2)) * units[:, None]
    span = 10.0**exponent
    W = exact_noise(A, B, span)
    root = noise_root(A, B, span)
    size = np.sqrt(np.diag(W))
    assert np.abs((root @ root.T - W) / np.outer(size, size)).max() < 1e-12


@given(seeds)
def test_noise_over_a_step_of_a_system_without_a_stationary_state(seed):
    # a state, its integral, and that one's: W by the integral of the polynomials
    rng = np.random.default_rng(seed)
    step = 10.0 ** rng.uniform(-9, 9)
    root = noise_root(np.eye(3, k=-1), np.eye(3, 1), step)
    powers = np.arange(3)
    factorials = np.array([1.0, 1.0, 2.0])
    exponents = 1 + powers[:, None] + powers
    expected = step**exponents / (exponents * np.outer(factorials, factorials))
    assert_allclose(root @ root.T, expected, rtol=1e-13)


@pytest.mark.parametrize("fast", [2.0, 1e3, 1e6, 1e9])
def test_a_slow_state_that_a_fast_one_drives_keeps_its_digits_over_a_step(fast):
    A, B = np.array([[-fast, 0.0], [1.0, -1.0]]), np.eye(2)
    root = noise_root(A, B, 0.5)
    assert_allclose(root @ root.T, exact_noise(A, B, 0.5), rtol=1e-13)
