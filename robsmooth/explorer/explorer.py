"""The explorer: sliders with the verdict and figures at their settings, and a page for a system."""

import asyncio
import base64
import math
from dataclasses import asdict
from functools import cached_property
from html import escape

import ipywidgets as widgets
from IPython import get_ipython

from robsmooth.estimators.conditions import COSTS
from robsmooth.explorer.own_system import OwnSystem
from robsmooth.explorer.panels import overview, png, theory
from robsmooth.explorer.snapshot import DESIGNS, SLIDERS, Settings, Snapshot, take_snapshot

DEBOUNCE = 0.004  # s without an event before the settings are drawn
REST = 0.2  # s more before the other designs are made, and all are judged
JUDGING = "The designs are being compared."
_COLUMNS = {
    "The smoother": ("design", "cost", "lag", "order", "gamma"),
    "The light": ("noise", "lam", "kappa"),
    "A design by hand": ("tau", "lambda1", "lambda2", "lambda3", "lambda4"),
}
_CHOICES = {"design": ("design", DESIGNS), "cost": ("error to keep low", COSTS)}
# A slider's number can be typed, and looks like it; a tab is as wide as its title.
_STYLE = """<style>
.robsmooth-explorer .widget-readout { border: 1px solid #bbb; }
.robsmooth-explorer .lm-TabBar-tab { flex: none !important; }
</style>"""


class Explorer:
    """What designs do at some settings, for a notebook; with sliders where they can be moved."""

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

    def _repr_mimebundle_(self, **_) -> dict[str, object]:
        kernel = getattr(get_ipython(), "kernel", None)
        request = kernel.get_parent("shell").get("content", {}) if kernel else {}
        # A frontend in a batch run takes no input.
        live = self.widget._repr_mimebundle_() if request.get("allow_stdin") else {}
        found = take_snapshot(self.settings)
        image = base64.b64encode(png(found, overview)).decode()
        return {**live, "image/png": image, "text/plain": " ".join(verdict(found))}

    @cached_property
    def widget(self) -> widgets.Widget:
        """The sliders and all that follows them, and the page for a system."""
        self.inputs = {name: _input(name) for names in _COLUMNS.values() for name in names}
        self._image, self._theory = (widgets.Image(layout={"width": "auto"}) for _ in range(2))
        self._verdict = widgets.HTML(layout={"min_height": "9.5em"})  # the figure stays in place
        self._code = widgets.Textarea(layout={"width": "auto", "height": "24em"})
        reset = widgets.Button(description="Reset", tooltip="back to the settings at the start")
        reset.on_click(self._reset)
        parts = {"panels": self._image, "theory": self._theory, "code": self._code}
        parts |= {"verdict": self._verdict, "reset": reset}
        for name, part in {**self.inputs, **parts}.items():
            part.add_class(f"robsmooth-{name}")
        columns = [widgets.VBox(layout={"flex": "1 1 22em"}) for _ in _COLUMNS]
        for column, (title, names) in zip(columns, _COLUMNS.items(), strict=True):
            column.children = [widgets.HTML(f"<b>{title}</b>"), *map(self.inputs.get, names)]
        _, light, self._by_hand = columns
        light.children += (reset,)
        self._reset()
        self._show(self._start, take_snapshot(self._start))
        for each in self.inputs.values():
            each.observe(self._follow_soon, "value")
        row = widgets.HBox(columns, layout={"flex_flow": "row wrap"})
        views = widgets.Tab([self._image, self._theory, self._code])
        views.titles = "Figures", "For theorists", "The code"
        loop = widgets.VBox([widgets.HTML(_STYLE), row, self._verdict, views])
        pages = widgets.Tab([loop, OwnSystem().widget], layout={"max_width": "1000px"})
        pages.titles = "The paper's loop", "Your own system"
        return pages.add_class("robsmooth-explorer")

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
        self._show(settings, take_snapshot(settings, complete=False))
        await asyncio.sleep(REST)
        self._show(settings, await asyncio.to_thread(take_snapshot, settings))

    def _show(self, settings: Settings, found: Snapshot | str) -> None:
        self._image.value = png(found, overview)
        if isinstance(found, str) or found.is_complete:
            self._theory.value = png(found, theory)
        sentences = "</p><p>".join(map(escape, verdict(found)))
        self._verdict.value = f'<div style="line-height: 1.3"><p>{sentences}</p></div>'
        self._code.value = settings.code()
        self._by_hand.layout.display = "flex" if settings.design == "by hand" else "none"


def verdict(found: Snapshot | str) -> list[str]:
    """Return what waiting buys, what a guarantee costs, and which design is ahead, in sentences."""
    if isinstance(found, str):
        return [f"There is no design. {found}"]
    cost, with_sine = found.settings.cost, found.own.with_sine
    change = with_sine.smoothed / with_sine.filtered - 1.0
    waiting = (
        f"With the sine in the loop, waiting {1e6 * found.settings.lag:.3g} µs "
        f"{'lowers' if change < 0.0 else 'raises'} the mean square error from "
        f"{with_sine.filtered:.4f} rad² to {with_sine.smoothed:.4f} rad², by {abs(change):.1%}."
    )
    if not found.is_complete:
        return [waiting, JUDGING]
    certified = {name: each.judged.certified for name, each in found.found.items()}
    errors = {name: getattr(each.with_sine, cost) for name, each in found.found.items()}
    safest, best = min(certified, key=certified.get), min(errors, key=errors.get)
    least, plain = found.found[safest].judged, found.found["classical"].judged
    none = math.isinf(plain.certified)
    guarantee = (
        f"The lowest guarantee is that of the {safest} design: whatever the uncertainty, the "
        f"{cost} error is at most {least.certified:.4f} rad². The classical design "
        f"{'has no guarantee' if none else f'guarantees {plain.certified:.4f} rad²'}. "
        f"The price, without uncertainty, is {least.nominal / plain.nominal - 1.0:+.1%}."
    )
    if math.isinf(least.certified):
        guarantee = "No design has a guarantee for this uncertainty."
    return [
        waiting,
        guarantee,
        f"With the sine itself, the {best} design has the least error here.",
    ]


def _input(name: str) -> widgets.Widget:
    look = {"layout": {"width": "auto"}, "style": {"description_width": "13em"}}
    if name in _CHOICES:
        label, options = _CHOICES[name]
        return widgets.Dropdown(description=label, options=options, **look)
    label, tooltip, low, high, step, _ = SLIDERS[name]
    kind = widgets.IntSlider if name == "order" else widgets.FloatSlider
    look |= {"readout_format": f".{len(f'{step:g}'.partition('.')[2])}f", "tooltip": tooltip}
    return kind(description=label, min=low, max=high, step=step, **look)
