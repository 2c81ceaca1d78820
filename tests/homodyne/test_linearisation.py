"""Statistical linearisation of the optical loop: its own equations, and the loop with its sine."""

import numpy as np
import pytest

from robsmooth import baselines, error_covariance, statistical_linearisation
from robsmooth.homodyne import PAPER
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.paper import published


@pytest.mark.parametrize("oscillator", ["filtered", "smoothed"])
@pytest.mark.parametrize("name", ["smoother, as printed", "Kalman-Bucy"])
def test_errors_are_those_of_the_plant_with_these_slopes(name, oscillator):
    """By the covariance of plant and estimator, with slopes of its own for detector and copy."""
    design = published.designs()[name]
    found = statistical_linearisation(PAPER, design, oscillator=oscillator)
    P = getattr(found, oscillator)
    if oscillator == "filtered":  # the argument of the sine is the error
        assert found.slopes[0] == pytest.approx(np.exp(-P / 2), rel=1e-12)
    Delta = np.diag([0.0, *(np.array(found.slopes) - PAPER.beta) / PAPER.gamma])
    for output in ("filtered", "smoothed"):
        P = error_covariance(design, Delta, output, loop="real", reference=oscillator)
        assert getattr(found, output) == pytest.approx(P[0, 0], rel=1e-10)


def test_slopes_of_detector_and_copy_belong_to_the_variances_of_their_arguments():
    loop = homodyne_loop(PAPER, published.designs()["smoother, as printed"])
    slopes = loop.equivalent_slopes()
    variances = (loop.arguments @ loop.covariance(*slopes) @ loop.arguments.T).diagonal()
    np.testing.assert_allclose(slopes, np.exp(-0.5 * variances), rtol=1e-9)


def test_a_loop_is_the_same_with_copies_at_the_reference():
    system = PAPER.uncertain_system()
    plain, copies = (
        statistical_linearisation(
            PAPER, baselines.fixed_lag_smoother(system, 3.1e-6, 2, copies=copies)
        )
        for copies in (False, True)
    )
    assert plain.slopes[0] == pytest.approx(copies.slopes[0], rel=1e-12)
    for name in ("filtered", "smoothed"):
        assert getattr(plain, name) == pytest.approx(getattr(copies, name), rel=1e-12)


def test_it_predicts_the_nonlinear_loop():
    # The Kalman filter's loop with the sine itself: e = phi - phi_hat obeys
    # d(phi) = -a phi dt + dV,  d(phi_hat) = -a phi_hat dt + L (sin e dt + sqrt(r) dW).
    a, kappa, r = 9.14e3, 4e4, (2 * 1162.0) ** -2
    L = np.sqrt(a * a + kappa / r) - a
    found = statistical_linearisation(PAPER, baselines.kalman_bucy(PAPER.uncertain_system()))
    rng = np.random.default_rng(7)
    step, runs, steps = 0.02 / L, 4000, 2000
    phi = rng.standard_normal(runs) * np.sqrt(kappa / (2 * a))
    estimate = phi.copy()
    total = np.zeros(runs)
    for index in range(steps):
        noise = rng.standard_normal((2, runs)) * np.sqrt(step)
        rate = L * (np.sin(phi - estimate) * step + np.sqrt(r) * noise[1])
        estimate += -a * estimate * step + rate
        phi += -a * phi * step + np.sqrt(kappa) * noise[0]
        if index >= steps // 4:
            total += (phi - estimate) ** 2
    means = total / (steps - steps // 4)
    error, deviation = means.mean(), means.std() / np.sqrt(runs)
    # Euler's step adds a relative L step / 2 = 1%, of which 1 sigma here is half; the method
    # itself is good to 1%. Four sigma beyond both, at a fixed seed: no false alarms.
    assert abs(error - found.filtered * (1 + L * step / 2)) < 0.01 * error + 4 * deviation
    assert deviation < 0.005 * error
    linear = L * r
    assert found.filtered > 1.03 * linear  # and linear theory would not do
