"""The optical example: its sector by brute force, its channel, its parameters."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robsmooth.homodyne import PAPER, HomodyneParameters

GOOD = dict(lam=9.14e3, kappa=4e4, alpha=1162.0, beta=1.0, gamma=0.4)
GRID = np.linspace(1e-6, math.pi, 400_001)
STEP = GRID[1] - GRID[0]


@pytest.mark.parametrize("name", ["kappa", "alpha", "beta"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 10**400])
def test_rates_and_amplitudes_are_positive_and_finite(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be finite"):
        HomodyneParameters(**{**GOOD, name: value})


@pytest.mark.parametrize("value", [0.0, 1.0, -0.4, 1.4, math.nan])
def test_gamma_lies_between_zero_and_one(value):
    with pytest.raises(ValueError, match=r"^gamma must be finite and in \(0, 1\)"):
        HomodyneParameters(**{**GOOD, "gamma": value})


@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("value", ["1", None, True, 1j, [1.0]])
def test_parameters_are_numbers(name, value):
    with pytest.raises(TypeError, match=f"^{name} must be a real number"):
        HomodyneParameters(**{**GOOD, name: value})


def test_table_1():
    assert HomodyneParameters(**GOOD) == PAPER


def test_system_is_that_of_section_4():
    system = PAPER.uncertain_system()
    noise = 1 / (2 * 1162.0)
    for name, value in {
        "A": [[-9140.0]],
        "B1": [[200.0, 0.0]],
        "C0": [[1.0]],
        "C2": [[1.0]],
        "D21": [[0.0, noise]],
    }.items():
        assert_array_equal(getattr(system, name), value)
    (process,), (sine,) = system.uncertainties, system.nonlinearities
    assert (process.B.item(), process.C.item(), process.D.item()) == (200.0, 0.0, 0.0)
    assert (sine.B.item(), sine.D.item(), sine.lipschitz) == (0.0, noise, 1.0)
    assert sine.C.item() == pytest.approx(929.6, rel=1e-15)


parameters = st.builds(
    HomodyneParameters,
    lam=st.floats(1.0, 1e5),
    kappa=st.floats(1.0, 1e6),
    alpha=st.floats(1.0, 1e4),
    beta=st.floats(0.5, 1.5),
    gamma=st.floats(0.05, 0.95),
)


@given(parameters, st.floats(-3.0, 3.0))
def test_measurement_of_the_system_is_the_homodyne_measurement(p, phase):
    # C2 phi + D psi(C phi) = sin(phi)/beta, with the oscillator at zero.
    system = p.uncertain_system()
    (sine,) = system.nonlinearities
    nu = np.array([sine.C.item() * phase])
    measured = phase + sine.D.item() * sine.function(nu)[0]
    assert measured == pytest.approx(math.sin(phase) / p.beta, rel=1e-9, abs=1e-12)
    assert_allclose(p.remainder(phase), math.sin(phase) - p.beta * phase, rtol=1e-12)


@given(parameters)
def test_channel_is_lipschitz_with_constant_one_just_where_it_is_said_to_be(p):
    reach = p.lipschitz_range
    errors = GRID[::40]
    slope = np.gradient(p.channel(2 * p.alpha * p.gamma * errors), 2 * p.alpha * p.gamma * errors)
    within = np.abs(slope) <= 1 + 1e-4
    beyond = np.flatnonzero(~within)
    found = errors[beyond[0]] if beyond.size else math.pi
    assert reach == pytest.approx(found, abs=0.02)


def test_the_centred_example_ends_where_the_slopes_of_the_sine_do():
    centred = replace(PAPER, beta=0.8, gamma=0.2)
    assert centred.sector_range() == pytest.approx(PAPER.sector_range())  # of chords, 1.66 rad
    assert centred.lipschitz_range == pytest.approx(math.acos(0.6))  # of slopes, 0.927 rad


@pytest.mark.parametrize("slope", [None, 0.05, 0.2, 0.6, 0.99])
def test_sector_range_is_the_largest_error_above_the_line(slope):
    edge = PAPER.lower_slope if slope is None else slope
    inside = np.sin(GRID) >= edge * GRID
    found = GRID[np.flatnonzero(inside)[-1]]
    assert inside[: np.flatnonzero(inside)[-1]].all()
    assert PAPER.sector_range(slope) == pytest.approx(found, abs=2 * STEP)


def test_lipschitz_range_by_brute_force():
    inside = np.abs(np.cos(GRID) - 1.0) <= 0.4
    assert PAPER.lipschitz_range == pytest.approx(GRID[np.flatnonzero(inside)[-1]], abs=2 * STEP)
    assert PAPER.lipschitz_range < PAPER.sector_range()
    steep = HomodyneParameters(**{**GOOD, "beta": 1.5})
    assert steep.lipschitz_range == 0.0  # |cos 0 - 1.5| > 0.4


@pytest.mark.parametrize(
    ("slope", "reach"), [(1.0, 0.0), (1.5, 0.0), (0.0, math.pi), (-0.1, math.pi)]
)
def test_a_sector_that_never_or_always_holds_has_a_range_all_the_same(slope, reach):
    assert PAPER.sector_range(slope) == reach


def test_a_tangent_too_flat_for_the_sector_has_no_range():
    flat = HomodyneParameters(lam=1.0, kappa=1.0, alpha=1.0, beta=0.5, gamma=0.3)
    assert flat.sector_range() == 0.0


def test_the_slope_of_a_sector_is_a_finite_number():
    with pytest.raises(ValueError, match=r"^slope must"):
        PAPER.sector_range(math.nan)


def test_slopes_of_the_sector():
    assert PAPER.sector_slope == pytest.approx(1 - 2 * 0.4)
    assert PAPER.lower_slope == pytest.approx(0.6)
    assert (1 - PAPER.sector_slope) / 2 == pytest.approx(PAPER.gamma)
