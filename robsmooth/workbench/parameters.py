"""A notebook's parameters, read from its cell tagged `parameters` and checked against it.

A line is such as `lag: float = 3.1e-6  # (0, 1e-3] s, of smoothing`. The comment may open with the
interval that is allowed; its ends may be `inf`. papermill checks neither names nor types, and its
own reader skips a comment with an equals sign.
"""

import ast
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from robsmooth._support import validation

TYPES = {"bool": (bool,), "int": (int,), "float": (float, int), "str": (str,)}
# The pipeline sets these for each run; no result depends on them.
OPTIONAL = {"scheduler": "str", "allow_insecure": "bool", "checkpoint_dir": "str"}
SET_BY_PIPELINE = {"output_dir": "str", "data_dir": "str", **OPTIONAL}

_INTERVAL = re.compile(r"([\[(])\s*([^\s,]+)\s*,\s*([^\s,]+?)\s*([\])])\s*")


class PipelineError(ValueError):
    """A request that cannot be met; nothing has been run."""


class Parameter(NamedTuple):
    """One line of the parameters cell."""

    name: str
    type: str
    default: object
    interval: dict  # what is allowed, as arguments of `validation.real`

    def check(self, value: object, where: str) -> object:
        """Return `value` in this parameter's type; a `PipelineError` says why it cannot be."""
        try:
            if type(value) not in TYPES[self.type]:
                given = f"{value!r:.60} ({type(value).__name__})"
                raise ValueError(f"{self.name} must be of type {self.type}, got {given}")
            if self.type in ("int", "float"):
                validation.real(self.name, value, **self.interval)
            str(value).encode()  # a text that is not Unicode cannot be written to the notebook
        except ValueError as error:
            raise PipelineError(f"{where}: {error!s:.300}") from None
        return TYPES[self.type][0](value)


def code_cells(notebook: Path) -> list[Any]:
    """Return the cells of a notebook that hold code."""
    import nbformat

    try:
        nbformat.validate(json.loads(notebook.read_bytes()))
        cells = nbformat.read(notebook, as_version=4).cells
    except Exception as error:  # nbformat has no error of its own for what a file may hold
        why = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise PipelineError(f"{notebook.name}: not a readable notebook ({why})") from error
    return [cell for cell in cells if cell.cell_type == "code"]


def read(notebook: Path) -> dict[str, Parameter]:
    """Parameters of a notebook by name, their defaults checked."""
    code = code_cells(notebook)
    tagged = [cell.source for cell in code if "parameters" in cell.metadata.get("tags", [])]
    if len(tagged) != 1:
        message = f"exactly one code cell must be tagged parameters, not {len(tagged)}"
        raise PipelineError(f"{notebook.name}: {message}")
    parameters = {each.name: each for each in _lines(tagged[0], notebook)}
    for each in parameters.values():
        each.check(each.default, f"{notebook.name}, default")
    types = OPTIONAL | {name: each.type for name, each in parameters.items()}
    for name, kind in SET_BY_PIPELINE.items():
        if types.get(name) != kind:
            raise PipelineError(f"{notebook.name}: the parameters cell must hold {name}: {kind}")
    return parameters


def check(
    parameters: Mapping[str, Parameter], values: Mapping[str, object], where: str
) -> dict[str, object]:
    """Return `values`, with their names, types and ranges checked against `parameters`."""
    for name in values:
        if name in SET_BY_PIPELINE:
            raise PipelineError(f"{where}: {name} is set by the pipeline and cannot be given")
        if name not in parameters:
            raise unknown(f"{where}: parameter", name, {*parameters} - {*SET_BY_PIPELINE})
    return {name: parameters[name].check(value, where) for name, value in values.items()}


def unknown(what: str, name: str, known: Iterable[str]) -> PipelineError:
    """Return the error for a name that is not in `known`."""
    names = ", ".join(sorted(known)) or "none"
    return PipelineError(f"{what} {name:.60} is unknown; known: {names}")


def _lines(source: str, notebook: Path) -> Iterable[Parameter]:
    where = f"{notebook.name}, parameters cell"
    try:
        statements = ast.parse(source).body
    except Exception as error:  # not only a SyntaxError: of too deep a text, too
        line = getattr(error, "lineno", None) or 1
        raise PipelineError(f"{where}: line {line} is not Python") from error
    for statement in statements:
        match statement:
            case ast.AnnAssign(ast.Name(name), ast.Name(kind), value) if value and kind in TYPES:
                line = source.splitlines()[statement.end_lineno - 1].encode()
                comment = line[statement.end_col_offset :].decode().strip().lstrip("# ")
                try:
                    yield Parameter(name, kind, ast.literal_eval(value), _interval(comment))
                except Exception as error:
                    raise PipelineError(f"{where}: {name}: {error!s:.300}") from error
            case _:
                form = f"name: type = value  # comment, with type one of {', '.join(TYPES)}"
                raise PipelineError(f"{where}: line {statement.lineno} must read {form}")


def _interval(comment: str) -> dict:
    if found := _INTERVAL.match(comment):
        low, high = float(found[2]), float(found[3])
        ends = ((low, found[1] == "("), (high, found[4] == ")"))
        return {"low": low, "high": high, "without": [end for end, is_open in ends if is_open]}
    if comment[:1] in set("(["):
        raise ValueError(f"the comment must open with [low, high], got {comment:.60}")
    return {}
