"""The explorer: what is drawn when.

A little after the last event of a slider the newest settings are drawn, with what is found at once.
The simulation is found in a thread, for which a drawing waits a little: it takes long only where
its kernel is compiled first. The certified errors are found in another when the sliders rest. All
is drawn again when there is more.
"""

import asyncio
import base64
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial

from IPython import get_ipython
from matplotlib.figure import Figure

from robsmooth.explorer.controls import Controls
from robsmooth.explorer.describe import code, summary
from robsmooth.explorer.panels import Panels
from robsmooth.explorer.snapshot import Settings, Snapshot, judge, simulate, take_snapshot

DEBOUNCE = 0.004  # s without an event, before the newest settings are drawn
REST = 0.2  # s without an event, before the certified errors are sought
SIMULATION_TIMEOUT = 0.5  # s that a drawing waits for its simulation, where it may come later

_threads = ThreadPoolExecutor(2, "robsmooth-explorer")


class Explorer:
    """Panels that show what a design does at some settings, and sliders for these.

    As the value of a notebook's cell it shows itself, with its sliders where they can be moved.
    """

    def __init__(self, settings: Settings | None = None):
        self.controls: Controls | None = None
        self._settings = settings or Settings()
        self._panels = Panels()
        self._timer: asyncio.TimerHandle | None = None
        self._snapshot = take_snapshot(self._settings)
        self._simulated = _Later(simulate)
        self._judged = _Later(judge)
        self._redraw()

    @property
    def settings(self) -> Settings:
        """What the sliders say."""
        return self.controls.settings if self.controls else self._settings

    @property
    def snapshot(self) -> Snapshot:
        """What is shown."""
        self._draw()
        return self._snapshot

    @property
    def figure(self) -> Figure:
        """The panels."""
        self._draw()
        return self._panels.figure

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
            self._draw()
        image = base64.b64encode(self._panels.png()).decode()
        return {**live, "image/png": image, "text/plain": summary(self._snapshot)}

    def _redraw_soon(self) -> None:
        """Have the newest settings drawn: soon, or at once where there is no event loop."""
        if self._timer is not None:
            self._timer.cancel()
        if loop := _running_loop():
            self._timer = loop.call_later(DEBOUNCE, self._redraw)
        else:
            self._redraw()

    def _redraw(self) -> None:
        """Draw the newest settings, and again when there is more; without an event loop wait."""
        if loop := _running_loop():
            again = partial(loop.call_soon_threadsafe, self._redraw_soon)
            self._draw(again)
            self._timer = loop.call_later(REST, self._judged.get, self._snapshot, 0.0, again)
        else:
            self._draw()
        self._update_controls()

    def _draw(self, again: Callable[[], object] | None = None) -> None:
        """Draw the newest settings with all that there is to see, or, given `again`, with less."""
        if self._snapshot.settings != self.settings:
            self._snapshot = take_snapshot(self.settings)
        simulated = self._simulated.get(self._snapshot, SIMULATION_TIMEOUT, again)
        found = {} if simulated is None else {"simulated": simulated}
        if again is None or self._judged.known(self._snapshot):
            found["judged"] = self._judged.get(self._snapshot, 0.0, again)
        self._snapshot = replace(self._snapshot, **found)
        self._panels.update(self._snapshot)

    def _update_controls(self) -> None:
        if self.controls:
            described = summary(self._snapshot)
            self.controls.update(self._panels.png(), described, code(self.settings))


class _Later:
    """What a function finds of the newest snapshot, in a thread, one at a time."""

    def __init__(self, find: Callable[[Snapshot], object]):
        self._find, self._settings, self._future = find, None, Future()
        self._future.set_result(None)

    def get(self, snapshot: Snapshot, timeout: float, again: Callable | None) -> object:
        """Return what is found; without `again` wait for it.

        Return None where it takes longer than `timeout` (s), and call `again` when it is there.
        """
        if again is None:
            wait([self._future])
        if self._future.done() and self._settings != snapshot.settings:
            self._future, self._settings = _threads.submit(self._find, snapshot), snapshot.settings
            wait([self._future], timeout if again else None)
            if not self._future.done():
                self._future.add_done_callback(lambda _: again())
        return self._future.result() if self.known(snapshot) else None

    def known(self, snapshot: Snapshot) -> bool:
        return self._future.done() and self._settings == snapshot.settings


def can_show_widgets() -> bool:
    """Tell whether a frontend could show sliders: in a batch it could answer no question either."""
    kernel = getattr(get_ipython(), "kernel", None)
    return bool(kernel and kernel.get_parent("shell").get("content", {}).get("allow_stdin"))


def _running_loop() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None
