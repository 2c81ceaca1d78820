"""Values stay what they are: read-only, and the same after they were copied, pickled, replaced."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest

import robsmooth as rs
from robsmooth._numerics.riccati import RiccatiSolution
from robsmooth.paper.verdicts import Verdicts
from tests.project.test_display import OBJECTS, example

WAYS = {
    "copy": copy.copy,
    "deep copy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "replace": dataclasses.replace,
}
KINDS = {name: getattr(rs, name) for name in rs.__all__} | {
    each.__name__: each for each in (rs.homodyne.HomodyneParameters, RiccatiSolution, Verdicts)
}
VALUES = [name for name in sorted(OBJECTS) if dataclasses.is_dataclass(KINDS[name])]


def parts(value, path=""):
    """All that a value holds, by where it is."""
    yield path, value
    if isinstance(value, dict):
        inner = value.items()
    elif isinstance(value, list | tuple):
        inner = enumerate(value)
    else:
        inner = vars(value).items() if dataclasses.is_dataclass(value) else ()
    for name, part in inner:
        yield from parts(part, f"{path}.{name}")


def arrays(value):
    return {path: part for path, part in parts(value) if isinstance(part, np.ndarray)}


def check_read_only(value):
    for path, array in arrays(value).items():
        assert not array.flags.writeable, path
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.flags.writeable = True


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", VALUES)
def test_a_copy_is_the_same_and_read_only(name, way):
    value = example(name)
    check_read_only(value)
    copied = WAYS[way](value)
    assert type(copied) is type(value) and repr(copied) == repr(value)
    check_read_only(copied)
    before, after = arrays(value), arrays(copied)
    missing = {path.split(".")[1] for path in before.keys() - after.keys()}
    # found anew when they are asked for; an estimator with other gains is not the nominal one's
    assert missing <= ({"J", "known", "nominal"} if way == "replace" else set())
    for path, array in after.items():
        np.testing.assert_array_equal(array, before[path])
    for field in dataclasses.fields(copied):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(copied, field.name, None)


def test_most_public_classes_are_values_with_arrays():
    assert len([name for name in VALUES if arrays(example(name))]) > 12


def test_what_a_value_was_made_of_stays_the_users_to_change():
    square, errors = np.eye(2), [np.ones((1, 1)), np.ones((1, 1))]
    channel = rs.Uncertainty(square, square, square)
    sweep = rs.LagSweep(np.ones(1), np.ones(1, dtype=int), *errors, np.ones(1))
    square[0, 0] = errors[0][0, 0] = 5.0
    assert channel.B[0, 0] == sweep.nominal[0, 0] == 1.0


def test_an_estimator_that_was_pickled_runs_on_the_same_plant():
    estimator = rs.baselines.fixed_lag_smoother(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    y = np.random.default_rng(0).standard_normal((50, 1))
    expected = estimator.discretize(1e-7).run(y)
    for way in ("copy", "deep copy", "pickle"):
        copied = WAYS[way](estimator)
        assert copied.nominal is not None
        np.testing.assert_array_equal(copied.discretize(1e-7).run(y), expected)
        np.testing.assert_array_equal(copied.plant.J, estimator.plant.J)
