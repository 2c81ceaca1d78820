"""From the text of a file to its system, plant or estimator; errors name the field by its path."""

import difflib
import json
import math
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from robsmooth._support import validation
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.limit import limiting_smoother
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.systems.augmented import AugmentedSystem, augment
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.system import UncertainSystem

FORMAT = 1
GAINS = ("A_c", "B_c", "C_c", "C_a", "C_f")
_DESIGN_TOLERANCE = 1e-6  # largest relative difference of a stored design to its parameters' own


def parsed(data: bytes, language: str) -> object:
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


class Reader:
    """Makes the objects of one file, and keeps which functions it names."""

    def __init__(self, functions: Mapping[str, Callable]):
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
                known = ", ".join(map(repr, sorted(self.named - {None}))) or "none"
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
        """Return the uncertainty of a table, of a system with n states."""
        _check_fields(path, table, ("B", "C", "D"))
        with _within(path):
            return Uncertainty(**_channel(table, path, n))

    def nonlinearity(self, table: object, path: str, n: int) -> Nonlinearity:
        """Return the nonlinearity of a table, of a system with n states."""
        _check_fields(path, table, ("B", "C", "D", "lipschitz"), ("function", "reference"))
        name = table.get("function")
        if not isinstance(name, str | None):
            raise ValueError(f"{path}function must be a name, got {reprlib.repr(name)}")
        self.named.add(name)
        lipschitz = _numbers(f"{path}lipschitz", table["lipschitz"], 0)
        channel = _channel(table, path, n)
        more = {"function": self.functions.get(name), "reference": table.get("reference")}
        with _within(path):
            return Nonlinearity(**channel, lipschitz=lipschitz, **more)

    def plant(self, table: object, path: str = "") -> AugmentedSystem:
        """Return the plant of a table, which `path` leads to."""
        _check_fields(path, table, ("delay", "order", "system"), ("J_21",))
        system = self.system(table["system"], f"{path}system.")
        delay = _numbers(f"{path}delay", table["delay"], 0)
        J_21 = _matrix(f"{path}J_21", table["J_21"]) if "J_21" in table else 1.0
        with _within(path):
            return augment(system, delay, table["order"], J_21=J_21)

    def estimator(self, table: object) -> Estimator:
        """Return the estimator of a table, a robust design where it has the parameters of one."""
        _check_fields("", table, (*GAINS, "plant"), ("design",))
        plant = self.plant(table["plant"], "plant.")
        gains = {name: _matrix(name, table[name]) for name in GAINS}
        n, m, g = len(gains["A_c"]), plant.system.m, plant.system.g
        shapes = ((n, n), (n, plant.system.l + g), (m + g, n), (m, n), (m, n))
        for name, shape in zip(GAINS, shapes, strict=True):
            validation.matrix(name, gains[name], shape)
        estimator = Estimator(plant=plant, **gains)
        if "design" not in table:
            return estimator
        design = table["design"]
        _check_fields("design.", design, ("tau", "multipliers", "cost", "bound"))
        tau, bound = (_numbers(f"design.{name}", design[name], 0) for name in ("tau", "bound"))
        multipliers = _numbers("design.multipliers", design["multipliers"], 1)
        with _within("design: "):
            return recomputed(estimator, tau, multipliers, design["cost"], bound)


def recomputed(
    estimator: Estimator, tau: float, multipliers: Sequence[float], cost: str, bound: float
) -> RobustSmoother:
    """Return the robust design of a tau and multipliers, if it is the estimator with that bound."""
    design = limiting_smoother(estimator.plant, tau, multipliers, cost)
    gains = {name: getattr(estimator, name) for name in GAINS}
    for name, given in {**gains, "bound": bound}.items():
        expected = getattr(design, name)
        size = np.abs(expected).max(initial=0.0)
        difference = np.abs(given - expected).max(initial=0.0)
        if not difference <= _DESIGN_TOLERANCE * size:
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
    rows = _numbers(path, value, 2)
    widths = sorted({len(row) for row in rows}) or [columns]
    if len(widths) > 1:
        raise ValueError(f"{path} must have rows of one length, got {widths[0]} and {widths[-1]}")
    return validation.matrix(path, np.array(rows).reshape(len(rows), widths[0]), (None, None))


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
