"""The explorer: sliders with the verdict and figures at their settings, and a page for a system."""

import asyncio
import base64
import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict
from functools import cached_property
from html import escape

import ipywidgets as widgets
import numpy as np
from IPython import get_ipython

from robsmooth.analysis.choice import WORTHWHILE
from robsmooth.estimators.conditions import COSTS
from robsmooth.explorer.own_system import OwnSystem
from robsmooth.explorer.panels import JUDGED, OVERVIEW, PANELS, THEORY, Panel, png
from robsmooth.explorer.snapshot import DESIGNS, SLIDERS, Settings, Snapshot, take_snapshot

DEBOUNCE = 0.004  # s without an event before the settings are drawn
REST = 0.2  # s more before the other designs are made, and all are judged
JUDGING = "The designs are being compared."
_COLUMNS = {
    "The smoother": ("design", "cost", "delay", "order", "gamma"),
    "The light": ("noise", "lam", "kappa"),
    "A design by hand": ("tau", "lambda1", "lambda2", "lambda3", "lambda4"),
}
_CHOICES = {"design": ("design", DESIGNS), "cost": ("error kept low", COSTS)}
# A slider's number can be typed, and looks like it; a tab is as wide as its title.
_STYLE = """<style>
.robsmooth-explorer .widget-readout { border: 1px solid #bbb; }
.robsmooth-explorer .lm-TabBar-tab { flex: none !important; }
.robsmooth-old { opacity: 0.5; transition: opacity 0.2s 0.3s; }
</style>"""
_WRAPPED = {"flex_flow": "row wrap"}


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
        said = {"text/plain": " ".join(verdict(found))}
        if isinstance(found, str):
            return live | said
        first, second, *rest = (Panel(title).pixels(found) for title in OVERVIEW)
        image = png(np.vstack([np.hstack([first, second]), np.hstack(rest)]))
        return {**live, **said, "image/png": base64.b64encode(image).decode()}

    @cached_property
    def widget(self) -> widgets.Widget:
        """The sliders and all that follows them, and the page for a system."""
        self.inputs = {name: _input(name) for names in _COLUMNS.values() for name in names}
        self._panels = {title: Panel(title) for title in PANELS}
        look = {"flex": "1 1 45%", "min_width": "min(20em, 100%)"}
        self._images = {title: widgets.Image(layout=look) for title in PANELS}
        rows = ([*map(self._images.get, titles)] for titles in (OVERVIEW, THEORY))
        figures, theory = (widgets.HBox(row, layout=_WRAPPED) for row in rows)
        self._verdict = widgets.HTML(layout={"min_height": "10.5em"})  # the figure stays in place
        self._code = widgets.Textarea(layout={"width": "auto", "height": "24em"})
        reset = widgets.Button(description="Reset", tooltip="back to the settings at the start")
        reset.on_click(self._reset)
        parts = {**self.inputs, "panels": figures, "theory": theory, "code": self._code}
        for name, part in {**parts, "verdict": self._verdict, "reset": reset}.items():
            part.add_class(f"robsmooth-{name}")
        columns = [widgets.VBox(layout={"flex": "1 1 22em"}) for _ in _COLUMNS]
        for column, (title, names) in zip(columns, _COLUMNS.items(), strict=True):
            column.children = [widgets.HTML(f"<b>{title}</b>"), *map(self.inputs.get, names)]
        _, light, self._by_hand = columns
        light.children += (reset,)
        self._by_hand.layout.flex = "1 1 100%"
        self._views = widgets.Tab([figures, theory, self._code])
        self._views.titles = "Figures", "For theorists", "The code"
        self._shown = widgets.VBox([self._verdict, self._views])
        self._reset()
        self._show(self._start, take_snapshot(self._start), PANELS)
        self.inputs["design"].observe(self._start_by_hand, "value")
        for each in self.inputs.values():
            each.observe(self._follow_soon, "value")
        self._views.observe(self._show_theory, "selected_index")
        row = widgets.HBox(columns, layout=_WRAPPED)
        loop = widgets.VBox([widgets.HTML(_STYLE), row, self._shown])
        pages = widgets.Tab([loop, OwnSystem().widget], layout={"max_width": "1000px"})
        pages.titles = "The paper's loop", "Your own system"
        return pages.add_class("robsmooth-explorer")

    def _reset(self, _=None) -> None:
        for name, value in asdict(self._start).items():
            self.inputs[name].value = SLIDERS[name].shown(value) if name in SLIDERS else value

    def _start_by_hand(self, _=None) -> None:
        with suppress(ValueError, ArithmeticError, RuntimeError):  # there is none: leave it
            if self.settings.design == "by hand":
                self.inputs["tau"].value = SLIDERS["tau"].shown(self.settings.best_tau())

    def _follow_soon(self, _=None) -> None:
        self._shown.add_class("robsmooth-old")
        if self._following:
            self._following.cancel()
        self._following = asyncio.ensure_future(self._follow())

    async def _follow(self) -> None:
        """Show the quick results, then all; newer settings cancel this."""
        await asyncio.sleep(DEBOUNCE)
        settings = self.settings
        self._show(settings, take_snapshot(settings, complete=False))
        await asyncio.sleep(REST)
        self._show(settings, await asyncio.to_thread(take_snapshot, settings), [JUDGED])

    def _show(self, settings: Settings, found: Snapshot | str, panels: Iterable = OVERVIEW) -> None:
        self._found = found
        self._views.layout.visibility = "hidden" if isinstance(found, str) else "visible"
        self._draw(panels)
        self._show_theory()
        sentences = "</p><p>".join(map(escape, verdict(found)))
        self._verdict.value = f'<div style="line-height: 1.3"><p>{sentences}</p></div>'
        self._code.value = settings.code()
        self._by_hand.layout.display = "flex" if settings.design == "by hand" else "none"
        self._shown.remove_class("robsmooth-old")

    def _show_theory(self, _=None) -> None:
        if self._views.selected_index == 1:
            self._draw(THEORY)

    def _draw(self, titles: Iterable[str]) -> None:
        for title in titles if isinstance(self._found, Snapshot) else ():
            self._images[title].value = png(self._panels[title].pixels(self._found))


def verdict(found: Snapshot | str) -> list[str]:
    """Return what waiting buys, what a guarantee costs, and which design is ahead, in sentences."""
    if isinstance(found, str):
        return [f"There is no design. {found}"]
    cost, with_sine = found.settings.cost, found.own.with_sine
    change = with_sine.smoothed / with_sine.filtered - 1.0
    waiting = (
        f"With the sine in the loop, waiting {1e6 * found.settings.delay:.3g} µs "
        f"{'lowers' if change < 0.0 else 'raises'} the mean square error from "
        f"{with_sine.filtered:.4f} rad² to {with_sine.smoothed:.4f} rad², by {abs(change):.1%}."
    )
    if not found.is_complete:
        return [waiting, JUDGING]
    errors = {name: getattr(each.with_sine, cost) for name, each in found.found.items()}
    best, tie = _best(errors)
    sine = f"With the sine, the {_named(best)} has the lowest error{tie}: {errors[best]:.4f} rad²."
    return [waiting, _guarantee(found), sine]


def _guarantee(found: Snapshot) -> str:
    """Return which guarantee is the lowest, what it costs, and where it ends, in sentences."""
    certified = {name: each.judged.certified for name, each in found.found.items()}
    if math.isinf(min(certified.values())):
        return "No design has a guarantee for this uncertainty."
    safest, tie = _best(certified)
    least, plain = (found.found[name].judged for name in (safest, "classical"))
    parts = [
        f"The {_named(safest)} has the lowest guarantee{tie}: for every curve in the sector, the "
        f"{found.settings.cost} error is at most {least.certified:.4f} rad²."
    ]
    if safest != "classical":
        none, price = math.isinf(plain.certified), least.nominal / plain.nominal - 1.0
        rest = "has none" if none else f"guarantees {plain.certified:.4f} rad²"
        parts.append(f"The classical design {rest}.")
        more = f"{abs(price):.1%} {'higher' if price > 0.0 else 'lower'}"
        parts.append(f"Without uncertainty the error of the lowest is {more}.")
    deviation = found.own.with_sine.filtered**0.5
    outside = math.erfc(found.settings.parameters.sector_range() / (2.0**0.5 * deviation))
    if outside > 1e-3:  # of the time
        parts.append(f"The sine leaves the sector {outside:.2%} of the time: no guarantee then.")
    return " ".join(parts)


def _named(design: str) -> str:
    names = {"paper's V": "design by the paper's V", "by hand": "design by hand"}
    return names.get(design, f"{design} design")


def _best(errors: dict[str, float]) -> tuple[str, str]:
    """Return the name of the lowest error, which is the classical one's within 1%, and so."""
    best, plain = min(errors, key=errors.get), "classical"
    if best != plain and errors[plain] <= (1.0 + WORTHWHILE) * errors[best]:
        return plain, ", within 1%"
    return best, ""


def _input(name: str) -> widgets.Widget:
    wide = "9em" if name in _COLUMNS["A design by hand"] else "10em"
    look = {"layout": {"width": "auto"}, "style": {"description_width": wide}}
    if name in _CHOICES:
        label, options = _CHOICES[name]
        return widgets.Dropdown(description=label, options=options, **look)
    label, tooltip, low, high, step, _ = SLIDERS[name]
    kind = widgets.IntSlider if name == "order" else widgets.FloatSlider
    look |= {"readout_format": f".{len(f'{step:g}'.partition('.')[2])}f", "tooltip": tooltip}
    return kind(description=label, min=low, max=high, step=step, **look)
