"""Sectors that are not centred: found for a function, and centred in a system."""

import copy
import dataclasses
import math
import pickle

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import robsmooth as rs
from tests.systems.test_system import raises

CURVES = {  # the function, its derivative, and whether that falls from one at zero
    "sin": (np.sin, np.cos),
    "tanh": (np.tanh, lambda x: np.cosh(x) ** -2.0),
    "arctan": (np.arctan, lambda x: 1.0 / (1.0 + np.square(x))),
}
DIGITS = 1e-9
A, B1, C0, C2, D21 = (
    [[-1.0, 2.0], [0.0, -3.0]],
    np.eye(2, 3),
    [[1.0, 0.0]],
    [[0.5, 0.0]],
    [[0, 0, 1]],
)
CHANNEL = dict(B=[[0.0], [2.0]], C=[[1.0, -1.0]], D=[[0.5]])
STEERED = dict(B=[[0.0], [0.0]], C=[[1.0, -1.0]], D=[[0.5]])


def system_of(*nonlinearities):
    return rs.UncertainSystem(A, B1, C0, C2, D21, nonlinearities=nonlinearities)


def hardening(x):
    return x + np.power(x, 3)


@numba.njit
def compiled(x):
    return math.sin(x) if x > -1.0 else x * math.sin(1.0)


# --- the slopes of a function ---------------------------------------------------------------------


@pytest.mark.parametrize("reach", [0.01, 0.6, np.float32(1.2), np.int64(3), np.array(2.5)])
@pytest.mark.parametrize("name", CURVES)
def test_slopes_of_an_odd_curve_are_between_its_end_and_one(name, reach):
    f, derivative = CURVES[name]
    found, end = rs.sector(f, reach), float(reach)
    assert_allclose([found.lower, found.upper], [derivative(end), 1.0], atol=DIGITS)
    assert isinstance(found.reach, float)
    assert (found.reach, found.function) == (end, f)


def test_slopes_are_least_and_largest_where_the_function_turns_within_the_reach():
    assert rs.sector(np.sin, 6.0).lower == pytest.approx(-1.0, abs=DIGITS)  # at pi


def test_the_sine_of_the_example_has_slopes_above_three_fifths_up_to_its_range_of_slopes():
    found = rs.sector(np.sin, math.acos(0.6))
    assert_allclose([found.slope, found.half_width], [0.8, 0.2], atol=DIGITS)


@pytest.mark.parametrize(
    ("f", "slopes"),
    [
        (np.expm1, (math.exp(-2), math.exp(2))),
        (lambda x: x + x**2, (-3.0, 5.0)),
        (lambda x: x**2 - 3 * x, (-7.0, 1.0)),
        (hardening, (1.0, 13.0)),
        (lambda x: np.clip(x, -0.5, 0.75), (0.0, 1.0)),
        (lambda x: np.maximum(x, 0.0), (0.0, 1.0)),
        (lambda x: x + np.abs(x - 1) - 1, (0.0, 2.0)),
    ],
    ids=["exponential", "parabola", "falling", "cubic", "limits", "half", "corner"],
)
def test_slopes_of_curves_that_are_not_odd_or_have_corners(f, slopes):
    found = rs.sector(f, 2.0)
    assert_allclose([found.lower, found.upper], slopes, rtol=DIGITS, atol=DIGITS)


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_the_slopes_are_free_of_units(length, height):
    found = rs.sector(lambda x: height * np.sin(x / length), 1.2 * length)
    unit = height / length
    assert_allclose([found.lower, found.upper], [unit * math.cos(1.2), unit], rtol=10 * DIGITS)


def test_what_is_left_of_the_function_has_slopes_of_at_most_half_the_width():
    found, x = rs.sector(np.tanh, 0.6), np.linspace(-0.6, 0.6, 1001)
    slopes = np.diff(np.tanh(x) - found.slope * x) / np.diff(x)
    assert_allclose([slopes.min(), slopes.max()], [-found.half_width, found.half_width], rtol=1e-2)
    assert found.half_width == pytest.approx(0.5 * (1.0 - math.cosh(0.6) ** -2), abs=DIGITS)


@pytest.mark.parametrize(
    ("f", "reach", "error", "words"),
    [
        (math.sin, 1.0, ValueError, "function must be vectorised"),
        (3.0, 1.0, TypeError, "function must be callable"),
        (np.cos, 1.0, ValueError, r"function must be zero at zero, got 1\.0"),
        (np.sin, 0.0, ValueError, "reach must be finite and in"),
        (np.sin, -1.0, ValueError, "reach"),
        (np.sin, np.nan, ValueError, "reach"),
        (np.sin, "1", TypeError, "reach must be a real number"),
        (np.log1p, 2.0, ValueError, r"function must be finite, got nan at -2"),
        (np.arctanh, 1.0, ValueError, r"function must be finite, got -inf at -1"),
        (lambda x: 2 * x, 1.0, ValueError, r"function must not be linear.* slope 2, .*A and C2"),
        (np.zeros_like, 1.0, ValueError, "function must not be linear"),
        (np.sign, 1.0, ValueError, "function must have slopes within bounds"),
        (np.cbrt, 1.0, ValueError, "function must have slopes within bounds.*near -?0.000"),
        (lambda x: np.sign(x) * np.sqrt(np.abs(x)), 1.0, ValueError, "slopes within bounds"),
    ],
)
def test_a_function_without_a_sector_is_one_error(f, reach, error, words):
    with raises(error, words):
        rs.sector(f, reach)


# --- the nonlinearity that is made of it ----------------------------------------------------------


@pytest.mark.parametrize("f", [np.tanh, compiled, hardening, np.expm1])
@pytest.mark.parametrize("reach", [0.3, 1.5])
def test_a_made_nonlinearity_is_the_function_in_a_scaled_channel(f, reach):
    found = rs.sector(f, reach)
    made = found.nonlinearity(**CHANNEL, noise=0.01)
    for x in np.random.default_rng(1).uniform(-reach / 2, reach / 2, (20, 2, 1)):
        value = f((CHANNEL["C"] @ x).item())
        mu = made.function((made.C @ x).item())
        assert_allclose(made.B * mu, np.multiply(CHANNEL["B"], value), rtol=1e-9, atol=1e-12)
        assert_allclose(made.D * mu, np.multiply(CHANNEL["D"], value), rtol=1e-9, atol=1e-12)
    assert_allclose(made.B, np.multiply(CHANNEL["B"], 0.01))
    (kept,) = system_of(made).nonlinearities
    assert kept.lipschitz == pytest.approx(1.0, rel=1e-12)
    nu = np.linspace(-reach, reach, 999) * found.half_width / 0.01
    at = [kept.function(value) for value in nu]
    slopes = np.diff(at) / np.diff(nu)
    assert_allclose([slopes.min(), slopes.max()], [-1.0, 1.0], rtol=0.02)


def test_the_noise_of_a_made_nonlinearity_has_weight_one():
    noise = 0.02
    made = rs.sector(np.sin, 1.0).nonlinearity([[0.0]], [[1.0]], [[1.0]], noise=noise)
    process = rs.Uncertainty([[1.0]], [[0.0]], [[0.0]])
    system = rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[0]], [[0, noise]], [process], [made])
    J = rs.augment(system, 0.0, 0).J
    assert_allclose(J[:2, :2], np.eye(2), atol=1e-12)


def test_what_a_made_nonlinearity_is_made_of_is_checked():
    found = rs.sector(np.sin, 1.0)
    with raises(ValueError, "noise must be finite"):
        found.nonlinearity(**CHANNEL, noise=0.0)
    with raises(ValueError, "Nonlinearity B must have 2 dimension"):
        found.nonlinearity(**{**CHANNEL, "B": [1.0, 2.0]})


def test_functions_made_of_a_compiled_one_are_compiled():
    found = rs.sector(compiled, 0.9)
    made = found.nonlinearity(**CHANNEL)
    (kept,) = system_of(made).nonlinearities
    for function in (made.function, kept.function):
        assert isinstance(function, numba.core.dispatcher.Dispatcher)
        assert isinstance(pickle.loads(pickle.dumps(function))(0.5), float)
    of_kept = math.sin(0.5) - 0.5 * found.slope
    assert kept.function(0.5 * found.half_width) == pytest.approx(of_kept, rel=1e-14)


@pytest.mark.parametrize("f", [np.sin, compiled])
def test_functions_made_of_one_tell_what_they_are(f):
    made = rs.sector(f, 0.9).nonlinearity(**CHANNEL, noise=0.5)
    (kept,) = system_of(made).nonlinearities
    argument, slope = 0.5 / rs.sector(f, 0.9).half_width, sum(made.sector) / 2
    assert made.function.__name__ == f"2 {f.__name__}({argument:.6g} nu)"
    assert kept.function.__name__ == f"{made.function.__name__} - {slope:.6g} nu"


# --- in a system ----------------------------------------------------------------------------------


slope = st.floats(-5.0, 5.0)


@given(st.tuples(slope, slope).filter(lambda s: abs(s[0] - s[1]) > 1e-3), st.integers(0, 99))
def test_a_centred_system_is_the_given_one(slopes, seed):
    lower, upper = sorted(slopes)

    def f(nu):
        return (lower + upper) / 2 * nu + (upper - lower) / 2 * np.sin(nu)

    given_channel = rs.Nonlinearity(**CHANNEL, function=f, sector=(lower, upper))
    assert given_channel.lipschitz == max(-lower, upper)
    system = system_of(given_channel)
    (kept,) = system.nonlinearities
    assert kept.sector is None
    assert kept.lipschitz == pytest.approx((upper - lower) / 2)
    x = np.random.default_rng(seed).normal(size=(2, 1))
    nu = (CHANNEL["C"] @ x).item()
    for linear, now, channel in ((A, system.A, "B"), (C2, system.C2, "D")):
        wanted = np.array(linear) @ x + np.multiply(CHANNEL[channel], f(nu))
        assert_allclose(now @ x + getattr(kept, channel) * kept.function(nu), wanted, atol=1e-12)


def test_a_sector_around_zero_is_a_lipschitz_constant():
    system = system_of(rs.Nonlinearity(**CHANNEL, function=np.sin, sector=(-1, 1)))
    (kept,) = system.nonlinearities
    assert (kept.lipschitz, kept.function, kept.sector) == (1.0, np.sin, None)
    assert_array_equal(system.A, A)


def test_a_function_is_needed_by_no_sector():
    (kept,) = system_of(rs.Nonlinearity(**CHANNEL, sector=(0.2, 1.0))).nonlinearities
    assert (kept.function, kept.lipschitz) == (None, 0.4)


@pytest.mark.parametrize("f", [np.tanh, compiled])
def test_copies_of_a_system_are_not_centred_again(f, tmp_path):
    made = rs.sector(f, 0.9).nonlinearity(**CHANNEL)
    system = system_of(made, made, dataclasses.replace(made, D=[[0.0]]))
    rs.save(system, tmp_path / "system.toml")
    functions = {system.nonlinearities[0].function.__name__: system.nonlinearities[0].function}
    for again in (
        copy.copy(system),
        copy.deepcopy(system),
        pickle.loads(pickle.dumps(system)),
        dataclasses.replace(system, C0=[[0.0, 1.0]]),
        rs.load(tmp_path / "system.toml", functions=functions),
    ):
        assert_array_equal(again.A, system.A)
        assert_array_equal(again.C2, system.C2)
        for one, other in zip(again.nonlinearities, system.nonlinearities, strict=True):
            assert one.lipschitz == other.lipschitz
            assert one.function(0.3) == other.function(0.3)


def test_the_paper_s_example_is_that_of_a_sector_of_the_sine():
    p = rs.homodyne.PAPER
    scale, system = 2 * p.alpha * p.gamma, p.uncertain_system()
    (sine,) = system.nonlinearities
    nonlinearity = rs.Nonlinearity(
        sine.B,
        sine.C,
        sine.D,
        function=lambda nu: 2 * p.alpha * np.sin(nu / scale),
        reference="filtered",
        sector=((p.beta - p.gamma) / p.gamma, (p.beta + p.gamma) / p.gamma),
    )
    same = dataclasses.replace(system, C2=[[0.0]], nonlinearities=[nonlinearity])
    assert_allclose(same.C2, system.C2, rtol=1e-14)
    assert same.nonlinearities[0].lipschitz == pytest.approx(1.0, rel=1e-14)
    nu = np.linspace(-scale, scale, 99)
    values = [each.nonlinearities[0].function(nu) for each in (same, system)]
    assert_allclose(*values, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("given_slopes", "error", "words"),
    [
        ({}, TypeError, "lipschitz"),
        ({"lipschitz": 2.0, "sector": (0.0, 1.0)}, TypeError, "lipschitz or a sector, got both"),
        ({"sector": (1.0, 1.0)}, ValueError, r"sector must be two slopes.*got \(1\.0, 1\.0\)"),
        ({"sector": (1.0, 0.5)}, ValueError, "sector must be two slopes"),
        ({"sector": (0.0, 0.5, 1.0)}, ValueError, "sector must be two slopes"),
        ({"sector": 1.0}, ValueError, "sector must have 1 dimension"),
        ({"sector": (0.0, np.inf)}, ValueError, "sector must be finite"),
        ({"sector": ("a", "b")}, TypeError, "sector must be an array of numbers"),
        (
            {"sector": (0.0, 1.0), "reference": "filtered"},
            ValueError,
            "sector must be around zero.*reference.*give lipschitz instead",
        ),
    ],
)
def test_slopes_are_given_once_and_fit(given_slopes, error, words):
    with raises(error, "Nonlinearity", words):
        rs.Nonlinearity(**CHANNEL, **given_slopes)


def test_a_reference_goes_with_a_sector_in_the_measurement_and_with_one_around_zero():
    steered = rs.Nonlinearity(**STEERED, sector=(0.6, 1.0), reference="filtered")
    (kept,) = system_of(steered).nonlinearities
    assert kept.reference == "filtered"
    around = rs.Nonlinearity(**CHANNEL, sector=(-0.6, 0.6), reference="filtered")
    assert_array_equal(system_of(around).A, A)


def test_a_given_sector_is_kept_by_replace_and_shown():
    channel = rs.Nonlinearity(**CHANNEL, sector=np.array([0.6, 1.0]))
    moved = dataclasses.replace(channel, D=[[0.0]])
    assert moved.sector == (0.6, 1.0)
    assert "sector=(0.6, 1)" in repr(moved)
