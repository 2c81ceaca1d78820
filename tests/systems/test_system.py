"""The uncertain system: what it takes, and what it says to what it does not take."""

import math

import numba
import numpy as np
import pint
import pytest
from numpy.testing import assert_array_equal

from robsmooth import Nonlinearity, UncertainSystem, Uncertainty

GOOD = dict(
    A=[[-1.0, 2.0], [0.0, -3.0]],
    B1=[[1.0, 0.0], [0.0, 0.0]],
    C0=[[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]],
    C2=[[1.0, 0.0]],
    D21=[[0.0, 0.5]],
)
UNCERTAINTY = dict(B=[[1.0], [0.0]], C=[[0.0, 0.1], [0.2, 0.0]], D=[[0.0]])
NONLINEARITY = dict(B=[[0.0], [0.0]], C=[[1.0, 0.0]], D=[[0.5]], lipschitz=1.0)
BAD_MATRICES = {
    "not finite": (lambda value: np.full_like(value, np.nan), ValueError, "must be finite"),
    "infinite": (lambda value: np.full_like(value, -np.inf), ValueError, "must be finite"),
    "complex": (lambda value: value + 0j, ValueError, "must be real"),
    "1-D": (np.ravel, ValueError, "must have 2 dimension"),
    "scalar": (lambda value: 1.0, ValueError, "must have 2 dimension"),
    "3-D": (lambda value: value[None], ValueError, "must have 2 dimension"),
    "ragged": (lambda value: [[1.0], [1.0, 2.0, 3.0]], ValueError, "rectangular"),
    "text": (lambda value: "matrix", TypeError, "array of numbers"),
    "words": (lambda value: [["a"]], TypeError, "array of numbers"),
    "none": (lambda value: None, TypeError, "array of numbers"),
    "booleans": (lambda value: value != 0, TypeError, "entries of type bool: np.array"),
    "objects": (lambda value: value.astype(object), TypeError, "entries of type object: np.array"),
    "quantity": (lambda value: value * pint.Unit("V"), TypeError, "numbers without a unit"),
    "quantities": (
        lambda value: [list(row * pint.Unit("V")) for row in value],
        TypeError,
        "numbers without a unit",
    ),
}


def raises(error, *words):
    """Expect one error whose message is one line and holds all `words`."""
    return pytest.raises(error, match="(?s)^(?!.*\n)" + "".join(f"(?=.*{word})" for word in words))


@pytest.mark.parametrize("bad", BAD_MATRICES)
@pytest.mark.parametrize("name", GOOD)
def test_each_bad_matrix_is_one_error_that_names_it(name, bad):
    spoil, error, words = BAD_MATRICES[bad]
    with raises(error, rf"^{name}\b", words):
        UncertainSystem(**{**GOOD, name: spoil(np.array(GOOD[name]))})


@pytest.mark.parametrize("bad", BAD_MATRICES)
@pytest.mark.parametrize("name", ["B", "C", "D"])
@pytest.mark.parametrize("kind, good", [(Uncertainty, UNCERTAINTY), (Nonlinearity, NONLINEARITY)])
def test_each_bad_matrix_of_a_channel_is_one_error_that_names_it(kind, good, name, bad):
    spoil, error, words = BAD_MATRICES[bad]
    with raises(error, rf"{kind.__name__} {name}\b", words):
        kind(**{**good, name: spoil(np.array(good[name]))})


@pytest.mark.parametrize(
    "name, shape",
    [
        ("A", (2, 3)),
        ("A", (0, 0)),
        ("B1", (3, 2)),
        ("C0", (1, 3)),
        ("C0", (0, 2)),
        ("C2", (1, 1)),
        ("C2", (0, 2)),
        ("D21", (1, 3)),
        ("D21", (2, 2)),
    ],
)
def test_each_wrong_shape_is_an_error_that_names_the_matrix(name, shape):
    with raises(ValueError, rf"^{name}\b", "shape|square|row"):
        UncertainSystem(**{**GOOD, name: np.ones(shape)})


@pytest.mark.parametrize(
    "field, kind, good",
    [
        ("uncertainties", Uncertainty, UNCERTAINTY),
        ("nonlinearities", Nonlinearity, NONLINEARITY),
    ],
)
@pytest.mark.parametrize(
    "name, shape", [("B", (3, 1)), ("C", (1, 3)), ("D", (2, 1)), ("D", (1, 2))]
)
def test_a_channel_that_does_not_fit_the_system_is_named_with_its_index(
    field, kind, good, name, shape
):
    bad = kind(**{**good, name: np.ones(shape)})
    with raises(ValueError, rf"{field}\[1\]\.{name}", "shape"):
        UncertainSystem(**GOOD, **{field: (kind(**good), bad)})


@pytest.mark.parametrize("name, shape", [("B", (2, 2)), ("C", (2, 2)), ("D", (1, 2))])
def test_a_nonlinearity_is_scalar(name, shape):
    channel = Nonlinearity(**{**NONLINEARITY, name: np.ones(shape)})
    with raises(ValueError, rf"nonlinearities\[0\]\.{name}"):
        UncertainSystem(**GOOD, nonlinearities=[channel])


@pytest.mark.parametrize("field", ["uncertainties", "nonlinearities"])
@pytest.mark.parametrize("value", [3, None, [3], ["channel"], [None]])
def test_channels_of_a_wrong_type_are_an_error(field, value):
    with raises(TypeError, field):
        UncertainSystem(**GOOD, **{field: value})


def test_a_single_channel_in_place_of_a_sequence_is_an_error():
    with raises(TypeError, "uncertainties", "sequence"):
        UncertainSystem(**GOOD, uncertainties=Uncertainty(**UNCERTAINTY))
    with raises(TypeError, r"nonlinearities\[0\]"):
        UncertainSystem(**GOOD, nonlinearities=[Uncertainty(**UNCERTAINTY)])


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_lipschitz_constant_is_positive_and_finite(value):
    with raises(ValueError, "lipschitz"):
        Nonlinearity(**{**NONLINEARITY, "lipschitz": value})


@pytest.mark.parametrize("value", ["1", True, None, 1j, [1.0]])
def test_a_lipschitz_constant_is_a_number(value):
    with raises(TypeError, "lipschitz"):
        Nonlinearity(**{**NONLINEARITY, "lipschitz": value})


@pytest.mark.parametrize(
    "function, error, words",
    [
        (np.cos, ValueError, "zero at zero"),
        (lambda nu: nu + np.nan, ValueError, "zero at zero"),
        (lambda nu: 0.0, ValueError, r"vectorised.*shape \(2,\) gave shape \(\)"),
        (lambda nu: None, ValueError, "vectorised"),
        (math.sin, ValueError, r"vectorised.*gave TypeError: .*np\.sin, not math\.sin"),
        (lambda nu: nu if nu > 0 else 0 * nu, ValueError, "vectorised.*numpy.vectorize"),
        (lambda nu: np.array(["a", "b"]), ValueError, "zero at zero, got a"),
        (numba.njit(lambda nu: math.cos(nu)), ValueError, r"zero at zero, got 1\.0"),
        (numba.njit(lambda nu: (nu, nu)), ValueError, r"vectorised.*shape \(\) gave shape \(2,\)"),
        (numba.njit(lambda nu: nu.no_such_name), ValueError, "vectorised.*TypingError"),
        (3.0, TypeError, "callable"),
    ],
)
def test_a_nonlinearity_is_a_vectorised_function_that_is_zero_at_zero(function, error, words):
    with raises(error, "function", words):
        Nonlinearity(**NONLINEARITY, function=function)


@pytest.mark.parametrize("value", ["phase", "", 0, True, np.eye(1)])
def test_a_reference_is_the_name_of_an_estimate(value):
    with raises(ValueError, "Nonlinearity reference must be one of 'filtered', 'smoothed', got"):
        Nonlinearity(**NONLINEARITY, reference=value)
    assert Nonlinearity(**NONLINEARITY).reference is None
    assert "reference='smoothed'" in repr(Nonlinearity(**NONLINEARITY, reference="smoothed"))


@numba.njit
def compiled_for_arrays(nu):
    return nu - nu[0]


@pytest.mark.parametrize(
    "function",
    [
        np.sin,
        np.vectorize(math.sin),
        numba.vectorize(["float64(float64)"])(lambda nu: math.sin(nu)),
        numba.njit(lambda nu: math.sin(nu) if abs(nu) < 1.0 else nu),
        numba.njit(lambda nu: np.sin(nu)),
        compiled_for_arrays,
    ],
)
def test_a_function_is_numpys_or_compiled_by_numba(function):
    assert Nonlinearity(**NONLINEARITY, function=function).function is function


def test_matrices_are_copied_and_read_only():
    given = {name: np.array(value) for name, value in GOOD.items()}
    channel = {name: np.array(value) for name, value in UNCERTAINTY.items()}
    system = UncertainSystem(**given, uncertainties=[Uncertainty(**channel)])
    for name, value in given.items():
        value[:] = 99.0
        kept = getattr(system, name)
        assert_array_equal(kept, GOOD[name])
        with pytest.raises(ValueError, match="read-only"):
            kept[0, 0] = 1.0
    for name, value in channel.items():
        value[:] = 99.0
        assert_array_equal(getattr(system.uncertainties[0], name), UNCERTAINTY[name])
    with pytest.raises(AttributeError):
        system.A = np.eye(2)


def test_integers_become_floats():
    system = UncertainSystem(**{**GOOD, "A": [[-1, 2], [0, -3]]})
    assert system.A.dtype == np.float64
    assert_array_equal(system.A, GOOD["A"])


@pytest.mark.parametrize("k", [0, 1, 3])
@pytest.mark.parametrize("g", [0, 1, 3])
def test_any_number_of_channels_is_a_system(k, g):
    system = UncertainSystem(
        **GOOD,
        uncertainties=[Uncertainty(**UNCERTAINTY)] * k,
        nonlinearities=(Nonlinearity(**NONLINEARITY) for _ in range(g)),
    )
    assert (system.n, system.m, system.l, system.q, system.k, system.g) == (2, 3, 1, 2, k, g)
    for part in ("n=2", "m=3", "l=1", "q=2", f"k={k}", f"g={g}"):
        assert part in repr(system)
