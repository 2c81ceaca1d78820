"""The widgets of the explorer: sliders, the image of the panels, and a summary."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from html import escape

import ipywidgets as widgets
from IPython.display import Javascript

from robsmooth.estimators.conditions import COSTS
from robsmooth.explorer.snapshot import DESIGNS, RANGES, Settings

_BY_HAND = "A design by hand"
_COLUMNS = {  # of each setting: label and tooltip
    "The smoother": {
        "lag": ("lag (µs)", "how far back the smoothed estimate looks"),
        "order": ("order", "states in the model of the lag: more follow a delay more closely"),
        "design": ("design", "robust: least bound V; minimax: least certified error"),
        "cost": ("error to keep low", "the error that a design is for, and that is judged"),
    },
    "The light and the uncertainty": {
        "noise": ("noise (paper: 1)", "power of the light's shot noise; the design knows of it"),
        "lam": ("decay λ (10³/s)", "how fast the phase forgets"),
        "kappa": ("wander κ (10³/s)", "how much the phase moves, in rad² a second"),
        "gamma": ("uncertainty γ", "half width of the sector that is taken to hold the sine"),
    },
    _BY_HAND: {
        "tau": ("τ (µs rad²)", "the scale of the paper's design"),
        "lambda1": ("λ₁ process noise", "multiplier of the process noise's constraint"),
        "lambda2": ("λ₂ sine − copy", "multiplier of the difference of the sine and its copy"),
        "lambda3": ("λ₃ sine", "multiplier of the sine's own constraint"),
        "lambda4": ("λ₄ copy", "multiplier of the copy's own constraint"),
    },
}
_CHOICES = {"design": DESIGNS, "cost": COSTS}
_WIDEST = "1000px"  # more would blur the panels
# The panels stay in place whatever is above them: not all columns, or a sentence of three lines.
_COLUMNS_HEIGHT, _SUMMARY_HEIGHT = "196px", "4.5em"
_GRID = {"grid_template_columns": "max-content minmax(12em, 1fr)"}  # any label fits, in any font
_AUTO = {"width": "auto"}
# A page that was not fetched securely has no clipboard: the text is selected then, for Ctrl+C.
_COPY = """
const area = document.querySelector(".%s textarea");
area.focus();
area.select();
if (navigator.clipboard) navigator.clipboard.writeText(area.value);
else document.execCommand("copy");
"""


class Controls:
    """The widgets, and the settings that they stand for: at first, and after a reset, these."""

    def __init__(self, settings: Settings, on_change: Callable[[], None]):
        self._on_change, self._muted = on_change, False
        self.panels = widgets.Image(format="png", layout=_AUTO)
        self.summary = widgets.HTML(layout={"min_height": _SUMMARY_HEIGHT})
        self.code = widgets.Textarea(layout={"width": "auto", "height": "26em"})
        button = partial(widgets.Button, layout=_AUTO)
        self.reset = button(description="Reset", tooltip="back to the settings at the start")
        self.copy = button(description="Copy these settings as code", tooltip="to the clipboard")
        self._script = widgets.Output()
        self._own_class = f"robsmooth-{self.code.model_id}"  # a notebook may show several
        self.inputs: dict[str, widgets.Widget] = {}  # by their settings
        self._columns = {title: self._column(title) for title in _COLUMNS}
        row = {"flex_flow": "row wrap", "min_height": _COLUMNS_HEIGHT}
        columns = widgets.HBox([*self._columns.values()], layout=row)
        buttons = widgets.HBox([self.reset, self.copy])
        whole = [columns, self.summary, self.panels, buttons, self.code, self._script]
        self.widget = widgets.VBox(whole, layout={"max_width": _WIDEST})
        self.widget.add_class("robsmooth-explorer").add_class(self._own_class)
        for name in ("panels", "summary", "code", "reset", "copy"):
            getattr(self, name).add_class(f"robsmooth-{name}")
        self.reset.on_click(lambda _: self.set(settings))
        self.copy.on_click(self._copy_to_clipboard)
        self.set(settings)

    @property
    def settings(self) -> Settings:
        """The values of the inputs."""
        values = {name: each.value for name, each in self.inputs.items()}
        return Settings(**values | {name: RANGES[name].si(values[name]) for name in RANGES})

    def set(self, settings: Settings) -> None:
        """Put the inputs to these settings: one change."""
        self._muted = True
        for name, value in asdict(settings).items():
            self.inputs[name].value = RANGES[name].shown(value) if name in RANGES else value
        self._muted = False
        self._notify()

    def update(self, png: bytes, summary: str, code: str) -> None:
        """Show the panels, their summary and the settings as code."""
        self.panels.value, self.code.value = png, code
        self.summary.value = f'<div style="line-height: 1.4">{escape(summary)}</div>'

    def _notify(self, _=None) -> None:
        if not self._muted:
            design = self.inputs["design"].value
            self._columns[_BY_HAND].layout.display = "flex" if design == "by hand" else "none"
            self._on_change()

    def _copy_to_clipboard(self, _) -> None:
        self._script.outputs = ()
        self._script.append_display_data(Javascript(_COPY % self._own_class))

    def _column(self, title: str) -> widgets.Widget:
        """Labels, and inputs beside them."""
        cells = []
        for name, (label, tooltip) in _COLUMNS[title].items():
            self.inputs[name] = _input(name, tooltip).add_class(f"robsmooth-{name}")
            self.inputs[name].observe(self._notify, "value")
            cells += [widgets.Label(label, tooltip=tooltip), self.inputs[name]]
        heading, grid = widgets.HTML(f"<b>{title}</b>"), widgets.GridBox(cells, layout=_GRID)
        return widgets.VBox([heading, grid], layout={"flex": "1 1 0", "min_width": "min-content"})


def _input(name: str, tooltip: str) -> widgets.Widget:
    common = {"tooltip": tooltip, "layout": _AUTO}
    if name in _CHOICES:
        return widgets.Dropdown(options=_CHOICES[name], **common)
    low, high, step, _ = RANGES[name]
    common |= {"min": low, "max": high, "step": step}
    if name == "order":
        return widgets.IntSlider(**common)
    decimals = len(f"{step:g}".partition(".")[2])
    return widgets.FloatSlider(**common, readout_format=f".{decimals}f")
