"""The explorer: sliders, and the figure, the sentence and the code at their settings."""

import asyncio
import base64
import math
from dataclasses import asdict
from functools import cached_property
from html import escape

import ipywidgets as widgets
from IPython import get_ipython

from robsmooth.estimators.conditions import COSTS
from robsmooth.explorer.panels import png
from robsmooth.explorer.snapshot import DESIGNS, SLIDERS, Settings, Snapshot, take_snapshot

DEBOUNCE = 0.004  # s without an event before the settings are drawn
REST = 0.2  # s more before the certified errors are computed
JUDGING = "being prepared"
_COLUMNS = {
    "The smoother": ("lag", "order", "design", "cost"),
    "The light and the uncertainty": ("noise", "lam", "kappa", "gamma"),
    "A design by hand": ("tau", "lambda1", "lambda2", "lambda3", "lambda4"),
}
_CHOICES = {"design": DESIGNS, "cost": COSTS}
_LABELS = {"design": "design", "cost": "error to keep low"}
_LABELS |= {name: slider.label for name, slider in SLIDERS.items()}


class Explorer:
    """What a design does at some settings, for a notebook; with sliders where they can be moved."""

    def __init__(self, settings: Settings | None = None):
        self._start = settings or Settings()
        self._following: asyncio.Task | None = None
        self.inputs: dict[str, widgets.Widget] = {}  # by setting, once they are shown

    @property
    def settings(self) -> Settings:
        """The settings of the sliders, or at the start."""
        if not self.inputs:
            return self._start
        values = {name: each.value for name, each in self.inputs.items()}
        return Settings(**values | {name: SLIDERS[name].si(values[name]) for name in SLIDERS})

    @property
    def snapshot(self) -> Snapshot | str:
        """All that there is to see, or the reason for nothing."""
        return take_snapshot(self.settings)

    def _repr_mimebundle_(self, **_) -> dict[str, object]:
        kernel = getattr(get_ipython(), "kernel", None)
        request = kernel.get_parent("shell").get("content", {}) if kernel else {}
        # A frontend in a batch run takes no input.
        live = self.widget._repr_mimebundle_() if request.get("allow_stdin") else {}
        found = self.snapshot
        image = base64.b64encode(png(found)).decode()
        return {**live, "image/png": image, "text/plain": summary(found)}

    @cached_property
    def widget(self) -> widgets.Widget:
        """The sliders and all that follows them."""
        self.inputs = {name: _input(name) for names in _COLUMNS.values() for name in names}
        self._image = widgets.Image(format="png", layout={"width": "auto"})
        self._summary = widgets.HTML(layout={"min_height": "4.5em"})  # the figure stays in place
        self._code = widgets.Textarea(layout={"width": "auto", "height": "24em"})
        reset = widgets.Button(description="Reset", tooltip="back to the settings at the start")
        reset.on_click(self._reset)
        columns = [self._column(title) for title in _COLUMNS]
        self._by_hand = columns[-1]
        parts = {"panels": self._image, "summary": self._summary, "code": self._code}
        for name, part in {**self.inputs, **parts, "reset": reset}.items():
            part.add_class(f"robsmooth-{name}")
        self._reset()
        self._show(self._start, self.snapshot)
        for each in self.inputs.values():
            each.observe(self._follow_soon, "value")
        row = widgets.HBox(columns, layout={"flex_flow": "row wrap", "min_height": "196px"})
        whole = [row, reset, self._summary, self._image, self._code]
        return widgets.VBox(whole, layout={"max_width": "1000px"}).add_class("robsmooth-explorer")

    def _column(self, title: str) -> widgets.Widget:
        labels = {name: widgets.Label(_LABELS[name]) for name in _COLUMNS[title]}
        cells = [cell for name in labels for cell in (labels[name], self.inputs[name])]
        grid = {"grid_template_columns": "max-content minmax(12em, 1fr)"}  # in any font
        parts = [widgets.HTML(f"<b>{title}</b>"), widgets.GridBox(cells, layout=grid)]
        return widgets.VBox(parts, layout={"flex": "1 1 0", "min_width": "min-content"})

    def _reset(self, _=None) -> None:
        for name, value in asdict(self._start).items():
            self.inputs[name].value = SLIDERS[name].shown(value) if name in SLIDERS else value

    def _follow_soon(self, _=None) -> None:
        if self._following:
            self._following.cancel()
        self._following = asyncio.ensure_future(self._follow())

    async def _follow(self) -> None:
        """Show the quick results, then all; newer settings cancel this."""
        await asyncio.sleep(DEBOUNCE)
        settings = self.settings
        self._show(settings, take_snapshot(settings, certified=False))
        await asyncio.sleep(REST)
        self._show(settings, await asyncio.to_thread(take_snapshot, settings))

    def _show(self, settings: Settings, found: Snapshot | str) -> None:
        self._image.value, self._summary.value = png(found), escape(summary(found))
        self._code.value = settings.code()
        self._by_hand.layout.display = "flex" if settings.design == "by hand" else "none"


def summary(found: Snapshot | str) -> str:
    """Return the errors in a sentence."""
    if isinstance(found, str):
        return f"There is no design. {found}"
    filtered, smoothed = found.own.with_sine.filtered, found.own.with_sine.smoothed
    share = f"{abs(1.0 - smoothed / filtered):.1%} {'below' if smoothed < filtered else 'above'}"
    own, classical = found.own.judged.certified, found.classical.judged.certified
    certified = f"at most {own:.4f} rad², and the classical smoother's at most {classical:.4f} rad²"
    return (
        f"With the sine in the loop, smoothing has a mean square error of {smoothed:.4f} rad², "
        f"{share} the filter's {filtered:.4f} rad²; whatever the uncertainty in the sector, the "
        f"{found.settings.cost} error is {JUDGING if math.isnan(own) else certified}."
    )


def _input(name: str) -> widgets.Widget:
    common = {"layout": {"width": "auto"}}
    if name in _CHOICES:
        return widgets.Dropdown(options=_CHOICES[name], **common)
    _, tooltip, low, high, step, _ = SLIDERS[name]
    common |= {"tooltip": tooltip, "min": low, "max": high, "step": step}
    if name == "order":
        return widgets.IntSlider(**common)
    decimals = len(f"{step:g}".partition(".")[2])
    return widgets.FloatSlider(readout_format=f".{decimals}f", **common)
