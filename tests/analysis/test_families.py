"""The families of systems: their units, their uncertainties and noises, and the map of ratios."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robsmooth._numerics.lyapunov import covariances
from robsmooth.analysis.choice import judge
from robsmooth.analysis.families import (
    ORDER,
    robustness_map,
    uncertain_cancellation,
    uncertain_gain,
    uncertain_reference,
    uncertain_resonance,
)
from robsmooth.analysis.lag import best_lag
from robsmooth.estimators.baselines import fixed_lag_smoother
from robsmooth.estimators.minimax import minimax_smoother
from robsmooth.systems.augmented import augment

ALL = [uncertain_gain, uncertain_resonance, uncertain_reference, uncertain_cancellation]


def channel(size, noise, family):
    """The one uncertainty of a family's system."""
    (found,) = family(size, noise).uncertainties
    return found


@pytest.mark.parametrize("family", ALL)
def test_the_signal_has_unit_variance(family):
    system = family(0.1, 0.05)
    stationary = covariances(system.A, system.B1).stationary
    assert_allclose(system.C0 @ stationary @ system.C0.T, [[1.0]], rtol=1e-12)


@pytest.mark.parametrize("family", ALL)
def test_the_noise_is_the_root_of_every_measurements_intensity_and_no_process_noise(family):
    once, twice = (family(0.1, noise) for noise in (0.05, 0.1))
    assert_allclose(once.D21 @ once.D21.T, 0.05**2 * np.eye(once.l))
    assert_allclose(once.B1 @ once.D21.T, 0.0, atol=1e-15)
    assert_allclose(twice.D21, 2.0 * once.D21)
    assert_array_equal(twice.B1, once.B1)


@pytest.mark.parametrize("family", ALL)
def test_the_size_is_the_argument_of_one_uncertainty(family):
    once, twice = (channel(size, 0.05, family) for size in (0.1, 0.2))
    assert_allclose(twice.C, 2.0 * once.C)
    assert_array_equal(twice.B, once.B)
    assert_array_equal(twice.D, once.D)
    for name in ("A", "B1", "C0", "C2", "D21"):
        nothing, much = (getattr(family(size, 0.05), name) for size in (0.0, 0.5))
        assert_array_equal(nothing, much)


def test_the_uncertainties_are_where_their_families_say():
    gain = channel(0.1, 0.05, uncertain_gain)  # of the measurement of the signal
    assert not gain.B.any()
    assert_allclose(gain.D @ gain.C, 0.1 * uncertain_gain(0.1, 0.05).C2)
    detuning = channel(0.1, 0.05, uncertain_resonance)  # of the squared frequency, 1
    assert_allclose(detuning.B @ detuning.C, [[0.0, 0.0], [0.1, 0.0]])
    assert not detuning.D.any()
    reference = channel(0.1, 0.05, uncertain_reference)  # of the second sensor
    assert not reference.B.any()
    assert_allclose(reference.D @ reference.C, [[0.0, 0.0], 0.1 * np.array([0.0, 1.0])])
    drive = channel(0.1, 0.05, uncertain_cancellation)  # of what drives the signal, -1
    assert_allclose(drive.B @ drive.C, [[0.0, 0.1], [0.0, 0.0]])
    assert not drive.D.any()


def test_the_resonance_has_quality_ten_and_the_disturbance_ten_times_the_signal():
    system = uncertain_resonance(0.1, 0.05)
    frequency, decay = np.sqrt(-system.A[1, 0]), -system.A[1, 1]
    assert_allclose(frequency / decay, 10.0)
    reference = uncertain_reference(0.1, 0.05)
    stationary = covariances(reference.A, reference.B1).stationary
    assert_allclose(stationary, np.diag([1.0, 100.0]), atol=1e-12)


@pytest.mark.parametrize("family", ALL)
def test_little_uncertainty_makes_no_difference(family):
    assert_allclose(robustness_map(family, [1e-4], [0.05]), [[1.0]], rtol=1e-3)


def test_a_map_has_the_ratios_of_the_certified_errors_by_noise_and_size(terminal):
    sizes, noises = [0.02, 0.1, 0.9], [0.5, 0.05]
    found = robustness_map(uncertain_cancellation, sizes, noises)
    assert terminal.readouterr().err == ""
    # an uncertainty of nine tenths could destabilise the plant
    assert_array_equal(np.isnan(found), [[False, False, True]] * 2)
    system = uncertain_cancellation(0.1, 0.05)
    delay, least = best_lag(system, ORDER)
    assert least < judge(fixed_lag_smoother(system, delay, ORDER), "filtered").nominal
    classical = judge(fixed_lag_smoother(system, delay, ORDER)).certified
    robust = judge(minimax_smoother(augment(system, delay, ORDER))).certified
    assert_allclose(found[1, 1], classical / robust, rtol=1e-9)
    assert found[1, 1] > 2.0  # a difference of signals, where robustness pays
    # it pays more, the larger the uncertainty and the smaller the noise
    assert found[1, 1] > found[1, 0] > 1.1 and (np.diff(found[:, :2], axis=0) > 0.1).all()
    # with much noise and a coarse model of the delay nothing is gained, or little is lost
    assert (found[0, :2] > 0.99).all()
    shown = robustness_map(uncertain_cancellation, sizes[:1], noises, progress=True)
    assert "2/2" in terminal.readouterr().err
    assert_array_equal(shown, found[:, :1])
