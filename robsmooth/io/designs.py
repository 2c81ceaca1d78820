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
from robsmooth.systems.augmented import AugmentedSystem, augment
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.functions import name_of
from robsmooth.systems.system import UncertainSystem

_FORMAT = 1
_SAVED = {"system": UncertainSystem, "plant": AugmentedSystem, "estimator": Estimator}
_GAINS = ("A_c", "B_c", "C_c", "C_a", "C_f")
_FIELDS = {  # of each table, and which of them may be left out
    "system": ("A", "B1", "C0", "C2", "D21", "uncertainties", "nonlinearities"),
    "uncertainties": ("B", "C", "D"),
    "nonlinearities": ("B", "C", "D", "lipschitz", "function", "reference"),
    "plant": ("delay", "order", "J_21", "system"),
    "estimator": (*_GAINS, "design", "plant"),
    "design": ("tau", "multipliers", "cost", "bound"),
}
_OPTIONAL = ("uncertainties", "nonlinearities", "function", "reference", "J_21", "design")
_LISTS = ("uncertainties", "nonlinearities")
_DEPTHS = {"lipschitz": 0, "delay": 0, "tau": 0, "bound": 0, "multipliers": 1}  # else matrices
_DESIGN_TOLERANCE = 1e-6  # largest relative difference of a stored design to its parameters' own

_FIRST = "# Of robsmooth: time in seconds, rates in 1/s, matrices by rows."
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
        multipliers, cost and bound, too. Of a nonlinearity's function the name is saved.
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

    See Also
    --------
    load : reads the file.

    Examples
    --------
    >>> import tempfile
    >>> import robsmooth as rs
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     rs.save(rs.homodyne.PAPER.uncertain_system(), folder + "/system.toml")
    ...     rs.load(folder + "/system.toml").A
    array([[-9140.]])
    """
    path, language = _language(path)
    kind = next((kind for kind, made in _SAVED.items() if isinstance(value, made)), None)
    if kind is None:
        kinds = "an UncertainSystem, AugmentedSystem or Estimator"
        raise TypeError(f"value must be {kinds}, got {type(value).__name__}")
    content = {"format": _FORMAT, "kind": kind, "units": "SI", **_content(kind, value)}
    if kind == "estimator":
        _estimator(
            value.plant,
            **{name: getattr(value, name) for name in _GAINS},
            design=content.get("design"),
        )
    lines = [_FIRST, *_toml(content, "", kind)] if language == "toml" else [_json(content)]
    files.write_text(path, "\n".join([*lines, ""]))


def load(
    path: str | os.PathLike[str], functions: Mapping[str, Callable[[Any], Any]] | None = None
) -> UncertainSystem | AugmentedSystem | Estimator:
    """Load what `save` wrote, or what was written by hand in its format.

    Parameters
    ----------
    path : str or path, ends in .toml or .json
    functions : mapping of str to callable, optional
        The functions of the nonlinearities, by the names that the file gives them. A design needs
        none.

    Returns
    -------
    UncertainSystem, AugmentedSystem or Estimator
        A `RobustSmoother` where the file holds one: its guarantee is computed anew.

    Raises
    ------
    ValueError
        Where the file is not valid, or gains do not follow from the tau and multipliers of their
        design: one sentence that names the file and the field.
    TypeError
        For functions that are not a mapping of names to callables.
    OSError
        Where the file cannot be read.

    See Also
    --------
    save : writes the file.

    Examples
    --------
    >>> import tempfile
    >>> import robsmooth as rs
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     rs.save(rs.homodyne.PAPER.uncertain_system(), folder + "/system.json")
    ...     rs.load(folder + "/system.json").n
    1
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


def _content(kind: str, value: Any) -> dict:
    """Return the fields of an object's table."""
    content = {}
    for name in _FIELDS[kind]:
        part = value if name == "design" else getattr(value, name)
        if name == "design" and not isinstance(part, RobustSmoother):
            continue
        if name in _OPTIONAL and (part is None or np.size(part) == 0):
            continue
        if name == "nonlinearities":
            _check_names([c.function for c in part])
        if name in _LISTS:
            part = [_content(name, member) for member in part]
        elif name in _FIELDS:
            part = _content(name, part)
        content[name] = name_of(part) if name == "function" else part
    return content


def _check_names(functions: Sequence[Callable | None]) -> None:
    """Check that each name stands for one function."""
    named: dict[str | None, int] = {}
    for i, function in enumerate(functions):
        name = function and name_of(function)
        first = named.setdefault(name, i)
        if functions[first] != function:
            raise ValueError(
                f"nonlinearities[{first}].function and nonlinearities[{i}].function must have "
                f"names of their own to be saved, got two different ones called {name!r}"
            )


def _toml(table: Mapping, prefix: str, kind: str) -> Iterator[str]:
    """Give the lines of a table: its values, then the tables in it."""
    if kind in _ABOUT:
        yield _ABOUT[kind]
    tables = {name: value for name, value in table.items() if isinstance(value, dict | list)}
    for name, value in table.items():
        if name not in tables:
            yield f"{name} = {_json(value)}"
    for name, value in tables.items():
        opening, closing = ("[[", "]]") if isinstance(value, list) else ("[", "]")
        for member in value if isinstance(value, list) else [value]:
            yield f"\n{opening}{prefix}{name}{closing}"
            yield from _toml(member, f"{prefix}{name}.", name)


def _json(value: object, indent: str = "") -> str:
    """Return a value as JSON, without names as TOML, too; a matrix has one row a line."""
    if isinstance(value, str):
        printable = "".join(c if c.isprintable() else "?" for c in value)
        return json.dumps(printable, ensure_ascii=False)
    inner = indent + "  "
    brackets = "{}" if isinstance(value, dict) else "[]"
    if isinstance(value, dict):
        members = [f'"{name}": {_json(member, inner)}' for name, member in value.items()]
    elif isinstance(value, list):
        members = [_json(member, inner) for member in value]
    elif np.ndim(value) == 2 and len(value) > 1:
        members = map(repr, value.tolist())
    else:
        return repr(np.asarray(value).tolist())
    body = ",".join(f"\n{inner}{member}" for member in members)
    return f"{brackets[0]}{body}\n{indent}{brackets[1]}"


def _parsed(data: bytes, language: str) -> object:
    """Return the content of a file in "toml" or "json"."""
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


class _Reader:
    """Makes the objects of one file; its errors name the field by its path."""

    def __init__(self, functions: Mapping[str, Callable]):
        self.functions = functions
        self.named: set[str] = set()  # the functions that the file names

    def document(self, content: object) -> Any:
        """Return the object that the content of a file describes."""
        if not isinstance(content, dict):
            raise ValueError(f"its content must be a table, got {reprlib.repr(content)}")
        fields = dict(content)
        for name in ("format", "kind", "units"):
            if name not in fields:
                raise ValueError(f"{name} is missing")
        version = validation.integer("format", fields.pop("format"), low=1)
        if version != _FORMAT:
            raise ValueError(f"format must be {_FORMAT}, got {version}: another version's file")
        kind = validation.choice("kind", fields.pop("kind"), tuple(_SAVED))
        validation.choice("units", fields.pop("units"), ("SI",))
        result = self.object(kind, fields, "")
        for name in self.functions:
            if name not in self.named:
                known = ", ".join(map(repr, sorted(self.named))) or "none"
                raise ValueError(f"functions has {name!r}, but the file names {known}")
        return result

    def object(self, kind: str, table: object, path: str) -> Any:
        """Return the object of a table, which `path` leads to."""
        if not isinstance(table, dict):
            raise ValueError(f"{path.rstrip('.')} must be a table, got {reprlib.repr(table)}")
        known = {name.lower(): name for name in _FIELDS[kind]}
        for name in table:
            if name not in known.values():
                nearest = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.0)[0]
                raise ValueError(f"{path}{name} is not a field: the nearest is {known[nearest]}")
        for name in _FIELDS[kind]:
            if name not in table and name not in _OPTIONAL:
                raise ValueError(f"{path}{name} is missing")
        fields = {name: self.field(name, value, f"{path}{name}") for name, value in table.items()}
        with _within(path):
            return _MAKERS[kind](**fields)

    def field(self, name: str, value: Any, path: str) -> Any:
        """Return the value of a field: its class checks what is not checked here."""
        if name in _LISTS:
            if not isinstance(value, list):
                raise ValueError(f"{path} must be a list of tables")
            return [self.object(name, table, f"{path}[{i}].") for i, table in enumerate(value)]
        if name in _FIELDS:
            return self.object(name, value, f"{path}.")
        if name == "function":
            if not isinstance(value, str):
                raise ValueError(f"{path} must be a name, got {reprlib.repr(value)}")
            self.named.add(value)
            return self.functions.get(value)
        if name in ("order", "reference", "cost"):
            return value
        return _numbers(path, value, _DEPTHS[name]) if name in _DEPTHS else _matrix(path, value)


def _uncertainty(B: Matrix, C: Matrix, D: Matrix) -> Uncertainty:
    """Return an uncertainty; a C without rows has no columns in a file."""
    return Uncertainty(B, C if len(C) else np.zeros((0, len(B))), D)


def _estimator(plant: AugmentedSystem, design: dict | None = None, **gains: Matrix) -> Estimator:
    """Return an estimator, a robust design where there are the parameters of one."""
    n, m, g = len(gains["A_c"]), plant.system.m, plant.system.g
    shapes = ((n, n), (n, plant.system.l + g), (m + g, n), (m, n), (m, n))
    for name, shape in zip(_GAINS, shapes, strict=True):
        gains[name] = validation.matrix(name, gains[name], shape)
    if design is None:
        return Estimator(plant=plant, **gains)
    with _within("design: "):
        smoother = limiting_smoother(plant, design["tau"], design["multipliers"], design["cost"])
    for name, given in {**gains, "bound": design["bound"]}.items():
        expected = getattr(smoother, name)
        size = np.abs(expected).max(initial=0.0)
        difference = np.abs(given - expected).max(initial=0.0)
        if not difference <= _DESIGN_TOLERANCE * size:
            raise ValueError(
                f"{name} does not follow from the tau and multipliers of the design: it is off by "
                f"{difference:.2g} where its size is {size:.2g}"
            )
    return replace(smoother, **gains)


_MAKERS = {
    "system": UncertainSystem,
    "uncertainties": _uncertainty,
    "nonlinearities": Nonlinearity,
    "plant": augment,
    "estimator": _estimator,
    "design": dict,
}


def _matrix(path: str, value: object) -> Matrix:
    """Return a matrix from its list of rows."""
    rows = _numbers(path, value, 2)
    widths = sorted({len(row) for row in rows}) or [0]
    if len(widths) > 1:
        raise ValueError(f"{path} must have rows of one length, got {widths[0]} and {widths[-1]}")
    return np.array(rows).reshape(len(rows), widths[0])


def _numbers(path: str, value: object, depth: int) -> Any:
    """Return a float, or of depth 1 a list of floats, or of depth 2 a list of rows of floats."""
    if depth > 0:
        if not isinstance(value, list):
            what = ("numbers", "rows")[depth - 1]
            raise ValueError(f"{path} must be a list of {what}, got {reprlib.repr(value)}")
        return [_numbers(f"{path}[{i}]", entry, depth - 1) for i, entry in enumerate(value)]
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
