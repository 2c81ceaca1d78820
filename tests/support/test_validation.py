"""What is no plain matrix of numbers is refused in one sentence that says what to do."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

import robsmooth as rs
from robsmooth._support import validation

HIDDEN = np.ma.array([-1.0], mask=[True])
MASKED = r"A must have no masked entries; \.filled\(\.\.\.\) gives them a value$"
TYPES = r"A must be an array of numbers, got entries of type {}: np\.array\(\.\.\., dtype=float\)"


@pytest.mark.parametrize(
    ("A", "error", "words"),
    [
        (np.ma.array([[-1.0]], mask=[[True]]), ValueError, MASKED),
        ([HIDDEN], ValueError, MASKED),  # NumPy takes what is under the mask
        ((HIDDEN,), ValueError, MASKED),
        ([[True]], TypeError, TYPES.format("bool")),
        (np.array([[False]]), TypeError, TYPES.format("bool")),
        ([[10**30]], TypeError, TYPES.format("object")),  # beyond int64
        ([[Fraction(-1, 2)]], TypeError, TYPES.format("object")),
        ([[Decimal("-0.5")]], TypeError, TYPES.format("object")),
        (np.array([[-1.0]], dtype=object), TypeError, TYPES.format("object")),
        (np.array([["1e4000"]], dtype=np.longdouble), ValueError, "A must be finite, got inf"),
    ],
)
def test_what_is_no_plain_matrix_is_refused(A, error, words):
    with pytest.raises(error, match=f"^(?!.*\n)(?:{words})"):
        rs.UncertainSystem(A, [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]])


def test_what_is_said_to_convert_objects_does():
    given = [[10**30, Fraction(-1, 2), Decimal("0.25")]]
    found = validation.matrix("A", np.array(given, dtype=float), (1, 3))
    np.testing.assert_array_equal(found, [[1e30, -0.5, 0.25]])


def test_integers_of_any_width_are_their_values():
    for kind in (np.int8, np.uint8, np.int64, np.uint64):
        most = np.iinfo(kind).max
        assert validation.matrix("A", np.array([[most]], dtype=kind), (1, 1)) == float(most)
    assert validation.matrix("A", np.ma.array([[-1.0]]), (1, 1)) == -1.0  # nothing is masked


def test_a_quantity_is_refused_before_its_unit_is_lost():
    units = pytest.importorskip("pint").UnitRegistry()
    words = r"must be numbers without a unit, got a Quantity: its \.to\(\.\.\.\)\.magnitude"
    rate = np.array([[-1.0]]) / units.ms
    for A in (rate, [rate[0]]):
        with pytest.raises(TypeError, match=f"^A {words}"):
            rs.UncertainSystem(A, [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]])
    system = rs.UncertainSystem(
        rate.to_base_units().magnitude, [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]]
    )
    assert system.A == -1000.0
    with pytest.raises(TypeError, match=r"^delay must be a real number, got .*microsecond"):
        rs.augment(system, 3.0 * units.us, 2)


@pytest.mark.parametrize("wrong", [np.timedelta64(1000, "ns"), np.timedelta64(2, "us")])
def test_a_length_of_time_with_a_unit_is_no_number(wrong):
    system = rs.homodyne.PAPER.uncertain_system()
    with pytest.raises(TypeError, match=r"^delay must be a real number, got np\.timedelta64"):
        rs.augment(system, wrong, 2)
    with pytest.raises(TypeError, match=r"must be an integer, got np\.timedelta64"):
        rs.augment(system, 1e-6, wrong)


@pytest.mark.parametrize("A", [[[True, 2.0], [0.0, 1.0]], [[np.timedelta64(1, "s")]]])
def test_an_entry_that_is_no_number_is_refused_in_a_list_of_numbers(A):
    with pytest.raises(TypeError, match="A must be an array of numbers, got entries of type"):
        validation.array("A", A, 2)


def test_units_are_refused_however_deep_in_a_list():
    unit = pytest.importorskip("pint").Unit("mV")
    discrete = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system()).discretize(1e-7)
    for call in (lambda: discrete.run([[902.9 * unit]]), lambda: discrete.step([902.9 * unit])):
        with pytest.raises(TypeError, match="y must be numbers without a unit"):
            call()
    with pytest.raises(TypeError, match="got entries of type bool"):
        discrete.run([True, 2.0])


def test_a_frozen_array_is_not_that_of_its_giver():
    given = np.arange(3.0)
    view = given.view()
    view.flags.writeable = False
    kept = validation.frozen(view)
    given[:] = 9.0
    assert kept.tolist() == [0.0, 1.0, 2.0]
