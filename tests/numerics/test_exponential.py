"""What a linear system does in a step: against quadrature, and closed forms over many decades."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad_vec
from scipy.linalg import expm

from robsmooth._numerics.steps import responses
from tests.helpers.strategies import seeds, stable_matrix


@settings(max_examples=15)
@given(seeds, st.integers(1, 5), st.floats(1e-3, 10.0))
def test_responses_are_the_integrals_of_the_exponential(seed, n, step):
    rng = np.random.default_rng(seed)
    A, B = stable_matrix(rng, n), rng.standard_normal((n, 2))
    transition, held, ramp = responses(A, B, step)
    assert_allclose(transition, expm(A * step), rtol=0, atol=1e-12)
    expected, _ = quad_vec(lambda s: expm(A * s) @ B, 0.0, step)
    assert_allclose(held, expected, rtol=1e-8, atol=1e-10)
    expected, _ = quad_vec(lambda s: (1 - s / step) * expm(A * s) @ B, 0.0, step)
    assert_allclose(ramp, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("ratio", 10.0 ** np.arange(-9, 10, 3))
@pytest.mark.parametrize("rate", [1e-9, 1.0, 1e9])
def test_one_state_has_its_closed_form_for_any_step(rate, ratio):
    transition, held, ramp = responses(np.array([[-rate]]), np.array([[rate]]), ratio / rate)
    assert transition[0, 0] == pytest.approx(np.exp(-ratio), rel=1e-13, abs=1e-15)
    assert held[0, 0] == pytest.approx(-np.expm1(-ratio), rel=1e-13)
    if ratio > 1e-2:
        assert ramp[0, 0] == pytest.approx(1.0 + np.expm1(-ratio) / ratio, rel=1e-12)
    else:  # by its series, because of the cancellation
        assert ramp[0, 0] == pytest.approx(ratio / 2 - ratio**2 / 6 + ratio**3 / 24, rel=1e-8)
