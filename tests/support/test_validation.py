"""What is no plain matrix of numbers is refused in one sentence that says what to do."""

import copy
import itertools
import json
import pickle
from decimal import Decimal
from fractions import Fraction
from functools import partial

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
        (
            [-1.0],
            ValueError,
            r"A must have 2 dimension\(s\), got shape \(1,\): \[\[...\]\] makes one row",
        ),
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


ENDLESS: list = [1.0]
ENDLESS.append(ENDLESS)
NESTED: list = []
for _ in range(5000):
    NESTED = [NESTED]


@pytest.mark.parametrize("wrong", [ENDLESS, NESTED, [[1.0], [2.0, 3.0]], [10**400]])
def test_a_list_that_is_no_array_is_refused_in_a_short_sentence(wrong):
    with pytest.raises(
        (ValueError, TypeError), match=r"^A must be an? .*array of numbers"
    ) as raised:
        validation.array("A", wrong, 2)
    assert len(str(raised.value)) < 300


@pytest.mark.parametrize("wrong", [{1.0}, {1.0: 2.0}, "ab", b"ab", 1.0, None, np.array(1.0)])
def test_what_has_no_order_or_no_entries_is_no_sequence(wrong):
    with pytest.raises(TypeError, match=r"^lags must be a sequence of values, got "):
        validation.sequence("lags", wrong)


def test_a_sequence_has_an_end_and_may_have_a_length():
    assert validation.sequence("lags", iter([1.0, 2.0])) == [1.0, 2.0]
    with pytest.raises(ValueError, match="lags must have 3 entries, got 2"):
        validation.sequence("lags", np.ones(2), count=3)
    with pytest.raises(ValueError, match="lags must have at most 1000000 entries"):
        validation.sequence("lags", itertools.count())


@pytest.mark.parametrize("wrong", [np.array(["a"]), ["a"], {"a"}, None, "b", "a" * 10_000])
def test_a_word_is_one_of_those_allowed(wrong):
    assert validation.choice("output", np.str_("a"), ("a", "c")) == "a"
    with pytest.raises(ValueError, match=r"^output must be one of 'a', 'c', got ") as raised:
        validation.choice("output", wrong, ("a", "c"))
    assert len(str(raised.value)) < 300


@pytest.mark.parametrize("wrong", ["", "a\0b", "\ud800" + chr(0xDC00), b"a", 3, None, ["a"]])
def test_what_no_file_can_be_named_is_no_path(wrong):
    with pytest.raises(TypeError, match=r"^path must be the path of a file, got "):
        validation.path("path", wrong)


def test_integers_have_bounds_with_their_reasons():
    with pytest.raises(ValueError, match=r"^runs must be at most 9007199254740992, got "):
        validation.integer("runs", 10**400, low=1)
    plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), 1e-6, 1)
    with pytest.raises(ValueError, match="starts must be at most 1000: each takes a second"):
        rs.minimize_bound(plant, starts=10**400)
    with pytest.raises(ValueError, match="order must be at most 100, because a design takes n"):
        rs.augment(plant.system, 1e-6, 10**6)


def test_work_without_end_is_refused_before_it_begins():
    one = {"orders": [1], "gammas": [0.4], "noises": [1.0]}
    study = partial(rs.parameter_study, rs.homodyne.PAPER, **one)
    with pytest.raises(TypeError, match=r"lags must be a sequence of values, got \{1.0\}"):
        study(lags={1.0})
    with pytest.raises(ValueError, match="step must be at least 1e-06 s"):
        study(lags=[1.0])
    system = rs.homodyne.PAPER.uncertain_system()
    with pytest.raises(ValueError, match="orders must have at most"):
        rs.lag_sweep(system, [1e-6], itertools.count(1))
    with pytest.raises(ValueError, match="runs and duration must make fewer numbers to keep"):
        rs.sample_paths(rs.baselines.kalman_bucy(system), runs=10**9)


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_dicts_and_lists_of_results_are_frozen_with_all_in_them(copied):
    given = {"a": [np.ones(2)]}
    kept = copied(rs.MeanSquare(given, [0.1])).mean_square  # type: ignore[arg-type]
    given["a"][0][:] = 9.0
    assert kept == {"a": (kept["a"][0],)}
    assert kept["a"][0].tolist() == [1.0, 1.0]
    assert json.loads(json.dumps({"kept": list(kept)})) == {"kept": ["a"]}
    changes = [kept.clear, kept.popitem, lambda: kept.update(b=1), lambda: kept.pop("a")]
    changes += [lambda: kept.__setitem__("a", 1), lambda: kept.__delitem__("a")]
    changes += [lambda: kept.__ior__({}), lambda: kept.setdefault("b", 1)]
    for change in changes:
        with pytest.raises(TypeError, match="a dict of a result is read-only"):
            change()
    with pytest.raises(ValueError, match="must hold no list that is nested without end"):
        rs.MeanSquare(ENDLESS, 0.1)  # type: ignore[arg-type]
