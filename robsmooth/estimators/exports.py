"""Exports of an estimator in discrete time: matrices, python-control, C.

In C, each set of missing measurements has its sums of products. The state moves by its change,
``x + (Phi - 1) x``, so that single precision does not lose a slow mode.
"""

import copy
import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robsmooth._support import files, validation
from robsmooth.systems.system import state_space

Floats = NDArray[np.float64]
Texts = Sequence[str | None] | None
_MOST_CHANNELS = 4  # each set of missing ones has its own sums
_ROWS = 200  # of the test record
_EXPRESSION = r"[\w\s.,+*/()?:<>=&|!-]+"
_PSI = "\nstatic real psi{}(real x)\n{{\n    return (real)({});\n}}\n"
_HEADER = """\
/* {name}: estimates from samples every {dt:g} s, by robsmooth. */
#ifndef {name}_h
#define {name}_h
typedef {real} {name}_real;
typedef struct {{ {name}_real x[{n}]; }} {name}_state; /* what is kept between samples */

/* Begin a record. */
void {name}_init({name}_state *s);

/* Take a sample y[{l}], NAN where a measurement is missing{taken}.
   Write the estimates of w, smoothed[{m}] one delay back and filtered[{m}] now. Return 0; or 1,
   with nothing changed, where the state would leave the range of numbers. */
int {name}_step({name}_state *s, const {name}_real *y{reference},
    {name}_real *smoothed, {name}_real *filtered);
#endif
"""
_CODE = """\
/* {name}: estimates from samples every {dt:g} s, by robsmooth.
   A step takes at most {counts}.
   Compile without -ffast-math: NAN marks what is missing. */
#include <math.h>
#include "{name}.h"

typedef {name}_real real;
{functions}
void {name}_init({name}_state *s)
{{
    *s = ({name}_state){{{{0}}}};
}}

int {name}_step({name}_state *s, const real *y{reference},
    real *smoothed, real *filtered)
{{
    real *x = s->x, next[{n}] = {{0}}, u[{l}];
    int missing = 0;
    for (int i = 0; i < {l}; i++)
        missing = 2 * missing + (isnan(y[i]) ? 1 : 0);
    {begin}
    switch (missing) {{
    {cases}
    }}
    for (int i = 0; i < {n}; i++)
        if (!isfinite(next[i]))
            return 1;
    for (int i = 0; i < {n}; i++)
        x[i] = next[i];
    {reads}
    return 0;
}}

#ifdef ROBSMOOTH_TEST
#include <stdio.h>

/* Run a record such as {name}.csv; print how far estimates are off, of the largest in that one. */
int main(int count, char **names)
{{
    static const double largest[] = {{{largest}}};
    double row[{columns}], off = 0;
    real given[{columns}], found[2 * {m}];
    {name}_state s;
    FILE *record = count == 2 ? fopen(names[1], "r") : 0;
    if (!record || fscanf(record, "%*[^\\n]") == EOF)
        return 1;
    {name}_init(&s);
    for (int at = 0; fscanf(record, at ? ",%lf" : "%lf", row + at) == 1;) {{
        given[at] = (real)row[at];
        at = (at + 1) % {columns};
        if (at == 0 && {name}_step(&s, {passed}, found, found + {m}))
            return 1;
        for (int i = 0; at == 0 && i < 2 * {m}; i++)
            off = fmax(off, fabs(found[i] - row[{columns} - 2 * {m} + i]) / largest[i]);
    }}
    printf("%.2e\\n", off);
    return 0;
}}
#endif
"""


class Exports:
    """What `DiscreteSmoother` gives to other programs."""

    @property
    def matrices(self) -> Mapping[str, Floats]:
        """The matrices of a step without gaps, by name, read-only; `scipy.io.savemat` takes them.

        With the delay model ``x = transition @ x + measurement @ y + copies @ mu + correction @
        change``: the copies give mu for ``arguments @ x`` now, and mu + change at the end of the
        step without correction. Estimates are ``smoothed @ x`` and ``filtered @ x``. An exact
        smoother has ``transition`` and ``measurement``, from x to the state and y at the end of a
        sample; ``Phi``, ``H``, ``Q``, ``S`` and ``R``, of its gain; and ``filtered``.
        """
        return MappingProxyType(self._matrices(np.zeros(self.l, dtype=bool)))

    def _matrices(self, missing: NDArray[np.bool_]) -> dict[str, Floats]:
        engine: Any = self._engine
        n, g = engine.states, len(self._running)
        if self.exact:
            _, model, gain, noise = (each[0] for each in engine._even)
            parts = model[:n, :n], model[n:, :n], gain[:n], gain[n:]
            parts += noise[:n, :n], noise[:n, n:], noise[n:, n:], engine._reading.readout
            names = "transition", "measurement", "Phi", "H", "Q", "S", "R", "filtered"
        else:
            parts = np.split(engine.model(missing, self.dt), [n, n + g, n + 2 * g], axis=1)
            parts += [of.readout for of in engine._readings.values()]
            names = "transition", "copies", "correction", "measurement", *engine._readings
        found = dict(zip(names, parts, strict=True)) | {"arguments": engine._arguments}
        return {name: validation.frozen(np.array(each)) for name, each in found.items()}

    def to_statespace(self) -> Any:
        """Return a python-control object, from ``y`` to ``smoothed`` and ``filtered``, by dt."""
        if self.exact or self._running:
            raise ValueError(f"to_statespace is for delay='model' without copies, got {self!r}")
        step = self.matrices
        A, B = step["transition"], step["measurement"]
        reads = {name: step[name] for name in ("smoothed", "filtered")}
        through = {(name, "y"): C @ B for name, C in reads.items()}
        return state_space(A, {"y": B}, {k: C @ A for k, C in reads.items()}, through, self.dt)

    def to_c(self, path: str | Path, functions: Texts = None, precision: str = "double") -> None:
        """Write an estimator with its delay model as C99, with math.h and without allocation.

        NAME.c and NAME.h have NAME_init and NAME_step. With ROBSMOOTH_TEST defined, they are a
        program that runs the record NAME.csv and prints the largest difference from Python.

        Parameters
        ----------
        path : str or path, with NAME.c at its end
        functions : sequence of g str, expressions of C in x such as "sin(x)", for the copies
        precision : {"double", "float"}
        """
        path = validation.path("path", path)
        if path.suffix != ".c" or not re.fullmatch(r"[A-Za-z]\w*", path.stem, flags=re.ASCII):
            raise ValueError(f"path must be NAME.c with a NAME for C, got {path.name!r}")
        real = validation.choice("precision", precision, ("double", "float"))
        if self.exact or self.l > _MOST_CHANNELS:
            what = "an estimator with its delay model, discretize(dt, delay='model'), and at most"
            raise ValueError(f"to_c is for {what} {_MOST_CHANNELS} measurements, got {self!r}")
        name, record = path.stem, _record(copy.deepcopy(self))
        fields = {
            "name": name, "dt": self.dt, "real": real,
            "n": self._engine.states, "l": self.l, "m": self.m, "columns": record.shape[1],
            "reference": f", const {name}_real *reference" if self._running else "",
            "taken": f", and the detector's reference[{self.g}]" if self._running else "",
            "passed": f"given, given + {self.l}" if self._running else "given",
            "largest": ", ".join(map(repr, np.abs(record[:, -2 * self.m :]).max(axis=0).tolist())),
            "functions": _functions(self, functions), **_statements(self),
        }  # fmt: skip
        code = _CODE.format(**fields)
        numbers = [float(each) for each in re.findall(r"([\d.]+(?:e[+-]\d+)?)@", code)]
        fits = all(1.2e-38 < each < 3.4e38 for each in numbers if each)
        if real == "float" and not fits:
            raise ValueError("precision must be 'double' for numbers that float does not hold")
        with files.atomic_path(path.with_suffix(".csv")) as temporary:
            np.savetxt(temporary, record, "%.17g", ",", header="y, reference, smoothed, filtered")
        for suffix, text in ((".h", _HEADER.format(**fields)), (".c", code)):
            files.write_text(path.with_suffix(suffix), text.replace("@", "f" * (real == "float")))


def _functions(discrete: Any, given: Texts) -> str:
    """Return the nonlinearities of the copies as C functions."""
    psi = [None] * discrete.g if given is None else given
    psi = validation.sequence("functions", psi, "expressions of C in x", discrete.g)
    running = discrete._running
    if not all(re.fullmatch(_EXPRESSION, str(psi[i] or "")) for i in running):
        rule = f"{discrete.g} expressions of C in x, such as 'sin(x)', or None where no copy runs"
        given = f"(copies run at {running}), got {validation.shown(given)}"
        raise ValueError(f"functions must be a list of {rule} {given}")
    return "".join(_PSI.format(i, psi[i]) for i in running)


def _statements(discrete: Any) -> dict[str, str]:
    """Return the C statements of a step, and the number of their operations."""
    running, l = discrete._running, discrete.l  # noqa: E741
    cases = [discrete._matrices(np.array(gaps)) for gaps in product([False, True], repeat=l)]
    x, ahead = ([f"{name}[{i}]" for i in range(discrete._engine.states)] for name in ("x", "next"))
    mu, change = ([f"{name}[{k}]" for k in range(len(running))] for name in ("mu", "change"))
    u = [f"u[{i}]" for i in range(l)]

    def values(state: list[str]) -> list[str]:
        rows = [_sum(row, state) for row in cases[0]["arguments"]]
        given = zip(running, discrete._shift.tolist(), rows, strict=True)
        return [f"psi{i}({shift!r}@ - reference[{i}] + {row})" for i, shift, row in given]

    begin = [f"real mu[{len(mu)}], change[{len(mu)}];"] if mu else []
    for i, offset in enumerate(discrete._offset.tolist()):
        begin.append(f"u[{i}] = isnan(y[{i}]) ? 0 : y[{i}] - {offset!r}@;")
    begin += map("{} = {};".format, mu, values(x))
    moves = []
    for case in cases:
        rows = np.hstack([case["transition"] - np.eye(len(x)), case["measurement"], case["copies"]])
        move = [f"next[{i}] = x[{i}] + ({_sum(row, x + u + mu)});" for i, row in enumerate(rows)]
        move += map("{} = {} - {};".format, change, values(ahead), mu)
        for i, row in enumerate(case["correction"]):
            move += [f"next[{i}] = next[{i}] + ({_sum(row, change)});"] if row.any() else []
        moves.append(move)
    reads = [
        f"{output}[{i}] = {float(discrete._w[i])!r}@ + {_sum(row, x)};"
        for output in ("smoothed", "filtered")
        for i, row in enumerate(cases[0][output])
    ]
    blocks = [[f"case {i}:", *move, "break;"] for i, move in enumerate(moves)]
    texts = [" ".join([*begin, *move, *reads]) for move in moves]
    counts = [max(len(re.findall(f" [{signs}] ", text)) for text in texts) for signs in ("*", "+-")]
    return {
        "begin": "\n    ".join(begin),
        "cases": "\n    ".join("\n        ".join(block) for block in blocks),
        "reads": "\n    ".join(reads),
        "counts": "{} multiplications, {} additions, {} functions".format(*counts, 2 * len(mu)),
    }


def _sum(row: Floats, names: list[str]) -> str:
    terms = [f"{c!r}@ * {name}" for c, name in zip(row.tolist(), names, strict=True) if c]
    return "\n            + ".join(terms) or "0"


def _record(discrete: Any) -> Floats:
    """Return samples with gaps, references near the estimates, and the estimates."""
    rng, D21 = np.random.default_rng(0), discrete._engine._estimator.plant.system.D21
    y = np.sqrt(np.diag(D21 @ D21.T) / discrete.dt) * rng.standard_normal((_ROWS, discrete.l))
    y[rng.random(y.shape) < 0.1] = np.nan
    rows, reference = [], np.zeros(discrete.g)
    discrete.reset()
    for sample in y + discrete._offset:
        steered = discrete._engine._arguments @ discrete.state / 2
        reference[discrete._running] = steered + discrete._shift
        smoothed = discrete.step(sample, reference=reference)
        rows.append([*sample, *reference, *smoothed, *discrete.filtered])
    return np.array(rows)
