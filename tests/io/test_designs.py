"""Files of systems and designs: what is written is read back bit for bit, and nothing else is."""

import copy
import functools
import json
import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robsmooth import (
    AugmentedSystem,
    Estimator,
    Nonlinearity,
    UncertainSystem,
    Uncertainty,
    augment,
    error_covariance,
    homodyne,
)
from robsmooth.estimators.baselines import fixed_lag_smoother, kalman_bucy
from robsmooth.estimators.minimax import certified_error, minimax_smoother
from robsmooth.estimators.smoother import limiting_smoother
from robsmooth.io.designs import load, save
from tests.helpers.strategies import designs, feasible_design, plants, random_system, systems

LANGUAGES = ("toml", "json")
GAINS = ("A_c", "B_c", "C_c", "C_a", "C_f")
few = settings(max_examples=15)


def assert_same(given, expected):
    """The same kind of object with the same numbers, to the last bit and the sign of zero."""
    assert type(given) is type(expected)
    if isinstance(expected, np.ndarray):
        assert_array_equal(given, expected, strict=True)
        assert_array_equal(np.signbit(given), np.signbit(expected))
    elif isinstance(expected, tuple):
        for one, other in zip(given, expected, strict=True):
            assert_same(one, other)
    elif hasattr(expected, "__dataclass_fields__"):
        for name in expected.__dataclass_fields__:
            if name not in ("certificates", "bound_infimum"):
                assert_same(getattr(given, name), getattr(expected, name))
    else:
        assert given == expected


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("storage")


def there_and_back(value, folder, **options):
    """The value as it comes back from a file of each language, after checking that they agree."""
    results = []
    for language in LANGUAGES:
        path = folder / f"value.{language}"
        save(value, path)
        results.append(load(path, **options))
    assert_same(*results)
    return results[0]


def example_design(g=1, delay=0.3):
    rng = np.random.default_rng(3)
    return feasible_design(
        rng, augment(random_system(rng, n=2, m=1, measurements=1, g=g), delay, 2)
    )


# --- there and back -------------------------------------------------------------------------------


@given(systems())
def test_a_system_comes_back_bit_for_bit(folder, system):
    assert_same(there_and_back(system, folder), system)


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.lists(finite, min_size=4, max_size=4), st.floats(min_value=5e-324, max_value=1e308))
def test_every_finite_float_comes_back_bit_for_bit(folder, entries, lipschitz):
    A = np.array(entries).reshape(2, 2)
    channel = Nonlinearity(A[:, :1], A[:1], [[entries[0]]], lipschitz)
    system = UncertainSystem(A, A, A, A[:1], A[:1], (), [channel])
    assert_same(there_and_back(system, folder), system)


@pytest.mark.parametrize("reference", [None, "filtered", "smoothed"])
def test_the_reference_of_a_detector_comes_back(folder, reference):
    members = [replace(SYSTEM.nonlinearities[0], function=None, reference=reference)]
    back = there_and_back(replace(SYSTEM, nonlinearities=members), folder)
    assert back.nonlinearities[0].reference == reference


def test_matrices_without_columns_come_back(folder):
    channel = Uncertainty(np.zeros((2, 0)), np.ones((1, 2)), np.zeros((1, 0)))
    system = UncertainSystem(
        -np.eye(2), np.zeros((2, 0)), np.eye(2), np.ones((1, 2)), np.zeros((1, 0)), [channel]
    )
    assert_same(there_and_back(system, folder), system)


def test_the_home_is_known(folder, monkeypatch):
    monkeypatch.setenv("HOME", str(folder))
    save(homodyne.PAPER.uncertain_system(), "~/home.toml")
    assert (folder / "home.toml").exists()
    assert_array_equal(load("~/home.toml").A, homodyne.PAPER.uncertain_system().A)


@given(plants())
@few
def test_a_plant_comes_back_bit_for_bit(folder, plant):
    assert_same(there_and_back(plant, folder), plant)


def test_the_intensity_of_the_copies_noise_comes_back(folder):
    system = random_system(np.random.default_rng(0), g=2)
    plant = augment(system, 0.1, 3, J_21=[[2.0, 0.5], [0.5, 1.0]])
    assert_same(there_and_back(plant, folder).J_21, plant.J_21)


@given(designs())
@few
def test_a_robust_design_comes_back_with_its_guarantee(folder, design):
    loaded = there_and_back(design, folder)
    assert_same(loaded, design)
    for name, certificate in design.certificates.items():
        assert_same(loaded.certificates[name].X, certificate.X)


def test_a_limiting_design_comes_back(folder):
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    design = limiting_smoother(plant, 1.1e-6, [1.0, 0.5, 0.0, 0.0])
    functions = {"HomodyneParameters.channel": homodyne.PAPER.channel}
    assert_same(there_and_back(design, folder, functions=functions), design)


def seen_nonlinearity():
    """A plant whose least certified error is found by descent: a copy drives what is uncertain."""
    force = Nonlinearity(B=[[0], [1]], C=[[1, 0]], D=[[0]], lipschitz=0.1)
    damping = Uncertainty(B=[[0], [1]], C=[[0, 0.1]], D=[[0]])
    A, B1 = [[0, 1], [-0.8, -0.5]], [[0, 0], [0.5, 0]]
    system = UncertainSystem(A, B1, [[1, 0]], [[1, 0]], [[0, 0.1]], [damping], [force])
    return augment(system, 0.5, 1)


@pytest.fixture(scope="module")
def minimax_smoothers():
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    programme = [minimax_smoother(plant, output) for output in ("smoothed", "filtered")]
    return [*programme, minimax_smoother(seen_nonlinearity())]


def test_a_minimax_smoother_comes_back_with_its_certificate(folder, minimax_smoothers):
    functions = {"HomodyneParameters.channel": homodyne.PAPER.channel}
    for smoother in minimax_smoothers:
        given = functions if smoother.plant.system.nonlinearities[0].function else {}
        loaded = there_and_back(smoother, folder, functions=given)
        assert_same(loaded, smoother)
        assert_allclose(certified_error(loaded), smoother.certified, rtol=1e-6)
    assert {s.route for s in minimax_smoothers} == {"semidefinite programme", "descent"}


@pytest.mark.parametrize("make", [kalman_bucy, lambda s: fixed_lag_smoother(s, 3.1e-6, 4, True)])
def test_an_estimator_comes_back_with_its_function_and_works(folder, make):
    estimator = make(homodyne.PAPER.uncertain_system())
    functions = {"HomodyneParameters.channel": homodyne.PAPER.channel}
    loaded = there_and_back(estimator, folder, functions=functions)
    assert_same(loaded, estimator)
    assert type(loaded) is Estimator
    Delta = estimator.plant.structured_delta((), [-0.3])
    assert_array_equal(error_covariance(loaded, Delta), error_covariance(estimator, Delta))


# --- the files themselves -------------------------------------------------------------------------

SYSTEM = UncertainSystem(
    A=[[-1.0, 2.0], [0.0, -1e-07]],
    B1=[[1.0, 0.0], [0.0, 0.0]],
    C0=[[1.0, 0.0]],
    C2=[[0.5, 0.0]],
    D21=[[0.0, 0.25]],
    uncertainties=[
        Uncertainty(B=[[1.0], [0.0]], C=[[0.0, 0.0]], D=[[0.0]]),
        Uncertainty(B=[[0.0], [0.0]], C=[[0.0, 0.1]], D=[[0.25]]),
    ],
    nonlinearities=[
        Nonlinearity(B=[[0.0], [1.0]], C=[[1.0, 0.0]], D=[[0.0]], lipschitz=1.0, function=np.sin)
    ],
)
TOML = """\
format = 1
kind = "system"
units = "SI"
A = [
  [-1.0, 2.0],
  [0.0, -1e-07]
]
B1 = [
  [1.0, 0.0],
  [0.0, 0.0]
]
C0 = [[1.0, 0.0]]
C2 = [[0.5, 0.0]]
D21 = [[0.0, 0.25]]

[[uncertainties]]
B = [
  [1.0],
  [0.0]
]
C = [[0.0, 0.0]]
D = [[0.0]]

[[uncertainties]]
B = [
  [0.0],
  [0.0]
]
C = [[0.0, 0.1]]
D = [[0.25]]

[[nonlinearities]]
B = [
  [0.0],
  [1.0]
]
C = [[1.0, 0.0]]
D = [[0.0]]
lipschitz = 1.0
function = "sin"
"""


def test_a_file_is_readable(folder):
    save(SYSTEM, folder / "system.toml")
    assert (folder / "system.toml").read_text() == TOML
    save(SYSTEM, folder / "system.json")
    text = (folder / "system.json").read_text()
    assert json.loads(text) == tomllib.loads(TOML)
    assert '\n  "A": [\n    [-1.0, 2.0],\n    [0.0, -1e-07]\n  ],\n' in text


def test_a_file_written_by_hand_is_read(folder):
    path = folder / "hand.toml"
    path.write_bytes(
        b"\xef\xbb\xbf# by an editor of another system\r\n"
        b"kind = 'system'\r\nformat = 1\r\nunits = 'SI'\r\n"
        b"A = [[-1]]\r\nB1 = [[1, 0]]\r\nC0 = [[1]]\r\nC2 = [[1]]\r\nD21 = [[0, 1_0]]\r\n"
    )
    assert_same(load(path), UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 10]]))


def test_a_failed_save_leaves_the_file_as_it_was(folder, monkeypatch):
    path = folder / "kept.toml"
    path.write_text("kept")
    monkeypatch.setattr("os.replace", lambda *paths: (_ for _ in ()).throw(OSError("disk")))
    with pytest.raises(OSError, match="disk"):
        save(SYSTEM, path)
    assert path.read_text() == "kept"
    assert not list(folder.glob(".kept*"))


@pytest.mark.parametrize("name", ["system", "system.txt", "system.toml.bak"])
def test_the_suffix_says_the_language(folder, name):
    for call in (lambda path: save(SYSTEM, path), load):
        with pytest.raises(ValueError, match=r"path must end in \.toml or \.json, got 'system"):
            call(folder / name)
    save(SYSTEM, folder / "SYSTEM.TOML")
    assert_same(load(folder / "SYSTEM.TOML", {"sin": np.sin}), SYSTEM)


def test_what_is_no_system_or_design_is_not_saved(folder):
    with pytest.raises(TypeError, match=r"value must be an UncertainSystem, .*, got ndarray"):
        save(np.eye(2), folder / "x.toml")
    design = example_design()
    with pytest.raises(ValueError, match="gains that follow from its tau and multipliers"):
        save(replace(design, A_c=1.01 * design.A_c), folder / "x.toml")
    assert not (folder / "x.toml").exists()


def test_a_file_that_is_not_there_is_an_error_of_the_system(folder):
    with pytest.raises(FileNotFoundError, match=r"^path must be .* exists, got .*missing\.toml"):
        load(folder / "missing.toml")


# --- functions ------------------------------------------------------------------------------------


class Saturation:
    def __call__(self, nu):
        return np.clip(nu, -1, 1)


def with_functions(*functions):
    channels = [replace(SYSTEM.nonlinearities[0], function=f) for f in functions]
    return replace(SYSTEM, nonlinearities=channels)


@pytest.mark.parametrize(
    "function, name",
    [
        (np.sin, "sin"),
        (Saturation(), "Saturation"),
        (functools.partial(np.multiply, 0.0), "partial"),
        (lambda nu: 0 * nu, "<lambda>"),
        (homodyne.PAPER.channel, "HomodyneParameters.channel"),
    ],
)
def test_a_function_is_saved_by_name_and_given_by_name(folder, function, name):
    path = folder / "function.toml"
    save(with_functions(function, None, function), path)
    named = [c.get("function") for c in tomllib.loads(path.read_text())["nonlinearities"]]
    assert named == [name, None, name]
    loaded = load(path, {name: function}).nonlinearities
    assert [c.function for c in loaded] == [function, None, function]
    assert [c.function for c in load(path).nonlinearities] == [None] * 3


def test_different_functions_of_one_name_are_not_saved(folder):
    system = with_functions(lambda nu: nu, np.sin, lambda nu: 2 * nu)
    words = (
        r"nonlinearities\[2\]\.function must have a name of its own to be saved, got .*<lambda>'"
    )
    with pytest.raises(ValueError, match=words):
        save(system, folder / "x.toml")


@pytest.mark.parametrize(
    "functions, error, words",
    [
        ({"tahn": np.tanh}, ValueError, r"^system\.toml: functions has 'tahn', .* names 'sin'$"),
        (
            {"sin": np.cos},
            ValueError,
            r"^system\.toml: nonlinearities\[0\]: .* function must be zero",
        ),
        ({"sin": math.sin}, ValueError, r"nonlinearities\[0\]: .* function must be vectorised"),
        ({"sin": "sin"}, ValueError, r"nonlinearities\[0\]: .* must be callable, got 'sin'"),
        ([np.sin], TypeError, "^functions must be a Mapping, got list"),
    ],
)
def test_functions_that_do_not_fit_are_refused(folder, functions, error, words):
    save(SYSTEM, folder / "system.toml")
    with pytest.raises(error, match=words):
        load(folder / "system.toml", functions)


# --- what is wrong with a file --------------------------------------------------------------------

CONTENT = tomllib.loads(TOML)
DELETE = object()


def changed(content, path, value):
    """A copy of a file's content with one field, by its path, of another value."""
    result = copy.deepcopy(content)
    *parents, last = path
    table = functools.reduce(lambda inner, key: inner[key], parents, result)
    if value is DELETE:
        del table[last]
    else:
        table[last] = value
    return result


def written(folder, content):
    path = folder / "file.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    "path, value, words",
    [
        (("A",), DELETE, "A is missing"),
        (("format",), DELETE, "format must be one of 1, got None"),
        (("kind",), DELETE, "kind must be one of .* 'plant', 'system', got None"),
        (("units",), DELETE, "units must be one of 'SI', got None"),
        (("uncertainties", 1, "C"), DELETE, r"uncertainties\[1\]\.C is missing"),
        (
            ("uncertainties", 1, "c"),
            [],
            r"uncertainties\[1\]\.c is not a field: these are B, C, D$",
        ),
        (("nonlinearity",), [], "nonlinearity is not a field: these are A, B1, .*, nonlin"),
        (("d12",), [[0]], "d12 is not a field: these are .* D21, "),
        (
            ("nonlinearities", 0, "reference"),
            "phase",
            r"nonlinearities\[0\]: .* reference must be one of 'filtered', 'smoothed', got 'phase'",
        ),
        (("nonlinearities", 0, "reference"), 3, r"\[0\]: .* reference must be one of .*, got 3"),
        (("nonlinearities", 0, "lipshitz"), 1, r"\[0\]\.lipshitz is not a field: .* lipschitz, "),
        (("format",), 2, "format must be one of 1, got 2"),
        (("format",), "1", "format must be an integer, got '1'"),
        (("format",), True, "format must be an integer, got True"),
        (
            ("kind",),
            "sistem",
            "kind must be one of .* 'plant', 'system', got 'sistem'",
        ),
        (("units",), "imperial", "units must be one of 'SI', got 'imperial'"),
        (("A",), 1.0, r"A must have 2 dimension\(s\), got shape \(\)"),
        (("A",), [1.0, 2.0], r"A must have 2 dimension\(s\), got shape \(2,\)"),
        (("A",), "2", "A must be an array of numbers, got entries of type"),
        (("A", 0, 1), "2", r"A\[0\]\[1\] must be a finite number, got '2'"),
        (("A", 0, 1), True, r"A\[0\]\[1\] must be a finite number, got True"),
        (("A", 0, 1), None, r"A\[0\]\[1\] must be a finite number, got None"),
        (("A", 0, 1), math.nan, r"A\[0\]\[1\] must be a finite number, got nan"),
        (("A", 1, 0), 10**400, r"A\[1\]\[0\] must be a finite number, got 10000"),
        (("A", 1), [1.0], r"A must be a rectangular array of numbers, got \[\["),
        (("A",), [], r"A must have 2 dimension\(s\), got shape \(0,\)"),
        (("A",), [[]], "A must be square and not empty"),
        (("C2",), [[1.0]], r"C2 must have shape \(any, 2\), got \(1, 1\)"),
        (("uncertainties",), {}, "uncertainties must be a list of tables, got {}"),
        (("uncertainties",), [3], r"uncertainties\[0\] must be a table, got 3"),
        (
            ("uncertainties", 1, "C"),
            [[1, 2, 3]],
            r"uncertainties\[1\]\.C must have shape \(any, 2\), got \(1, 3\)",
        ),
        (
            ("nonlinearities", 0, "B", 0, 0),
            -math.inf,
            r"nonlinearities\[0\]\.B\[0\]\[0\] must be a finite number, got -inf",
        ),
        (
            ("nonlinearities", 0, "lipschitz"),
            0,
            r"nonlinearities\[0\]: .* lipschitz must be finite",
        ),
        (("nonlinearities", 0, "lipschitz"), 10**400, " lipschitz must be finite .* got inf"),
        (("nonlinearities", 0, "lipschitz"), True, " lipschitz must be a real number, got True"),
        (("nonlinearities", 0, "function"), ["sin"], r"\.function must be a name, got \['sin'\]"),
    ],
)
def test_a_wrong_field_is_named_with_its_file(folder, path, value, words):
    with pytest.raises(ValueError, match=f"^file\\.json: (?!.*\n).*{words}"):
        load(written(folder, changed(CONTENT, path, value)))


@pytest.fixture(scope="module")
def design_content(folder):
    save(example_design(), folder / "design.json")
    return json.loads((folder / "design.json").read_text())


@pytest.mark.parametrize(
    "path, value, words",
    [
        (("A_c",), [[1.0]], "A_c is not a field: these are tau, multipliers, cost, plant$"),
        (("tau",), 0.0, "tau must be finite and in"),
        (("tau",), 1e-9, "Assumption 3"),
        (("multipliers",), [1.0], "multipliers must have k . 3g = .* entries"),
        (
            ("multipliers",),
            1.0,
            r"multipliers must have 1 dimension\(s\), got shape \(\)",
        ),
        (("cost",), "both", "cost must be one of 'filtered', 'smoothed', got"),
        (
            ("taw",),
            1.0,
            "taw is not a field: these are tau, multipliers, cost, plant$",
        ),
        (("plant", "delay"), -1.0, r"plant: delay must be finite and in \[0, inf"),
        (("plant", "delay"), 5e-324, "plant: overflow encountered"),
        (("plant", "order"), 2.0, "plant: order must be an integer, got 2.0"),
        (("plant", "J_21"), [[-1.0]], "plant: J_21 must be positive definite"),
        (("plant",), DELETE, "plant is missing"),
        (("plant", "system"), [], r"plant\.system must be a table, got \[\]"),
        (
            ("plant", "system", "uncertainties", 0, "D"),
            [[0.0]],
            r"plant\.system: uncertainties\[0\]\.D must have shape \(1, 2\)",
        ),
    ],
)
def test_a_wrong_field_of_a_design_is_named_with_its_file(
    folder, design_content, path, value, words
):
    with pytest.raises(ValueError, match=f"^file\\.json: (?!.*\n).*{words}"):
        load(written(folder, changed(design_content, path, value)))


@pytest.mark.parametrize(
    "path, value, words",
    [
        (("A_c",), [[1.0, 2.0]], r"A_c must have shape \(1, 1\), got \(1, 2\)"),
        (("A_c",), 1.0, r"A_c must have 2 dimension\(s\), got shape \(\)"),
        (("C_f",), [[1.0]], r"C_f must have shape \(1, 3\)"),
        (("A_c", 0, 0), 1e9, "certified must follow from the multipliers, which give -"),
        (("C_c", 0, 0), 0.8, "certified must follow from the multipliers, which give "),
        (("certified",), 0.08, "certified must follow from the multipliers, which give 0.08"),
        (("certified",), 0.0, r"certified must be finite and in \(0"),
        (("multipliers", 1), 1e-6, "certified must follow from the multipliers"),
        (("multipliers", 1), 1e-9, "multipliers certify no finite err"),
        (("multipliers",), [0.0] * 4, "multipliers certify no finite"),
        (
            ("multipliers",),
            [1.0],
            "multipliers must have k . 3g = .* got",
        ),
        (("cost",), "both", "cost must be one of .*, got 'both'"),
        (("route",), "luck", "route must be one of .*, got 'luck'"),
        (("route",), DELETE, r"route is missing"),
        (("kind",), "robust smoother", "A_c is not a field: these are tau, "),
    ],
)
def test_a_certificate_that_does_not_hold_is_refused(folder, minimax_smoothers, path, value, words):
    save(minimax_smoothers[0], folder / "minimax.json")
    content = json.loads((folder / "minimax.json").read_text())
    with pytest.raises(ValueError, match=f"^file\\.json: (?!.*\n).*{words}"):
        load(written(folder, changed(content, path, value)))


@pytest.mark.parametrize(
    "name, data, words",
    [
        ("file.toml", b"format = 1\nA = [[1.0, 2.0\nB1 = 3", "line 3"),
        ("file.json", b'{"format": 1,\n "A": [[1.0 2.0]]}', "line 2 column 13"),
        ("file.toml", b"A = 1\nA = 2\n", "Cannot overwrite a value .*line 2"),
        ("file.json", b'{"A": 1, "A": 2}', "one of A, A is there twice"),
        ("file.toml", b"\xff\xfe", "codec can't decode"),
        ("file.json", b"", "Expecting value"),
        ("file.toml", b"", "format must be one of 1, got None"),
        ("file.json", b"[1, 2]", r"its content must be a table, got \[1, 2\]"),
        ("file.json", b"[" * 100_000, "nested too deeply"),
        ("file.toml", b"A = " + b"[" * 100_000, "nested too deeply"),
        ("file.toml", b"a." * 20_000 + b"a = 1", "nested too deeply"),
        ("file.json", b'{"format": ' + b"9" * 5000 + b"}", "Exceeds the limit"),
        (
            "file.toml",
            b"format = 1\nkind = ['system']\nunits = 'SI'",
            r"one of .*, got \['system'\]",
        ),
        ("file.toml", b"format = 2026-01-01\nkind = 'system'\nunits = 'SI'", "an integer, got dat"),
    ],
)
def test_what_is_no_toml_or_json_is_one_error_with_its_place(folder, name, data, words):
    path = folder / name
    path.write_bytes(data)
    with pytest.raises(ValueError, match=f"^{name}: (?!.*\n).*{words}"):
        load(path)


# --- whatever is wrong with a file ----------------------------------------------------------------


def places(content, prefix=()):
    """The paths of all that is in a file's content."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for key, value in items:
        yield (*prefix, key)
        if isinstance(value, dict | list):
            yield from places(value, (*prefix, key))


VALUES = st.one_of(
    st.just(DELETE),
    st.none() | st.booleans() | st.text(max_size=5),
    st.integers(-3, 3) | st.integers() | st.just(10**400),
    st.sampled_from([math.nan, math.inf, 0.0, -0.0, 5e-324, 1e300, -1.5]),
    st.lists(st.integers(-1, 1) | st.lists(st.integers(-1, 1), max_size=3), max_size=3),
    st.dictionaries(st.sampled_from(["A", "B", "C", "D", "x"]), st.integers(), max_size=2),
)


def loads_or_says_why(path):
    try:
        result = load(path)
    except ValueError as error:
        assert str(error).startswith(f"{path.name}: ")
        assert "\n" not in str(error)
    else:
        assert isinstance(result, UncertainSystem | AugmentedSystem | Estimator)


@given(st.data())
@settings(max_examples=300)
def test_a_field_changed_at_random_loads_or_is_refused_with_the_files_name(
    folder, design_content, data
):
    content = data.draw(st.sampled_from([CONTENT, design_content]))
    # any order is one that can be asked for, if there is time to wait for it
    place = data.draw(st.sampled_from([p for p in places(content) if p[-1] != "order"]))
    loads_or_says_why(written(folder, changed(content, place, data.draw(VALUES))))


@given(st.integers(0, len(TOML) - 1), st.integers(0, 3), st.binary(max_size=4))
@settings(max_examples=300)
def test_text_changed_at_random_loads_or_is_refused_with_the_files_name(
    folder, at, length, inserted
):
    data = TOML.encode()
    for name, text in (("file.toml", data), ("file.json", json.dumps(CONTENT).encode())):
        path = folder / name
        path.write_bytes(text[:at] + inserted + text[at + length :])
        loads_or_says_why(path)


# --- smoothers of records ------------------------------------------------------------------------


@pytest.mark.parametrize("samples", ["means", "instants"])
@pytest.mark.parametrize("language", LANGUAGES)
def test_a_smoother_of_records_comes_back_as_it_was_made(folder, samples, language):
    system = random_system(np.random.default_rng(5), measurements=2)
    estimator = fixed_lag_smoother(system, 0.5, 2)
    how = {"mean": np.ones(system.n), "offset": [0.1, -0.2], "samples": samples}
    made = estimator.discretize(0.1, **how)
    y = np.random.default_rng(1).standard_normal((40, 2))
    y[7, 1] = np.nan
    made.run(y)  # the state is not in the file
    save(made, folder / f"discrete.{language}")
    found = load(folder / f"discrete.{language}")
    assert repr(found) == repr(estimator.discretize(0.1, **how))
    assert_array_equal(found.run(y), estimator.discretize(0.1, **how).run(y))


def test_a_smoother_of_records_has_the_functions_of_its_system(folder):
    design = minimax_smoother(augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2))
    made = design.discretize(1e-7)
    save(made, folder / "discrete.toml")
    with pytest.raises(ValueError, match=r"discrete: nonlinearities\[0\] must have"):
        load(folder / "discrete.toml")
    channel = homodyne.PAPER.channel
    found = load(folder / "discrete.toml", {"HomodyneParameters.channel": channel})
    y, reference = np.random.default_rng(1).standard_normal((2, 40, 1))
    assert_allclose(found.run(y, reference=reference), made.run(y, reference=reference), rtol=1e-12)
    own = design.discretize(1e-7, functions=[np.tanh])
    with pytest.raises(ValueError, match="value must have no functions but those of its system"):
        save(own, folder / "own.toml")
    text = (folder / "discrete.toml").read_text()
    (folder / "wrong.toml").write_text(text.replace("dt = 1e-07", "dt = -1.0"))
    with pytest.raises(ValueError, match=r"^wrong\.toml: discrete: dt must be finite and in"):
        load(folder / "wrong.toml", {"HomodyneParameters.channel": channel})
    save(homodyne.PAPER.uncertain_system(), folder / "system.toml")
    text = (folder / "system.toml").read_text() + "[discrete]\ndt = 1.0\n"
    (folder / "wrong.toml").write_text(text)
    with pytest.raises(ValueError, match="discrete is not a field: these are"):
        load(folder / "wrong.toml")
