"""The explorer: what is drawn when.

A little after the last event of a slider the newest settings are drawn. The first simulation of an
order compiles its kernel: it runs in a thread, for which a drawing waits a little. Where that is
not enough, its panel says so, and all is drawn again when it is there.
"""

import asyncio
import base64
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

from IPython import get_ipython
from matplotlib.figure import Figure

import robsmooth as rs
from robsmooth.explorer.controls import Controls
from robsmooth.explorer.describe import code, summary
from robsmooth.explorer.panels import PREPARING, Panels
from robsmooth.explorer.snapshot import Settings, Snapshot, simulate, take_snapshot

DEBOUNCE = 0.004  # s without an event, before the newest settings are drawn
SIMULATION_TIMEOUT = 0.5  # s that a drawing waits for its simulation, where it may come later

_thread = ThreadPoolExecutor(1, "robsmooth-simulation")


class Explorer:
    """Panels that show what a design does at some settings, and sliders for these.

    As the value of a notebook's cell it shows itself, with its sliders where they can be moved.
    """

    def __init__(self, settings: Settings | None = None):
        self.controls: Controls | None = None
        self._settings = settings or Settings()
        self._panels = Panels()
        self._timer: asyncio.TimerHandle | None = None
        self._simulation: Future | None = None
        self._simulating: Settings | None = None
        self._redraw()

    @property
    def settings(self) -> Settings:
        """What the sliders say."""
        return self.controls.settings if self.controls else self._settings

    @property
    def snapshot(self) -> Snapshot:
        """What is shown, but for the simulation."""
        return self._wait()._snapshot

    @property
    def simulated(self) -> rs.MonteCarloResult | str:
        """The simulation that is shown."""
        return self._wait()._simulated

    @property
    def figure(self) -> Figure:
        """The panels."""
        return self._wait()._panels.figure

    def show_controls(self) -> Controls:
        """Return the sliders, which from now on say what is shown."""
        if self.controls is None:
            self.controls = Controls(self._settings, self._redraw_soon)
            self._update_controls()
        return self.controls

    def __repr__(self) -> str:
        return f"Explorer({self.settings})"

    def _repr_mimebundle_(self, **_) -> dict[str, object]:
        live = self.show_controls().widget._repr_mimebundle_() if can_show_widgets() else {}
        if not live:
            self._wait()
        image = base64.b64encode(self._panels.png()).decode()
        return {**live, "image/png": image, "text/plain": summary(self._snapshot, self._simulated)}

    def _redraw_soon(self) -> None:
        """Have the newest settings drawn: soon, or at once where there is no event loop."""
        if self._timer is not None:
            self._timer.cancel()
        if loop := _running_loop():
            self._timer = loop.call_later(DEBOUNCE, self._redraw)
        else:
            self._redraw()

    def _redraw(self) -> None:
        loop, settings = _running_loop(), self.settings
        self._snapshot, self._simulated = take_snapshot(settings), PREPARING
        other = self._simulating != settings
        if self._simulation is None or (other and self._simulation.done()):
            self._simulation, self._simulating = _thread.submit(simulate, self._snapshot), settings
            try:
                self._simulation.result(SIMULATION_TIMEOUT if loop else None)
            except TimeoutError:
                self._simulation.add_done_callback(
                    lambda _: loop.call_soon_threadsafe(self._redraw_soon)
                )
        if self._simulation.done() and self._simulating == settings:
            self._simulated = self._simulation.result()
        self._panels.update(self._snapshot, self._simulated)
        self._update_controls()

    def _update_controls(self) -> None:
        if self.controls:
            described = summary(self._snapshot, self._simulated)
            self.controls.update(self._panels.png(), described, code(self.settings))

    def _wait(self) -> Self:
        """Wait until the newest settings are drawn, simulation and all."""
        while self._simulated is PREPARING or self._snapshot.settings != self.settings:
            self._simulation.result()
            self._redraw()
        return self


def can_show_widgets() -> bool:
    """Tell whether a frontend could show sliders: in a batch it could answer no question either."""
    kernel = getattr(get_ipython(), "kernel", None)
    return bool(kernel and kernel.get_parent("shell").get("content", {}).get("allow_stdin"))


def _running_loop() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None
