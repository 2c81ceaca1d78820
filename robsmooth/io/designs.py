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

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robsmooth._support import files, validation
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.io.design_reader import FORMAT, GAINS, Reader, parsed, recomputed
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.channels import Nonlinearity
from robsmooth.systems.system import UncertainSystem

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
    for kind, (made, fields) in _KINDS.items():
        if isinstance(value, made):
            content = {"format": FORMAT, "kind": kind, "units": "SI", **fields(value)}
            toml = [_FIRST, *_toml(content, "", kind)]
            lines = toml if language == "toml" else [_json(content)]
            return files.write_text(path, "\n".join([*lines, ""]))
    kinds = "an UncertainSystem, AugmentedSystem or Estimator"
    raise TypeError(f"value must be {kinds}, got {type(value).__name__}")


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
            return Reader(functions).document(parsed(data, language))
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
    J_21 = {"J_21": plant.J_21} if plant.system.g else {}
    system = _system_fields(plant.system)
    return {"delay": plant.delay, "order": plant.order, **J_21, "system": system}


def _estimator_fields(estimator: Estimator) -> dict:
    fields = {
        name: validation.matrix(name, getattr(estimator, name), (None, None)) for name in GAINS
    }
    if isinstance(estimator, RobustSmoother):
        names = ("tau", "multipliers", "cost", "bound")
        fields["design"] = {name: getattr(estimator, name) for name in names}
        recomputed(estimator, **fields["design"])  # as `load` will have it
    return fields | {"plant": _plant_fields(estimator.plant)}


_KINDS = {
    "system": (UncertainSystem, _system_fields),
    "plant": (AugmentedSystem, _plant_fields),
    "estimator": (Estimator, _estimator_fields),
}


def _function_names(nonlinearities: Sequence[Nonlinearity]) -> list[str | None]:
    """Return the names of the functions, after checking that each stands for one function."""
    named: dict[str, int] = {}
    names: list[str | None] = []
    for i, function in enumerate(channel.function for channel in nonlinearities):
        called = getattr(function, "__name__", type(function).__qualname__)  # NumPy's, before 2.2
        name = None if function is None else getattr(function, "__qualname__", called)
        names.append(name)
        first = named.setdefault(name, i)
        if nonlinearities[first].function != function:
            raise ValueError(
                f"nonlinearities[{first}].function and nonlinearities[{i}].function must have "
                f"names of their own to be saved, got two different ones called {name!r}"
            )
    return names


# --- fields to text -------------------------------------------------------------------------------


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
