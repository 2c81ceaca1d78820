"""The explorer: sliders with the verdict and figures at their settings, and a page for a system."""

import asyncio
import base64
import math
from dataclasses import asdict
from functools import cached_property
from html import escape

import ipywidgets as widgets
from IPython import get_ipython
from traitlets import link

from robsmooth.estimators.conditions import COSTS
from robsmooth.explorer.own_system import OwnSystem
from robsmooth.explorer.panels import overview, png, theory
from robsmooth.explorer.snapshot import DESIGNS, SLIDERS, Settings, Snapshot, take_snapshot

DEBOUNCE = 0.004  # s without an event before the settings are drawn
REST = 0.2  # s more before the other designs are made, and all are judged
JUDGING = "The designs are being compared."
_COLUMNS = {
    "The smoother": ("lag", "order", "gamma"),
    "The light": ("noise", "lam", "kappa"),
    "A design by hand": ("tau", "lambda1", "lambda2", "lambda3", "lambda4"),
}
_CHOICES = {"design": ("design", DESIGNS), "cost": ("error to keep low", COSTS)}
_PAGES = ("The paper's loop", "For theorists", "The code", "Your own system")


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

    @property
    def snapshot(self) -> Snapshot | str:
        """All that there is to see, or the reason for nothing."""
        return take_snapshot(self.settings)

    def _repr_mimebundle_(self, **_) -> dict[str, object]:
        kernel = getattr(get_ipython(), "kernel", None)
        request = kernel.get_parent("shell").get("content", {}) if kernel else {}
        # A frontend in a batch run takes no input.
        live = self.widget._repr_mimebundle_() if request.get("allow_stdin") else {}
        image = base64.b64encode(png(self.snapshot, overview)).decode()
        return {**live, "image/png": image, "text/plain": " ".join(verdict(self.snapshot))}

    @cached_property
    def widget(self) -> widgets.Widget:
        """The sliders and all that follows them, on pages."""
        columns = [self._column(*column) for column in _COLUMNS.items()]
        self._by_hand = columns[-1]
        self._image, self._theory = (
            widgets.Image(format="png", layout={"width": "auto"}) for _ in range(2)
        )
        self._verdict = widgets.HTML(layout={"min_height": "7em"})  # the figure stays in place
        self._code = widgets.Textarea(layout={"width": "auto", "height": "24em"})
        reset = widgets.Button(description="Reset", tooltip="back to the settings at the start")
        reset.on_click(self._reset)
        for name, (label, options) in _CHOICES.items():
            wide = {"description": label, "style": {"description_width": "initial"}}
            self.inputs[name] = widgets.Dropdown(options=options, **wide)
        own = OwnSystem().widget
        parts = {"panels": self._image, "verdict": self._verdict, "code": self._code}
        parts |= {"theory": self._theory, "own-system": own, "reset": reset}
        for name, part in {**self.inputs, **parts}.items():
            part.add_class(f"robsmooth-{name}")
        self._reset()
        self._show(self._start, self.snapshot)
        for each in self.inputs.values():
            each.observe(self._follow_soon, "value")
        wrapped = {"layout": {"flex_flow": "row wrap"}}
        top = widgets.HBox([*(self.inputs[name] for name in _CHOICES), reset], **wrapped)
        controls = widgets.VBox([top, widgets.HBox(columns, **wrapped), self._verdict])
        pages = widgets.Tab([self._image, self._theory, self._code, own], titles=_PAGES)

        def without_sliders(change: dict) -> None:
            controls.layout.display = "none" if change["new"] == len(_PAGES) - 1 else ""

        pages.observe(without_sliders, "selected_index")
        whole = widgets.VBox([controls, pages], layout={"max_width": "1000px"})
        return whole.add_class("robsmooth-explorer")

    def _column(self, title: str, names: tuple[str, ...]) -> widgets.Widget:
        cells = [widgets.HTML(f"<b>{title}</b>"), widgets.HTML(), widgets.HTML()]
        for name in names:
            slider, number = _slider(name)
            self.inputs[name] = slider
            cells += [widgets.Label(SLIDERS[name].label), slider, number]
        grid = {"grid_template_columns": "max-content minmax(8em, 1fr) 6em"}  # in any font
        return widgets.GridBox(
            cells, layout={**grid, "flex": "1 1 22em", "align_content": "flex-start"}
        )

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
        self._by_hand.layout.display = "grid" if settings.design == "by hand" else "none"


def verdict(found: Snapshot | str) -> list[str]:
    """Return what waiting buys, what a guarantee costs, and which design is ahead, in sentences."""
    if isinstance(found, str):
        return [f"There is no design. {found}"]
    cost, with_sine = found.settings.cost, found.own.with_sine
    change = with_sine.smoothed / with_sine.filtered - 1.0
    sentences = [
        f"With the sine in the loop, waiting {1e6 * found.settings.lag:.3g} µs "
        f"{'lowers' if change < 0.0 else 'raises'} the mean square error from "
        f"{with_sine.filtered:.4f} rad² to {with_sine.smoothed:.4f} rad², by {abs(change):.1%}."
    ]
    if not found.is_complete:
        return [*sentences, JUDGING]
    certified = {name: each.judged.certified for name, each in found.found.items()}
    errors = {name: getattr(each.with_sine, cost) for name, each in found.found.items()}
    safest, best = min(certified, key=certified.get), min(errors, key=errors.get)
    if math.isinf(certified[safest]):
        sentences.append("No design has a guarantee for this uncertainty.")
    else:
        plain = found.found.get("classical", found.own).judged
        nominal = found.found[safest].judged.nominal / plain.nominal - 1.0
        none = "has no guarantee" if math.isinf(plain.certified) else "guarantees {:.4f} rad²"
        sentences.append(
            f"The lowest guarantee is that of the {safest} design: whatever the uncertainty, the "
            f"{cost} error is at most {certified[safest]:.4f} rad². The classical design "
            f"{none.format(plain.certified)}. The price, without uncertainty, is {nominal:+.1%}."
        )
    sentences.append(f"With the sine itself, the {best} design has the least error here.")
    return sentences


def _slider(name: str) -> tuple[widgets.Widget, widgets.Widget]:
    """Return a slider, and a field in which its number can be typed."""
    _, tooltip, low, high, step, _ = SLIDERS[name]
    limits = {"tooltip": tooltip, "min": low, "max": high, "step": step}
    kinds = widgets.FloatSlider, widgets.BoundedFloatText
    if name == "order":
        kinds = widgets.IntSlider, widgets.BoundedIntText
    slider = kinds[0](**limits, readout=False, layout={"width": "auto"})
    number = kinds[1](**limits, layout={"width": "auto"})
    digits = len(f"{step:g}".partition(".")[2])  # a browser's 0.4 may be 0.39999999999999997
    rounded = (lambda value: round(value, digits)), (lambda value: value)
    link((slider, "value"), (number, "value"), rounded)
    slider.add_class(f"robsmooth-{name}")
    number.add_class(f"robsmooth-{name}-number")
    return slider, number
