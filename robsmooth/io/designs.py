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

    See Also
    --------
    load : Reads the file.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "filter.toml")
    ...     rs.save(rs.baselines.kalman_bucy(system), path)
    ...     print("kind = " in path.read_text())
    True
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

    See Also
    --------
    save : Writes the file.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "system.toml")
    ...     rs.save(system, path)
    ...     loaded = rs.load(path)
    >>> loaded.A
    array([[-1.]])
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
    fields = {"delay": plant.delay, "order": plant.order}
    if plant.system.g:
        fields["J_21"] = plant.J_21
    return fields | {"system": _system_fields(plant.system)}


def _estimator_fields(estimator: Estimator) -> dict:
    fields = {
        name: validation.matrix(name, getattr(estimator, name), (None, None)) for name in GAINS
    }
    if isinstance(estimator, RobustSmoother):
        names = ("tau", "multipliers", "cost", "bound")
        fields["design"] = {name: getattr(estimator, name) for name in names}
        recomputed(estimator, **fields["design"])  # as `load` will have it
    return fields | {"plant": _plant_fields(estimator.plant)}


def _function_names(nonlinearities: Sequence[Nonlinearity]) -> list[str | None]:
    """Return the names of the functions, after checking that each stands for one function."""
    names: list[str | None] = []
    for i, channel in enumerate(nonlinearities):
        function = channel.function
        if function is None:
            names.append(None)
            continue
        called = getattr(function, "__name__", type(function).__qualname__)  # NumPy's, before 2.2
        name = getattr(function, "__qualname__", called)
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
