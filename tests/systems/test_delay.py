"""The delay model against python-control's Pade coefficients, and against the delay itself."""

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_continuous_lyapunov

from robsmooth.systems.delay import pade_delay

ORDERS = range(1, 13)
DELAYS = [1e-9, 3.1e-6, 0.7, 1.0, 20.0, 1e9]
OMEGA_DELAY = np.geomspace(1e-3, 1e3, 61)  # angular frequency times delay


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("delay", DELAYS)
def test_transfer_function_has_the_coefficients_of_control_pade(order, delay):
    # of a unit delay: the coefficients span too many decades in other units
    numerator, denominator = control.pade(1.0, order)
    expected = np.polyval(numerator, 1j * OMEGA_DELAY) / np.polyval(denominator, 1j * OMEGA_DELAY)
    response = pade_delay(delay, order).response(OMEGA_DELAY / delay)[:, 0, 0]
    assert_allclose(response, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("delay", DELAYS)
def test_delay_model_is_all_pass_and_stable(order, delay):
    model = pade_delay(delay, order)
    assert_allclose(np.abs(model.response(OMEGA_DELAY / delay)), 1.0, rtol=1e-12)
    assert np.linalg.eigvals(model.F).real.max() * delay < -0.1


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_error_at_low_frequency_has_the_order_of_a_pade_approximation(order):
    # The error of [N/N] is proportional to s^(2N + 1).
    model = pade_delay(1.0, order)
    error = []
    for omega in np.array([0.5, 0.25]) * order:
        error.append(abs(model.response(omega)[0, 0] - np.exp(-1j * omega)))
    assert error[1] > 1e-13  # above rounding, or the slope says nothing
    assert np.log2(error[0] / error[1]) == pytest.approx(2 * order + 1, abs=0.15)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("delay", DELAYS)
def test_both_gramians_are_the_identity_up_to_the_unit_of_time(order, delay):
    model = pade_delay(delay, order)
    F, G, H = model.F * delay, model.G * delay, model.H
    for gramian in (
        solve_continuous_lyapunov(F, -G @ G.T),
        solve_continuous_lyapunov(F.T, -H.T @ H),
    ):
        assert_allclose(gramian, np.eye(order), rtol=0, atol=1e-11)


@pytest.mark.parametrize("order", ORDERS)
def test_the_relations_stated_for_the_realisation_hold(order):
    delay = 3.1e-6
    model = pade_delay(delay, order)
    b = delay * model.G
    assert_allclose((model.F + model.F.T) * delay, -b @ b.T, rtol=0, atol=1e-12 * order**2)
    assert_allclose(model.H, -model.J * b.T, rtol=1e-14)
    assert_array_equal(model.J, [[(-1.0) ** order]])


@pytest.mark.parametrize("order, delay", [(0, 0.0), (0, 2.0), (3, 0.0)])
def test_no_order_or_no_delay_passes_the_signal_through(order, delay):
    model = pade_delay(delay, order, channels=2)
    assert (model.F.shape, model.G.shape, model.H.shape) == ((0, 0), (0, 2), (2, 0))
    assert (model.delay, model.order) == (delay, order)
    assert_array_equal(model.response([0.0, 5.0]), np.broadcast_to(np.eye(2), (2, 2, 2)))


def test_channels_are_delayed_one_by_one():
    one, three = pade_delay(0.3, 4), pade_delay(0.3, 4, channels=3)
    omega = np.linspace(0, 40, 9)
    expected = one.response(omega) * np.eye(3)
    assert_allclose(three.response(omega), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_a_delay_is_finite_and_not_negative(value):
    with pytest.raises(ValueError, match=r"^delay must"):
        pade_delay(value, 2)


@pytest.mark.parametrize("value", ["1", True, None, 1j, [1.0]])
def test_a_delay_is_a_number(value):
    with pytest.raises(TypeError, match=r"^delay must"):
        pade_delay(value, 2)


@pytest.mark.parametrize("value, error", [(-1, ValueError), (2.0, TypeError), (True, TypeError)])
@pytest.mark.parametrize("name", ["order", "channels"])
def test_order_and_channels_are_integers_and_not_negative(name, value, error):
    with pytest.raises(error, match=f"^{name} must"):
        pade_delay(1.0, **{"order": 2, "channels": 1, name: value})


def test_no_channels_are_refused():
    with pytest.raises(ValueError, match=r"^channels must"):
        pade_delay(1.0, 2, channels=0)
