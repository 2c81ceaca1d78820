"""The explorer's page for a system of one's own: which smoother to use, and the code that says."""

import asyncio
import re
from dataclasses import replace
from html import escape

import ipywidgets as widgets
import numpy as np

import robsmooth as rs
from robsmooth._support.validation import Matrix

_MATRICES = {
    "A": "states from states",
    "B1": "states from noises",
    "C0": "what to estimate, from states",
    "C2": "measurements from states",
    "D21": "measurements from noises",
}
_ENTRY = re.compile(r"(A|C2)\[(\d+),\s*(\d+)\]\s+([\d.]+)\s*%")
_RULE = "A[row,column] or C2[row,column], counted from zero, and a per cent: A[0,0] 10%"
_NAMES = (*_MATRICES, "uncertain", "delay")
EXAMPLES = {
    "a signal, its decay known to 10% and its sensor to 5%": (
        *("-1", "1 0", "1", "1", "0 0.1"),
        *("A[0,0] 10%\nC2[0,0] 5%", "0.2"),
    ),
    "two sensors, where robustness pays": (
        *("-1 0\n0 -2", "1.4142 0 0 0\n0 20 0 0", "1 0", "1 1\n0 1", "0 0 0.1 0\n0 0 0 0.1"),
        *("C2[1,1] 5%", "0.5"),
    ),
    "a mirror at 1 kHz, its frequency known to 2%": (
        *("0 6283\n-6283 -628.3", "0 0\n8.862 0", "1 0", "1 0", "0 0.001667"),
        *("A[1,0] 4%", "2e-4"),
    ),
    "a clock, which drifts": ("0 1\n0 0", "1 0 0\n0 0.1 0", "1 0", "1 0", "0 0 1", "", "3"),
}


def code_of(text: dict[str, str], order: int) -> str:
    """Return the code for what was typed; a ValueError names a field that cannot be read."""
    values = {name: _matrix(name, text[name]) for name in _MATRICES}
    lines = [f"{name} = {value.tolist()}" for name, value in values.items()]
    channels = [_channel(line, values) for line in text["uncertain"].splitlines() if line.strip()]
    lines += ["uncertainties = [", *(f"    {each}," for each in channels), "]"]
    try:
        delay = float(text["delay"])
    except ValueError:
        raise ValueError(f"delay must be a number of seconds, got {text['delay']!r}") from None
    lines += [
        "system = rs.UncertainSystem(A, B1, C0, C2, D21, uncertainties)",
        f"plant = rs.augment(system, delay={delay}, order={order})",
        "choice = rs.best_smoother(plant)",
        "print(choice.table)",
    ]
    return "\n".join(["import robsmooth as rs", "", *lines, ""])


def _matrix(name: str, text: str) -> Matrix:
    try:
        rows = [row.replace(",", " ").split() for row in re.split(r"[;\n]", text.strip())]
        return np.array(rows, dtype=float)
    except ValueError:
        rule = "rows of as many numbers each, a row on a line"
        raise ValueError(f"{name} must be {rule}, got {text!r}") from None


def _channel(line: str, values: dict[str, Matrix]) -> str:
    """Return the code of an uncertainty from a line such as A[0,0] 10%."""
    found = _ENTRY.fullmatch(line.strip())
    if found is None:
        raise ValueError(f"an uncertain entry must be {_RULE}, got {line!r}")
    name, (row, column) = found[1], map(int, found.group(2, 3))
    if not (row < len(values[name]) and column < values[name].shape[1]):
        raise ValueError(f"{name} has the shape {values[name].shape}, got the entry {line!r}")
    size = float(found[4]) / 100.0 * values[name][row, column]
    if size == 0.0:
        raise ValueError(f"an uncertain entry must not be zero: it has no per cent, got {line!r}")
    place = {each: np.zeros((len(values[each]), 1)) for each in ("A", "C2")}
    place[name][row] = 1.0
    C = size * np.eye(1, len(values["A"]), column)
    return f"rs.Uncertainty({place['A'].tolist()}, {C.tolist()}, {place['C2'].tolist()})"


class OwnSystem:
    """Fields for a system and its uncertainty, and the comparison of all smoothers for it."""

    def __init__(self) -> None:
        self._task: asyncio.Task | None = None
        self._example = widgets.Dropdown(
            options=list(EXAMPLES), description="example", layout={"width": "30em"}
        )
        self.fields = {name: widgets.Textarea(rows=2) for name in _NAMES[:-1]}
        self.fields[_NAMES[-1]] = widgets.Text()
        self.order = widgets.BoundedIntText(min=1, max=8, value=4)
        self.button = widgets.Button(description="Compare the smoothers", button_style="primary")
        self.answer, self.code = widgets.HTML(), widgets.Textarea(layout={"height": "16em"})
        rows = {**self.fields, "order": self.order, "": self.button}
        for name, field in {**rows, "answer": self.answer, "code": self.code}.items():
            field.layout.width = "auto"
            field.add_class(f"robsmooth-own-{name or 'compare'}")
        meanings = {**_MATRICES, "uncertain": f"entries: {_RULE}", "delay": "s"}
        meanings |= {"order": "states of the delay's model", "": ""}
        labels = [widgets.HTML(f"<b>{name}</b> {meanings[name]}") for name in rows]
        cells = [cell for pair in zip(labels, rows.values(), strict=True) for cell in pair]
        grid = widgets.GridBox(cells, layout={"grid_template_columns": "minmax(8em, 22em) 1fr"})
        self._example.observe(lambda change: self._fill(change["new"]), "value")
        self.button.on_click(lambda _: self.compare())
        self._fill(self._example.value)
        self.widget = widgets.VBox([self._example, grid, self.answer, self.code])

    def _fill(self, example: str) -> None:
        for name, text in zip(_NAMES, EXAMPLES[example], strict=True):
            self.fields[name].value = text
        self.answer.value = self.code.value = ""

    def compare(self) -> asyncio.Task:
        """Start to find the answer; a newer question takes its place."""
        if self._task:
            self._task.cancel()
        self._task = asyncio.ensure_future(self._compare())
        return self._task

    async def _compare(self) -> None:
        self.answer.value = '<i class="fa fa-spinner fa-spin"></i> The smoothers are designed.'
        try:
            text = {name: field.value for name, field in self.fields.items()}
            self.code.value = code_of(text, self.order.value)
            choice = await asyncio.to_thread(_choice, self.code.value)
            table = replace(choice.table, caption="")
            answer = f"<p>{escape(choice.sentence)}</p>{table.html()}"
        except (ValueError, TypeError, ArithmeticError, RuntimeError) as refusal:
            answer = f"<p>There is no answer: {escape(str(refusal))}.</p>"
        self.answer.value = answer


def _choice(code: str) -> rs.Choice:
    """Run the code, which is made of numbers alone, and return its choice."""
    names: dict = {"print": lambda *_: None}
    exec(code, names)
    return names["choice"]
