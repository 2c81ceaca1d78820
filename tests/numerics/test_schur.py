"""The real Schur form: its poles and order, and its Lyapunov equations by an independent route."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import LinAlgError, solve_continuous_lyapunov

from robsmooth._numerics.schur import SchurForm

matrices = st.tuples(st.integers(0, 10**6), st.integers(1, 9), st.floats(-1.0, 2.0))


def random_matrix(seed, n, decay):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n, n)) - decay * np.sqrt(n) * np.eye(n), rng


def in_order(poles):
    return np.sort_complex(np.round(poles, 9))


@given(matrices)
def test_the_poles_are_the_eigenvalues_and_the_stable_ones_are_first_if_asked_for(of):
    A, _ = random_matrix(*of)
    expected = np.linalg.eigvals(A)
    assert_allclose(in_order(SchurForm(A).poles), in_order(expected), atol=1e-8)
    form = SchurForm(A, stable_first=True)
    assert_allclose(in_order(form.poles), in_order(expected), atol=1e-8)
    assert form.stable == (expected.real < 0.0).sum()
    assert (form.poles.real[: form.stable] < 0.0).all()
    assert (form.poles.real[form.stable :] >= 0.0).all()
    # its first columns span the subspace of the stable modes
    stable = form.U[:, : form.stable]
    assert_allclose(stable @ (stable.T @ A @ stable), A @ stable, atol=1e-9 * np.linalg.norm(A))


@given(matrices)
def test_lyapunov_equations_of_a_matrix_and_its_transpose_are_solved(of):
    A, rng = random_matrix(*of)
    poles = np.linalg.eigvals(A)
    gap = np.abs(np.add.outer(poles, poles)).min()
    if gap < 1e-3:  # the equation is hardly solvable
        return
    root = rng.standard_normal(A.shape)
    Q, form = root @ root.T, SchurForm(A)
    for transposed, drift in ((False, A), (True, A.T)):
        found, expected = form.lyapunov(Q, transposed), solve_continuous_lyapunov(drift, -Q)
        assert_allclose(found, expected, atol=1e-8 * np.linalg.norm(expected) / gap)


def test_a_matrix_that_is_not_finite_is_refused():
    with pytest.raises(LinAlgError, match="not finite"):
        SchurForm(np.array([[1.0, np.nan], [0.0, 1.0]]))
