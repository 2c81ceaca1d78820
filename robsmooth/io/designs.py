r"""Systems, plants and estimators in readable files, TOML or JSON.

A file has the names and units of the library's fields, its matrices by rows::

    format = 1
    kind = "system"
    units = "SI"
    A = [
      [-1.0, 2.0],
      [0.0, -3.0]
    ]
    ...
    [[nonlinearities]]
    B = [...]
    lipschitz = 1.0
    function = "sin"
    reference = "filtered"

Numbers are written so that they are read back bit for bit. A function is named only: nothing in a
file is ever imported or run, and `load` takes the functions by those names.
"""

import difflib
import json
import math
import os
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robsmooth._support import files, validation
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.limit import limiting_smoother
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.systems.augmented import AugmentedSystem, compact
from robsmooth.systems.system import Nonlinearity, UncertainSystem, Uncertainty

FORMAT = 1
_SAME_DESIGN = 1e-6  # largest relative difference of a stored design to that of its parameters
_GAINS = ("A_c", "B_c", "C_c", "C_a", "C_f")
_ABOUT = {
    "system": """\
# dx = (A x + sum_s B xi_s + sum_i B mu_i) dt + B1 dW,    w = C0 x
# dy = (C2 x + sum_s D xi_s + sum_i D mu_i) dt + D21 dW
# uncertainties: xi_s is no larger than C x; nonlinearities: mu_i = function(C x), Lipschitz;
# with a reference ("filtered" or "smoothed"), of C x less that estimate of it""",
    "plant": """\
# The system with a model, of a Pade order, of a delay (s) of w; J_21 is the intensity of the
# noise that the theory adds to the estimator's copies of the nonlinearities.""",
    "estimator": """\
# dx_hat = A_c x_hat dt + B_c [dy; mu_copy dt],    mu_copy_i = function_i(nu_copy_i)
# [w_hat; nu_copy] = C_c x_hat
# C_a x_hat estimates w one lag back, C_f x_hat estimates w now""",
}


def save(
    value: UncertainSystem | AugmentedSystem | Estimator, path: str | os.PathLike[str]
) -> None:
    """Save a system, a plant or an estimator to one readable file.

    Parameters
    ----------
    value : UncertainSystem, AugmentedSystem or Estimator
        An estimator is saved by its matrices, with its plant; a `RobustSmoother` with its tau,
        multipliers, cost and bound, too, but without what `minimize_bound` found around it. Of a
        nonlinearity's function the name is saved.
    path : str or path
        Ends in .toml or .json. The file appears whole or not at all.

    Returns
    -------
    None

    Raises
    ------
    ValueError, TypeError
        For another suffix or another kind of object, different functions of the same name, or a
        `RobustSmoother` whose gains are not those of its tau and multipliers.
    OSError
        Where the file cannot be written.
    """
    path, language = _language(path)
    content = {"format": FORMAT, "kind": "", "units": "SI"}
    if isinstance(value, UncertainSystem):
        content |= {"kind": "system", **_system_fields(value)}
    elif isinstance(value, AugmentedSystem):
        content |= {"kind": "plant", **_plant_fields(value)}
    elif isinstance(value, Estimator):
        content |= {"kind": "estimator", **_estimator_fields(value)}
    else:
        raise TypeError(
            "value must be an UncertainSystem, AugmentedSystem or Estimator, "
            f"got {type(value).__name__}"
        )
    files.write_text(path, _toml_document(content) if language == "toml" else _json(content) + "\n")


def load(
    path: str | os.PathLike[str], functions: Mapping[str, Callable[[Any], Any]] | None = None
) -> UncertainSystem | AugmentedSystem | Estimator:
    """Load what `save` wrote, or what was written by hand in its format.

    Parameters
    ----------
    path : str or path
        Ends in .toml or .json.
    functions : mapping of str to callable, optional
        The functions of the nonlinearities, by the names that the file gives them. A nonlinearity
        whose function is not among them has none: a design needs none.

    Returns
    -------
    UncertainSystem, AugmentedSystem or Estimator
        A `RobustSmoother` where the file holds a tau and multipliers: its guarantee is computed
        anew, and its gains are those of the file.

    Raises
    ------
    ValueError
        Where the file is not valid: one sentence that names the file and the field. That includes
        a robust design whose gains do not follow from its tau and multipliers.
    TypeError
        For functions that are not a mapping of names to callables.
    OSError
        Where the file cannot be read.
    """
    path, language = _language(path)
    functions = {} if functions is None else functions
    validation.instance("functions", functions, Mapping)
    for name, function in functions.items():
        if not callable(function):
            raise TypeError(f"functions[{name!r}] must be callable, got {function!r}")
    data = path.read_bytes()
    try:
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            return _Reader(functions).document(_parsed(data, language))
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ValueError(f"{path.name}: {error}") from None


def _language(path: str | os.PathLike[str]) -> tuple[Path, str]:
    path = Path(path)
    language = path.suffix[1:].lower()
    if language not in ("toml", "json"):
        raise ValueError(f"path must end in .toml or .json, got {path.name!r}")
    return path, language


# --- objects to fields ----------------------------------------------------------------------------


def _system_fields(system: UncertainSystem) -> dict:
    fields = {name: getattr(system, name) for name in ("A", "B1", "C0", "C2", "D21")}
    if system.uncertainties:
        fields["uncertainties"] = [{"B": c.B, "C": c.C, "D": c.D} for c in system.uncertainties]
    names = _function_names(system.nonlinearities)
    if system.nonlinearities:
        fields["nonlinearities"] = [
            {"B": c.B, "C": c.C, "D": c.D, "lipschitz": c.lipschitz}
            | ({} if name is None else {"function": name})
            | ({} if c.reference is None else {"reference": c.reference})
            for c, name in zip(system.nonlinearities, names, strict=True)
        ]
    return fields


def _plant_fields(plant: AugmentedSystem) -> dict:
    fields = {"delay": plant.delay, "order": plant.order}
    if plant.system.g:
        fields["J_21"] = plant.J_21
    return fields | {"system": _system_fields(plant.system)}


def _estimator_fields(estimator: Estimator) -> dict:
    fields = {
        name: validation.matrix(name, getattr(estimator, name), (None, None)) for name in _GAINS
    }
    if isinstance(estimator, RobustSmoother):
        names = ("tau", "multipliers", "cost", "bound")
        fields["design"] = {name: getattr(estimator, name) for name in names}
        _recomputed(estimator, **fields["design"])  # as `load` will have it
    return fields | {"plant": _plant_fields(estimator.plant)}


def _function_names(nonlinearities: Sequence[Nonlinearity]) -> list[str | None]:
    """Return the names of the functions, after checking that each stands for one function."""
    names: list[str | None] = []
    for i, channel in enumerate(nonlinearities):
        function = channel.function
        if function is None:
            names.append(None)
            continue
        name = getattr(function, "__qualname__", None) or type(function).__qualname__
        for j, other in enumerate(names):
            if other == name and nonlinearities[j].function != function:
                raise ValueError(
                    f"nonlinearities[{j}].function and nonlinearities[{i}].function must have "
                    f"names of their own to be saved, got two different ones called {name!r}"
                )
        names.append(name)
    return names


# --- fields to text -------------------------------------------------------------------------------


def _toml_document(content: Mapping) -> str:
    first = "# Of robsmooth: time in seconds, rates in 1/s, matrices by rows."
    return "\n".join([first, *_toml(content, "", content["kind"])]) + "\n"


def _toml(table: Mapping, prefix: str, kind: str) -> Iterator[str]:
    """Give the lines of a table: its values, then the tables in it."""
    if kind in _ABOUT:
        yield _ABOUT[kind]
    tables = {}
    for name, value in table.items():
        if isinstance(value, dict | list):
            tables[name] = value
        else:
            yield f"{name} = {_text(value)}"
    for name, value in tables.items():
        for member in value if isinstance(value, list) else [value]:
            yield ""
            yield f"[[{prefix}{name}]]" if isinstance(value, list) else f"[{prefix}{name}]"
            yield from _toml(member, f"{prefix}{name}.", name)


def _json(value: object, indent: str = "") -> str:
    if not isinstance(value, dict | list):
        return _text(value, indent)
    inner = indent + "  "
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    members = (
        [f'"{name}": {_json(member, inner)}' for name, member in value.items()]
        if isinstance(value, dict)
        else [_json(member, inner) for member in value]
    )
    return opening + ",".join(f"\n{inner}{m}" for m in members) + f"\n{indent}{closing}"


def _text(value: str | float | np.ndarray, indent: str = "") -> str:
    """Return a value as both languages write it, a matrix with one row a line."""
    if isinstance(value, str):
        printable = "".join(c if c.isprintable() else "?" for c in value)
        return json.dumps(printable, ensure_ascii=False)
    value = np.asarray(value)
    if value.ndim < 2:
        return repr(value.tolist())
    rows = [_text(row) for row in value]
    if len(rows) < 2:
        return "[" + "".join(rows) + "]"
    return "[" + ",".join(f"\n{indent}  {row}" for row in rows) + f"\n{indent}]"


# --- text to fields -------------------------------------------------------------------------------


def _parsed(data: bytes, language: str) -> object:
    text = data.decode("utf-8-sig")
    try:
        if language == "toml":
            return tomllib.loads(text)
        return json.loads(text, object_pairs_hook=_without_duplicates)
    except RecursionError:
        raise ValueError("its brackets are nested too deeply") from None


def _without_duplicates(pairs: list[tuple[str, object]]) -> dict:
    result = {}
    for name, value in pairs:
        if name in result:
            raise ValueError(f"{name!r} is there twice")
        result[name] = value
    return result


# --- fields to objects, each field named by its path in the file ----------------------------------


class _Reader:
    """Makes the objects of one file, and keeps which functions it names."""

    def __init__(self, functions: Mapping[str, Callable[[Any], Any]]) -> None:
        self.functions = functions
        self.named: set[str] = set()

    def document(self, content: object) -> UncertainSystem | AugmentedSystem | Estimator:
        """Return the object that the content of a file describes."""
        readers = {"system": self.system, "plant": self.plant, "estimator": self.estimator}
        if not isinstance(content, dict):
            raise ValueError(f"its content must be a table, got {reprlib.repr(content)}")
        fields = dict(content)
        for name in ("format", "kind", "units"):
            if name not in fields:
                raise ValueError(f"{name} is missing")
        version = validation.integer("format", fields.pop("format"), low=1)
        if version != FORMAT:
            raise ValueError(f"format must be {FORMAT}, got {version}: another version's file")
        kind = validation.choice("kind", fields.pop("kind"), tuple(readers))
        validation.choice("units", fields.pop("units"), ("SI",))
        result = readers[kind](fields)
        for name in self.functions:
            if name not in self.named:
                known = ", ".join(map(repr, sorted(self.named))) or "none"
                raise ValueError(f"functions has {name!r}, but the file names {known}")
        return result

    def system(self, table: object, path: str = "") -> UncertainSystem:
        """Return the system of a table, which `path` leads to."""
        matrices, lists = ("A", "B1", "C0", "C2", "D21"), ("uncertainties", "nonlinearities")
        _check_fields(path, table, matrices, lists)
        fields = {name: _matrix(f"{path}{name}", table[name]) for name in matrices}
        n = fields["A"].shape[1]
        for name, member in zip(lists, (self.uncertainty, self.nonlinearity), strict=True):
            members = table.get(name, [])
            if not isinstance(members, list):
                raise ValueError(f"{path}{name} must be a list of tables")
            fields[name] = [member(t, f"{path}{name}[{i}].", n) for i, t in enumerate(members)]
        with _within(path):
            return UncertainSystem(**fields)

    def uncertainty(self, table: object, path: str, n: int) -> Uncertainty:
        _check_fields(path, table, ("B", "C", "D"))
        with _within(path):
            return Uncertainty(**_channel(table, path, n))

    def nonlinearity(self, table: object, path: str, n: int) -> Nonlinearity:
        _check_fields(path, table, ("B", "C", "D", "lipschitz"), ("function", "reference"))
        name = table.get("function")
        if name is not None:
            if not isinstance(name, str):
                raise ValueError(f"{path}function must be a name, got {reprlib.repr(name)}")
            self.named.add(name)
        lipschitz = _number(f"{path}lipschitz", table["lipschitz"])
        channel = _channel(table, path, n)
        more = {"function": self.functions.get(name), "reference": table.get("reference")}
        with _within(path):
            return Nonlinearity(**channel, lipschitz=lipschitz, **more)

    def plant(self, table: object, path: str = "") -> AugmentedSystem:
        _check_fields(path, table, ("delay", "order", "system"), ("J_21",))
        system = self.system(table["system"], f"{path}system.")
        delay = _number(f"{path}delay", table["delay"])
        J_21 = _matrix(f"{path}J_21", table["J_21"]) if "J_21" in table else 1.0
        with _within(path):
            return compact(system, delay, table["order"], J_21=J_21)

    def estimator(self, table: object) -> Estimator:
        _check_fields("", table, (*_GAINS, "plant"), ("design",))
        plant = self.plant(table["plant"], "plant.")
        l, m, g = plant.system.l, plant.system.m, plant.system.g  # noqa: E741
        gains = {name: _matrix(name, table[name]) for name in _GAINS}
        n = len(gains["A_c"])
        shapes = ((n, n), (n, l + g), (m + g, n), (m, n), (m, n))
        for name, shape in zip(_GAINS, shapes, strict=True):
            validation.matrix(name, gains[name], shape)
        estimator = Estimator(plant=plant, **gains)
        return self.robust(table["design"], estimator) if "design" in table else estimator

    def robust(self, table: object, estimator: Estimator) -> RobustSmoother:
        """Return the robust design that an estimator is by its table."""
        _check_fields("design.", table, ("tau", "multipliers", "cost", "bound"))
        tau, bound = (_number(f"design.{name}", table[name]) for name in ("tau", "bound"))
        multipliers = _vector("design.multipliers", table["multipliers"])
        with _within("design: "):
            return _recomputed(estimator, tau, multipliers, table["cost"], bound)


def _recomputed(
    estimator: Estimator, tau: float, multipliers: Sequence[float], cost: str, bound: float
) -> RobustSmoother:
    """Return the robust design of a tau and multipliers, if it is the estimator with that bound."""
    design = limiting_smoother(estimator.plant, tau, multipliers, cost)
    gains = {name: getattr(estimator, name) for name in _GAINS}
    for name, given in {**gains, "bound": bound}.items():
        expected = getattr(design, name)
        size = np.abs(expected).max(initial=0.0)
        difference = np.abs(given - expected).max(initial=0.0)
        if not difference <= _SAME_DESIGN * size:
            raise ValueError(
                f"{name} does not follow from the tau and multipliers of the design: it is off by "
                f"{difference:.2g} where its size is {size:.2g}"
            )
    return replace(design, **gains)


def _check_fields(
    path: str, table: object, required: Sequence[str], optional: Sequence[str] = ()
) -> None:
    """Check that a table has all its fields and no other."""
    if not isinstance(table, dict):
        raise ValueError(f"{path.rstrip('.')} must be a table, got {reprlib.repr(table)}")
    known = {name.lower(): name for name in (*required, *optional)}
    for name in table:
        if name not in known.values():
            nearest = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.0)[0]
            raise ValueError(f"{path}{name} is not a field: the nearest is {known[nearest]}")
    for name in required:
        if name not in table:
            raise ValueError(f"{path}{name} is missing")


def _channel(table: dict, path: str, n: int) -> dict[str, Matrix]:
    columns = {"B": 0, "C": n, "D": 0}  # of a matrix without rows
    return {name: _matrix(f"{path}{name}", table[name], columns[name]) for name in columns}


def _matrix(path: str, value: object, columns: int = 0) -> Matrix:
    """Return a matrix from its list of rows; `columns` is for one without rows."""
    if not isinstance(value, list):
        raise ValueError(f"{path} must be a list of rows, got {reprlib.repr(value)}")
    rows = [_vector(f"{path}[{i}]", row) for i, row in enumerate(value)]
    widths = sorted({len(row) for row in rows}) or [columns]
    if len(widths) > 1:
        raise ValueError(f"{path} must have rows of one length, got {widths[0]} and {widths[-1]}")
    return validation.matrix(path, np.array(rows).reshape(len(rows), widths[0]), (None, None))


def _vector(path: str, value: object) -> list[float]:
    if not isinstance(value, list):
        raise ValueError(f"{path} must be a list of numbers, got {reprlib.repr(value)}")
    return [_number(f"{path}[{i}]", entry) for i, entry in enumerate(value)]


def _number(path: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{path} must be a number, got {reprlib.repr(value)}")
    try:
        return float(value)
    except OverflowError:
        return math.inf  # and refused as such


@contextmanager
def _within(path: str) -> Iterator[None]:
    """Put the path in front of the field's name in what a class says to its arguments."""
    try:
        yield
    except (ValueError, TypeError) as error:
        field = re.sub("^(Uncertainty|Nonlinearity) ", "", str(error))
        raise ValueError(f"{path}{field}") from None
    except ArithmeticError as error:
        raise ValueError(f"{path.rstrip('.: ')}: {error}") from None
