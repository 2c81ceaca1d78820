"""The explorer's page for a system of one's own: which smoother to use, and the code that says."""

import re
from dataclasses import replace
from html import escape

import ipywidgets as widgets
import numpy as np

from robsmooth._support import validation
from robsmooth._support.validation import Matrix

_ENTRY = re.compile(r"(A|C2)\[(\d+),\s*(\d+)\]\s+([\d.]+)\s*%")
_RULE = "A[row,column] or C2[row,column], counted from zero, and a per cent: A[0,0] 10%"
_MATRICES = ("A", "B1", "C0", "C2", "D21")
_FIELDS = {
    "A": "states from states",
    "B1": "states from noises",
    "C0": "what to estimate, from states",
    "C2": "measurements from states",
    "D21": "measurements from noises",
    "uncertain": "entries of A and C2, counted from zero: A[0,0] 10%",
    "delay": "s",
    "order": "states of the delay's model",
}
_MIRROR = ("0 6283\n-6283 -628.3", "0 0\n8.862 0", "1 0", "1 0", "0 0.001667", "A[1,0] 4%", 2e-4)
_CLOCK = ("0 1\n0 0", "1 0 0\n0 0.1 0", "1 0", "1 0", "0 0 1", "", 3.0)
_TWO = ("-1 0\n0 -2", "1.4142 0 0 0\n0 20 0 0", "1 0", "1 1\n0 1", "0 0 0.1 0\n0 0 0 0.1")
EXAMPLES = {  # values of the fields, without the order
    "two sensors, where robustness pays": (*_TWO, "C2[1,1] 5%", 0.5),
    "a mirror at 1 kHz, its frequency known to 2%": _MIRROR,
    "a clock, which drifts": _CLOCK,
}


def code_of(typed: dict) -> str:
    """Return the code for the fields' values; a ValueError names one that cannot be read."""
    values = {name: _matrix(name, typed[name]) for name in _MATRICES}
    matrices = "\n".join(f"{name} = {value.tolist()}" for name, value in values.items())
    lines = filter(None, map(str.strip, typed["uncertain"].splitlines()))
    channels = "".join(f"    {_channel(line, values)},\n" for line in lines)
    return f"""\
import numpy as np
import robsmooth as rs

{matrices}
uncertainties = [
{channels}]
system = rs.UncertainSystem(A, B1, C0, C2, D21, uncertainties)
plant = rs.augment(system, delay={typed["delay"]}, order={typed["order"]})
choice = rs.best_smoother(plant)
print(choice.table)
"""


def _matrix(name: str, text: str) -> Matrix:
    try:
        rows = [row.replace(",", " ").split() for row in re.split(r"[;\n]", text.strip())]
        return validation.array(name, np.array(rows, dtype=float), ndim=2)
    except ValueError:
        rule = "rows of as many numbers each, a row on a line"
        raise ValueError(f"{name} must be {rule}, got {text!r}") from None


def _channel(line: str, values: dict[str, Matrix]) -> str:
    """Return the code of an uncertainty from a line such as A[0,0] 10%."""
    found = _ENTRY.fullmatch(line)
    if found is None:
        raise ValueError(f"an uncertain entry must be {_RULE}, got {line!r}")
    name, row, column = found[1], int(found[2]), int(found[3])
    entry = values[name][row : row + 1, column : column + 1]
    if not entry.any():
        rule = f"an entry of {name}, of shape {values[name].shape}, that is not zero"
        raise ValueError(f"an uncertain entry must be {rule}, got {line!r}")
    unit = "{:.1f} * np.eye({}, 1, {})".format
    B, D = (unit(each == name, len(values[each]), -row) for each in ("A", "C2"))
    size = f"{float(found[4]) / 100.0} * {entry.item()}"
    return f"rs.Uncertainty({B}, {size} * np.eye(1, {len(values['A'])}, {column}), {D})"


class OwnSystem:
    """Fields for a system and its uncertainty, and the comparison of all smoothers for it."""

    def __init__(self) -> None:
        self.example = widgets.Dropdown(options=EXAMPLES, description="example")
        self.fields = {name: widgets.Textarea(rows=2) for name in _FIELDS}
        self.fields["delay"] = widgets.FloatText()
        self.fields["order"] = widgets.BoundedIntText(4, min=1, max=8)
        self.button = widgets.Button(description="Compare the smoothers", button_style="primary")
        self.answer, self.code = widgets.HTML(), widgets.Textarea(rows=16)
        labelled = [
            widgets.VBox([widgets.HTML(f"<b>{name}</b> {_FIELDS[name]}"), field])
            for name, field in self.fields.items()
        ]
        columns = {"grid_template_columns": "repeat(auto-fit, minmax(20em, 1fr))"}
        grid = widgets.GridBox(labelled, layout=columns)
        parts = {"example": self.example, **self.fields, "compare": self.button}
        parts |= {"answer": self.answer, "code": self.code}
        for name, part in parts.items():
            part.layout.width = "auto"
            part.add_class(f"robsmooth-own-{name}")
        self.example.observe(self._fill, "value")
        self.button.on_click(self.compare)
        self._fill()
        self.widget = widgets.VBox([self.example, grid, self.button, self.answer, self.code])

    def _fill(self, _=None) -> None:
        for field, value in zip(self.fields.values(), self.example.value, strict=False):
            field.value = value
        self.answer.value = self.code.value = ""

    def compare(self, _=None) -> None:
        """Show the code and, once it has run, its answer."""
        self.answer.value = '<i class="fa fa-spinner fa-spin"></i> The smoothers are designed.'
        self.code.value, names = "", {"print": lambda *_: None}
        try:
            self.code.value = code_of({name: field.value for name, field in self.fields.items()})
            exec(self.code.value, names)  # it is made of numbers alone
            table = replace(names["choice"].table, caption="")
            answer = f"<p>{escape(names['choice'].sentence)}</p>{table.html()}"
        except (ValueError, TypeError, ArithmeticError, RuntimeError) as refusal:
            answer = f"<p>There is no answer: {escape(str(refusal))}.</p>"
        self.answer.value = answer
