"""The ready systems, against what is known of them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import robsmooth as rs


@pytest.mark.parametrize(("diffusion", "noise"), [(1.0, 1.0), (4.0, 0.1)])
def test_the_filter_of_a_random_walk_has_its_known_error(diffusion, noise):
    system = rs.examples.random_walk(diffusion, noise)
    kalman = rs.baselines.kalman_bucy(system)
    expected = np.sqrt(diffusion) * noise
    assert_allclose(rs.error_covariance(kalman, np.zeros((0, 0)), "filtered"), expected)


def test_the_filter_of_a_clock_has_its_known_poles():
    # s^4 - (q1/r) s^2 + q2/r = 0, of Wiener's spectral factor
    kalman = rs.baselines.kalman_bucy(rs.examples.clock(0.3, 0.02, 0.5))
    r = 0.5**2
    expected = np.roots([1, 0, -0.3 / r, 0, 0.02 / r])
    found = np.sort_complex(kalman.poles)
    assert_allclose(found, np.sort_complex(expected[expected.real < 0]), rtol=1e-9)


def test_a_resonant_phase_has_its_variance_and_its_uncertain_frequency():
    system = rs.examples.resonant_phase(frequency=50.0, damping=0.1, rms=0.3, uncertainty=0.05)
    plant = rs.augment(system, 0.0, 0)
    nothing = rs.Estimator(
        plant=plant,
        A_c=-np.eye(1),
        B_c=np.zeros((1, 1)),
        **{name: np.zeros((1, 1)) for name in ("C_c", "C_a", "C_f")},
    )
    Delta = plant.structured_delta([0.0])
    assert_allclose(rs.error_covariance(nothing, Delta, "filtered"), 0.3**2)
    (u,) = system.uncertainties
    omega = np.abs(np.linalg.eigvals(system.A + u.B @ u.C))
    # the stiffness changes by twice what the frequency does
    assert_allclose(omega, 2 * np.pi * 50.0 * np.sqrt(1 - 2 * 0.05), rtol=1e-12)


def test_wrong_numbers_are_refused():
    for make in (rs.examples.random_walk, rs.examples.clock, rs.examples.resonant_phase):
        with pytest.raises(ValueError, match="noise must be finite and in"):
            make(noise=0.0)
