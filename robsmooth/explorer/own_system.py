"""The explorer's page for a system of one's own: which smoother to use, and the code that says."""

import re
import warnings
from contextlib import suppress
from dataclasses import replace
from html import escape

import ipywidgets as widgets
import numpy as np

from robsmooth._support.validation import Matrix

_ENTRY = re.compile(r"(A|C2)\s*\[(\d+),\s*(\d+)\]\s+([\d.]+)\s*%", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)
_RULE = "A[row,column] or C2[row,column], counted from zero, and a per cent: A[0,0] 10%"
_FIELDS = {  # matrices, with what their rows are, and more
    "A": ("how the states change", "state"),
    "B1": ("noise that drives each state", "state"),
    "C0": ("what to estimate", "wanted number"),
    "C2": ("what each sensor measures", "sensor"),
    "D21": ("noise of each sensor", "sensor"),
    "uncertain": ("counted from zero: A[0,0] 10%", ""),
    "against": ("the uncertain numbers", ""),
    "delay": ("how late w may be known", ""),
    "order": ("states of the delay's model", ""),
}
_MATRICES = [*_FIELDS][:5]
_AGAINST = {"may vary in time": "admissible", "are constant": "constant"}
_DRIFT = "0 0; 0 -2 | 1 0 0 0; 0 20 0 0 | 1 0 | 1 1; 0 1 | 0 0 0.03 0; 0 0 0 0.03 | C2[1,1] 10%"
_MIRROR = "0 6283; -6283 -628.3 | 0 0; 8.862 0 | 1 0 | 1 0 | 0 0.001667 | A[1,0] 4%"
_CLOCK = "0 1; 0 0 | 1 0 0; 0 0.1 0 | 1 0 | 1 0 | 0 0 1 | "
EXAMPLES = {  # values of the fields but the order, as in README and `robsmooth.examples`
    "a drift and a disturbance, a gain known to 10%": f"{_DRIFT} | constant | 0.5",
    "a mirror at 1 kHz, its frequency known to 2%": f"{_MIRROR} | admissible | 2e-4",
    "a clock, which drifts": f"{_CLOCK} | admissible | 3",
}
_EQUATIONS = (
    "The states x move, and w is wanted a delay after it was there; the sensors give dy:<br>"
    "<b>dx = A x dt + B1 dW,&emsp;w = C0 x,&emsp;dy = C2 x dt + D21 dW</b><br>"
    "with independent noises dW, a column of B1 and D21 each. A row of a matrix is a line. "
    "All numbers share one unit of time, such as seconds."
)
_WORKING = '<span class="robsmooth-spinner"></span> Designing the smoothers: about ten seconds …'


def code_of(typed: dict[str, str]) -> str:
    """Return the code for the fields' values; a ValueError names one that cannot be read."""
    values = {name: _matrix(name, typed[name]) for name in _MATRICES}
    A, B1, C0 = (values[name] for name in _MATRICES[:3])
    with suppress(ValueError):  # sizes that do not fit are refused by the library
        if not any((C0 @ np.linalg.matrix_power(A, k) @ B1).any() for k in range(len(A))):
            raise ArithmeticError("nothing to estimate: no noise of B1 reaches C0 x")
    matrices = "\n".join(f"{name} = {value.tolist()}" for name, value in values.items())
    entries = filter(None, map(str.strip, re.split(r"[;\n]|,(?![^[]*\])", typed["uncertain"])))
    channels = "".join(f"    {_channel(entry, values)},\n" for entry in entries)
    delay, order, against = (typed[name] for name in ("delay", "order", "against"))
    if not _NUMBER.fullmatch(delay):
        raise ValueError(f"delay must be a number, such as 0.5 or 3, got {delay!r}")
    return f"""\
import robsmooth as rs

{matrices}
uncertainties = [
{channels}]
system = rs.UncertainSystem(A, B1, C0, C2, D21, uncertainties)
plant = rs.augment(system, delay={delay}, order={order})
choice = rs.best_smoother(plant, against={against!r})
print(choice.table)
"""


def _matrix(name: str, text: str) -> Matrix:
    if found := re.search(r"[^\s,;]*\d,\d[^\s,;]*", text):
        point, space = (found[0].replace(",", each) for each in (".", ", "))
        raise ValueError(f"{name}: write {point} for a number or {space} for two, not {found[0]}")
    rows = [*filter(None, (row.replace(",", " ").split() for row in re.split(r"[;\n]", text)))]
    if not rows:
        raise ValueError(f"{name} is empty: type one row per {_FIELDS[name][1]}")
    for number, row in enumerate(rows, 1):
        if wrong := [entry for entry in row if not _NUMBER.fullmatch(entry)]:
            raise ValueError(f"{name}: {wrong[0]!r} is no finite number")
        if len(row) != len(rows[0]):
            count = f"{len(row)} number{'s' * (len(row) != 1)}"
            raise ValueError(f"{name}: row {number} has {count}, row 1 has {len(rows[0])}")
    return np.array(rows, dtype=float)


def _channel(line: str, values: dict[str, Matrix]) -> str:
    """Return the code of an uncertainty from a line such as A[0,0] 10%."""
    if not (found := _ENTRY.fullmatch(line)):
        raise ValueError(f"an uncertain entry must be {_RULE}, got {line!r}")
    name, row, column = found[1].upper(), int(found[2]), int(found[3])
    matrix, (rows, columns) = values[name], values[name].shape
    if row >= rows or column >= columns:
        last = f"[{rows - 1},{columns - 1}]"
        raise ValueError(f"{name} has no entry [{row},{column}]; the last is {last}")
    if not matrix[row, column]:
        raise ValueError(f"{name}[{row},{column}] is zero: a per cent of it is nothing")
    B, D = (np.zeros((len(values[each]), 1)) for each in ("A", "C2"))
    {"A": B, "C2": D}[name][row] = 1.0
    C = np.zeros((1, columns))
    C[0, column] = float(f"{float(found[4]) / 100.0 * matrix[row, column]:.12g}")
    return f"rs.Uncertainty(B={B.tolist()}, C={C.tolist()}, D={D.tolist()})"


class OwnSystem:
    """Fields for a system and its uncertainty, and the comparison of all smoothers for it."""

    def __init__(self) -> None:
        self.example = widgets.Dropdown(options=EXAMPLES, description="example")
        self.fields = {name: widgets.Textarea(rows=2) for name in _FIELDS}
        self.fields["against"] = widgets.Dropdown(options=_AGAINST)
        self.fields["delay"] = widgets.Text()
        self.fields["order"] = widgets.Dropdown(options=range(1, 9))
        self.reset = widgets.Button(description="Reset the example")
        self.button = widgets.Button(description="Compare the smoothers", button_style="primary")
        self.answer, self.code = widgets.HTML(), widgets.Textarea(rows=16)
        labels = (widgets.HTML(f"<b>{name}</b> {label}") for name, (label, _) in _FIELDS.items())
        labelled = [*map(widgets.VBox, zip(labels, self.fields.values(), strict=True))]
        columns = {"grid_template_columns": "repeat(auto-fit, minmax(20em, 1fr))"}
        grid = widgets.GridBox(labelled, layout=columns)
        parts = {"example": self.example, **self.fields, "reset": self.reset}
        parts |= {"compare": self.button, "answer": self.answer, "code": self.code}
        for name, part in parts.items():
            part.layout.width = "auto"
            part.add_class(f"robsmooth-own-{name}")
        self.example.observe(self._fill, "value")
        self.reset.on_click(self._fill)
        self.button.on_click(self.compare)
        self._fill()
        buttons = widgets.HBox([self.button, self.reset])
        parts = [self.example, widgets.HTML(_EQUATIONS), grid, buttons, self.answer, self.code]
        self.widget = widgets.VBox(parts)

    def _fill(self, _=None) -> None:
        values = [part.replace("; ", "\n") for part in self.example.value.split(" | ")]
        for field, value in zip(self.fields.values(), [*values, 4], strict=True):
            field.value = value
        self._answer("", "")

    def _answer(self, answer: str, code: str) -> None:
        self.answer.value, self.code.value = answer, code
        self.code.layout.display = "flex" if code else "none"

    def compare(self, _=None) -> None:
        """Show the code and, once it has run, its answer."""
        names, code = {"print": lambda *_: None}, ""
        try:
            code = code_of({name: field.value for name, field in self.fields.items()})
            self._answer(_WORKING, code)
            with warnings.catch_warnings(action="ignore"):  # the choice has what is said
                exec(code, names)  # it is made of numbers alone
            choice, table = names["choice"], names["choice"].table
            said = [f"Take care: {choice.coarse}."] if choice.coarse else []
            answer = "".join(f"<p>{escape(each)}</p>" for each in (*said, choice.sentence))
            rows = [[f"{x:#.4g}" if isinstance(x, float) else x for x in row] for row in table.rows]
            answer += replace(table, caption="", rows=rows).html()
        except (ValueError, TypeError, ArithmeticError, RuntimeError) as refusal:
            answer, code = f"<p>There is no answer: {escape(str(refusal))}.</p>", ""
        self._answer(answer, code)
