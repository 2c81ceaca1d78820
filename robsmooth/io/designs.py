"""Systems, plants and estimators in readable TOML or JSON files.

The names and units are those of the library's fields, and a matrix is a list of its rows. Every
number is read back bit for bit. A function is stored by its name, and `load` takes the functions by
their names. Nothing in a file is imported or run.
"""

import json
import math
import os
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robsmooth._support import files, validation
from robsmooth.estimators.conditions import COSTS, weights
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.minimax import ROUTES, MinimaxSmoother, certified_error
from robsmooth.estimators.smoother import RobustSmoother, limiting_smoother
from robsmooth.systems.augmented import AugmentedSystem, augment
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.functions import name_of
from robsmooth.systems.system import UncertainSystem

_LARGEST = 1 << 26  # bytes of a file: its designs have some thousand states

if TYPE_CHECKING:
    from robsmooth.estimators.discrete import DiscreteSmoother

    Saved = UncertainSystem | AugmentedSystem | Estimator | DiscreteSmoother


def save(value: "Saved", path: str | os.PathLike[str]) -> None:
    """Save a system, a plant, an estimator or a smoother of records to one readable file.

    Parameters
    ----------
    value : UncertainSystem, AugmentedSystem, Estimator or DiscreteSmoother
        The file has the plant of an estimator. It has the tau and multipliers of a
        `RobustSmoother`, from which the rest follows, the matrices and certificate of a
        `MinimaxSmoother`, the matrices of another estimator, and the name of a function. It says
        how a `DiscreteSmoother` was made, and not its state.
    path : str or path, ends in .toml or .json; the file appears whole or not at all

    Raises
    ------
    ValueError, TypeError
        For another suffix or kind, different functions of one name, or what `load` would refuse.
    OSError
        Where the file cannot be written.

    Examples
    --------
    >>> rs.save(rs.homodyne.PAPER.uncertain_system(), "system.toml")
    >>> rs.load("system.toml").A
    array([[-9140.]])
    """
    path, language = _language(path)
    settings, given = getattr(value, "made_with", None), value
    value = value if settings is None else value.estimator
    kind = next((kind for kind, made in _KINDS.items() if isinstance(value, made)), None)
    if kind is None:
        kinds = "an UncertainSystem, AugmentedSystem, Estimator or DiscreteSmoother"
        raise TypeError(f"value must be {kinds}, got {type(value).__name__}")
    if settings is not None and given.functions is not None:
        advice = "Nonlinearity(..., function=psi) takes them"
        raise ValueError(f"value must have no functions but those of its system: {advice}")
    content = {"format": 1, "kind": kind, "units": "SI", **_fields(kind, value)}
    there = _object(content, functions={})
    if isinstance(value, RobustSmoother) and not np.allclose(there.A_c, value.A_c, rtol=1e-6):
        raise ValueError("value must have the gains that follow from its tau and multipliers")
    if settings is not None:
        content["discrete"] = settings
    text = "\n".join(_toml(content, "")) if language == "toml" else _json(content)
    files.write_text(path, text + "\n")


def load(
    path: str | os.PathLike[str], functions: Mapping[str, Callable[[Any], Any]] | None = None
) -> "Saved":
    """Load what `save` or a user wrote to a file.

    The guarantee of a `RobustSmoother` or `MinimaxSmoother` is computed anew.

    Parameters
    ----------
    path : str or path, ends in .toml or .json
    functions : mapping of names in the file to callables, optional; a design needs none

    Raises
    ------
    ValueError
        For what is not valid, or does not give its certified error. It names the file and field.
    TypeError
        Where `functions` is not a mapping.
    OSError
        Where the file cannot be read.

    Examples
    --------
    >>> rs.save(rs.homodyne.PAPER.uncertain_system(), "system.json")
    >>> rs.load("system.json").n
    1
    """
    path, language = _language(path)
    if not path.exists():
        raise FileNotFoundError(f"path must be that of a file that exists, got {path}")
    if not (path.is_file() and path.stat().st_size <= _LARGEST):
        raise ValueError(f"path must be a file of at most {_LARGEST} bytes, no pipe, got {path}")
    functions = {} if functions is None else functions
    validation.instance("functions", functions, Mapping)
    try:
        text = path.read_bytes().decode("utf-8-sig")
        if max(part.count(".") for part in re.split("[=,\n]", text)) > 99:  # a.a.a.a = 1
            raise RecursionError
        return _object(_READERS[language](text), functions)
    except RecursionError:
        raise ValueError(f"{path.name}: its brackets are nested too deeply") from None
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path.name}: {validation.line(error, 400)}") from None


def _language(path: str | os.PathLike[str]) -> tuple[Path, str]:
    path = validation.path("path", path)
    language = path.suffix[1:].lower()
    if language not in _READERS:
        raise ValueError(f"path must end in .toml or .json, got {validation.shown(path.name)}")
    return path, language


def _distinct(pairs: list[tuple[str, object]]) -> dict:
    """Return a table of JSON, each name of which must be there once."""
    if len({name for name, _ in pairs}) < len(pairs):
        raise ValueError(f"one of {', '.join(name for name, _ in pairs)} is there twice")
    return dict(pairs)


_READERS = {"toml": tomllib.loads, "json": partial(json.loads, object_pairs_hook=_distinct)}


def _object(content: object, functions: Mapping[str, Callable]) -> Any:
    """Return the object that the content of a file describes."""
    if not isinstance(content, dict):
        raise ValueError(f"its content must be a table, got {validation.shown(content)}")
    header = {"format": (1,), "kind": tuple(_KINDS), "units": ("SI",)}
    validation.integer("format", content.get("format", 1), low=1)  # True is none
    for name, allowed in header.items():
        validation.choice(name, content.get(name), allowed)
    named: dict[str, None] = {}

    def of_table(name: str, table: object, path: str) -> Any:
        make, names = _TABLES[name]
        known = names.split()
        if not isinstance(table, dict):
            raise ValueError(f"{path[:-1]} must be a table, got {validation.shown(table)}")
        for field in table:
            if field not in known:
                raise ValueError(f"{path}{field} is not a field: these are {', '.join(known)}")
        for field in known:
            if field not in table and field not in _OPTIONAL.split():
                raise ValueError(f"{path}{field} is missing")
        fields = {field: of_field(field, part, f"{path}{field}") for field, part in table.items()}
        with _within(path[:-1]), np.errstate(over="raise", invalid="raise", divide="raise"):
            return make(**fields)

    def of_field(name: str, value: object, path: str) -> Any:
        if name in ("uncertainties", "nonlinearities", "nominal"):
            if not isinstance(value, list):
                raise ValueError(f"{path} must be a list of tables, got {validation.shown(value)}")
            return [of_table(name, table, f"{path}[{i}].") for i, table in enumerate(value)]
        if name in _TABLES:
            return of_table(name, value, f"{path}.")
        if name == "function":
            if not isinstance(value, str):
                raise ValueError(f"{path} must be a name, got {validation.shown(value)}")
            named[value] = None
            return functions.get(value)
        return _numbers(value, path) if isinstance(value, list) else value

    fields = {name: part for name, part in content.items() if name not in header}
    is_estimator = issubclass(_KINDS[content["kind"]], Estimator)
    discrete = fields.pop("discrete", None) if is_estimator else None
    result = of_table(content["kind"], fields, "")
    if discrete is not None:
        settings = of_table("discrete", discrete, "discrete.")
        with _within("discrete"):
            result = result.discretize(**settings)
    for name in functions:
        if name not in named:
            known = ", ".join(map(repr, named)) or "none"
            raise ValueError(f"functions has {validation.shown(name)}, but the file names {known}")
    return result


def _numbers(value: object, path: str) -> Any:
    """Return nested lists of finite numbers; the class that takes them checks their shape."""
    if isinstance(value, list):
        return [_numbers(member, f"{path}[{i}]") for i, member in enumerate(value)]
    if type(value) not in (int, float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{path} must be a finite number, got {validation.shown(value)}")
    return float(value)


@contextmanager
def _within(place: str) -> Iterator[None]:
    """Put the place in the file in front of an error."""
    try:
        yield
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ValueError(f"{place}: {error}" if place else str(error)) from None


def _estimator(plant: AugmentedSystem, nominal: list | None = None, **gains: Any) -> Estimator:
    if nominal is not None and len(nominal) != 2:
        raise ValueError(f"nominal must be two systems, of model and gain, got {len(nominal)}")
    result = Estimator(plant=plant, **gains)
    return result if nominal is None else result.of_nominal(*nominal)


def _minimax_smoother(
    plant: AugmentedSystem, certified: float, multipliers: list, cost: str, route: str, **gains: Any
) -> MinimaxSmoother:
    """Return a minimax smoother after certifying its error anew."""
    smoother = MinimaxSmoother(
        plant=plant,
        **gains,
        certified=validation.positive("certified", certified),
        multipliers=weights("multipliers", plant, multipliers),
        cost=validation.choice("cost", cost, COSTS),
        route=validation.choice("route", route, ROUTES),
    )
    with _within("multipliers certify no finite error"):
        found = certified_error(smoother)
    if not math.isclose(found, certified, rel_tol=1e-6):
        given = f"which give {found:.6g}, got {certified:.6g}"
        raise ValueError(f"certified must follow from the multipliers, {given}")
    return smoother


_GAINS = "A_c B_c C_c C_a C_f"
_KINDS = {  # from the kind in a file to its class, subclasses first
    "robust smoother": RobustSmoother,
    "minimax smoother": MinimaxSmoother,
    "estimator": Estimator,
    "plant": AugmentedSystem,
    "system": UncertainSystem,
}
# The function that makes the object of a table, and the table's fields.
_TABLES = {
    "robust smoother": (limiting_smoother, "tau multipliers cost plant"),
    "minimax smoother": (_minimax_smoother, f"{_GAINS} certified multipliers cost route plant"),
    "estimator": (_estimator, f"{_GAINS} nominal plant"),
    "plant": (augment, "system delay order J_21"),
    "system": (UncertainSystem, "A B1 C0 C2 D21 B2 D22 uncertainties nonlinearities"),
    "nominal": (UncertainSystem, "A B1 C0 C2 D21"),
    "discrete": (dict, "dt delay mean offset samples"),
    "uncertainties": (Uncertainty, "B C D"),
    "nonlinearities": (Nonlinearity, "B C D lipschitz function reference"),
}
_OPTIONAL = "uncertainties nonlinearities function reference J_21 nominal B2 D22"
_OPTIONAL += " mean offset samples"


def _fields(kind: str, value: Any) -> dict:
    fields = {}
    for name in _TABLES[kind][1].split():
        part = getattr(value, name)
        if name == "nonlinearities":
            named: dict[str, Callable] = {}
            for i, psi in enumerate(channel.function for channel in part):
                if psi is not None and named.setdefault(name_of(psi), psi) != psi:
                    what = f"nonlinearities[{i}].function must have a name of its own to be saved"
                    raise ValueError(f"{what}, got {name_of(psi)!r}, which another one has")
        if isinstance(part, tuple):
            part = [_fields(name, member) for member in part]
        elif name in _TABLES and part is not None:
            part = _fields(name, part)
        elif name == "function":
            part = part and name_of(part)
        else:
            part = np.asarray(part).tolist()
        if name not in _OPTIONAL.split() or (part is not None and np.size(part)):
            fields[name] = part
    return fields


def _toml(table: Mapping, prefix: str) -> Iterator[str]:
    """Yield the lines of a table: its values, then its inner tables."""
    yield from (f"{name} = {_json(table[name])}" for name in table if name not in _TABLES)
    for name in filter(_TABLES.get, table):
        several = isinstance(table[name], list)
        for member in table[name] if several else [table[name]]:
            yield f"\n[[{prefix}{name}]]" if several else f"\n[{prefix}{name}]"
            yield from _toml(member, f"{prefix}{name}.")


def _json(value: object) -> str:
    """Return a value as JSON (and TOML, where it has no names), a row of a matrix on a line."""
    text = json.dumps(value, indent=2, ensure_ascii=False)
    text = re.sub(r"\[\n([-+.\de,\s]+)\n *\]", lambda row: f"[{' '.join(row[1].split())}]", text)
    return re.sub(r"\[\n *(\[.*\])\n *\]", r"[\1]", text)  # a single row
