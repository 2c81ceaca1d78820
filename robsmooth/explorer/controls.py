"""The widgets of the explorer: sliders, the image of the panels, and a summary."""

from collections.abc import Callable
from dataclasses import asdict
from html import escape

import ipywidgets as widgets
from IPython.display import Javascript

from robsmooth.explorer.settings import DESIGNS, RANGES, Settings

_LABELS = {  # label and tooltip of each setting
    "lag": ("lag (µs)", "how far back the smoothed estimate looks"),
    "order": ("order", "states in the model of the lag: more of them follow a delay more closely"),
    "design": ("design", "how the estimator is made"),
    "cost": ("keep low", "the error that a robust design is for"),
    "noise": ("noise (paper: 1)", "power of the light's shot noise; the design knows of it"),
    "lam": ("decay λ (10³/s)", "how fast the phase forgets"),
    "kappa": ("wander κ (10³/s)", "how much the phase moves, in rad² a second"),
    "gamma": ("uncertainty γ", "half width of the sector that is taken to hold the sine"),
    "tau": ("τ (µs rad²)", "the scale of a robust design"),
    "lambda1": ("λ₁ process noise", "multiplier of the process noise's constraint"),
    "lambda2": ("λ₂ sine − copy", "multiplier of the difference of the sine and its copy"),
    "lambda3": ("λ₃ sine", "multiplier of the sine's own constraint"),
    "lambda4": ("λ₄ copy", "multiplier of the copy's own constraint"),
}
_BY_HAND = ("tau", "lambda1", "lambda2", "lambda3", "lambda4")
_COLUMNS = {
    "The smoother": ("lag", "order", "design", "cost"),
    "The light and the uncertainty": ("noise", "lam", "kappa", "gamma"),
    "A design by hand": _BY_HAND,
}
_OUTPUTS = ("panels", "summary", "code", "reset", "copy")
_CHOICES = {
    "design": dict(zip(("robust, least bound", "by hand", "classical"), DESIGNS, strict=True)),
    "cost": {"the filtered error": "filtered", "the smoothed error": "smoothed"},
}
_WIDEST = "1000px"  # more would blur the panels
# The panels stay in place whatever is above them: the longest column is not always shown, and a
# sentence may take three lines.
_COLUMNS_HEIGHT, _SUMMARY_HEIGHT = "196px", "4.5em"
# A page that was not fetched securely has no clipboard: the text is selected then, for Ctrl+C.
_COPY = """
const area = document.querySelector(".%s textarea");
area.focus();
area.select();
if (navigator.clipboard) navigator.clipboard.writeText(area.value);
else document.execCommand("copy");
"""


class Controls:
    """The widgets, and the settings that they stand for.

    Parameters
    ----------
    settings : Settings
        To begin with, and to go back to.
    on_change : callable
        Called at each change of the settings.

    Attributes
    ----------
    widget : ipywidgets.Widget
        All of it.
    inputs : dict of str to ipywidgets.Widget
        What sets each of the settings.
    panels, summary, code : ipywidgets.Widget
        What is shown.
    reset, copy : ipywidgets.Button
    """

    def __init__(self, settings: Settings, on_change: Callable[[], None]):
        self._on_change, self._muted = on_change, False
        self.inputs = {name: _input(name) for name in _LABELS}
        self.reset = _button("Reset", "back to the settings at the start")
        self.copy = _button("Copy these settings as code", "to the clipboard")
        self.panels = widgets.Image(format="png", layout={"width": "auto"})
        self.summary = widgets.HTML(layout={"min_height": _SUMMARY_HEIGHT})
        self.code = widgets.Textarea(layout={"width": "auto", "height": "26em"})
        self._script = widgets.Output()
        self.reset.on_click(lambda _: self.set(settings))
        self.copy.on_click(lambda _: self._copy_to_clipboard())
        self._columns = {title: self._column(title) for title in _COLUMNS}
        self.set(settings)
        for each in self.inputs.values():
            each.observe(self._notify, "value")
        self.widget = self._layout()

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
        if self._muted:
            return
        settings = self.settings
        by_hand = settings.design == "by hand"
        self._columns["A design by hand"].layout.display = "flex" if by_hand else "none"
        self.inputs["cost"].disabled = settings.design == "classical"
        self._on_change()

    def _copy_to_clipboard(self) -> None:
        self._script.outputs = ()
        self._script.append_display_data(Javascript(_COPY % self._own_class))

    @property
    def _own_class(self) -> str:
        """The class of these controls alone: a notebook may show several."""
        return f"robsmooth-{self.code.model_id}"

    def _column(self, title: str) -> widgets.Widget:
        """Labels, which take the room that they need in any font, and inputs beside them."""
        cells = []
        for name in _COLUMNS[title]:
            label, tooltip = _LABELS[name]
            cells += [widgets.Label(label, tooltip=tooltip), self.inputs[name]]
        grid = {"grid_template_columns": "max-content minmax(12em, 1fr)"}
        return widgets.VBox(
            [widgets.HTML(f"<b>{title}</b>"), widgets.GridBox(cells, layout=grid)],
            layout={"flex": "1 1 0", "min_width": "min-content"},
        )

    def _layout(self) -> widgets.Widget:
        named = {**self.inputs, **{name: getattr(self, name) for name in _OUTPUTS}}
        for name, each in named.items():
            each.add_class(f"robsmooth-{name}")
        whole = widgets.VBox(
            [
                widgets.HBox(
                    [*self._columns.values()],
                    layout={"flex_flow": "row wrap", "min_height": _COLUMNS_HEIGHT},
                ),
                self.summary,
                self.panels,
                widgets.HBox([self.reset, self.copy]),
                self.code,
                self._script,
            ],
            layout={"max_width": _WIDEST},
        )
        return whole.add_class("robsmooth-explorer").add_class(self._own_class)


def _input(name: str) -> widgets.Widget:
    common = {"tooltip": _LABELS[name][1], "layout": {"width": "auto"}}
    if name in _CHOICES:
        return widgets.Dropdown(options=_CHOICES[name], **common)
    allowed = RANGES[name]
    limits = {"min": allowed.low, "max": allowed.high, "step": allowed.step}
    if name == "order":
        return widgets.IntSlider(**limits, **common)
    decimals = len(f"{allowed.step:g}".partition(".")[2])
    return widgets.FloatSlider(**limits, readout_format=f".{decimals}f", **common)


def _button(label: str, tooltip: str) -> widgets.Button:
    return widgets.Button(description=label, tooltip=tooltip, layout={"width": "auto"})
