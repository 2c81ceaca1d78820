"""The explorer: what is drawn when.

A little after the last event of a slider the newest settings are drawn, with what is found at once.
The certified errors are found in a thread when the sliders rest, and drawn when they are there.
"""

import asyncio
import base64
from concurrent.futures import ThreadPoolExecutor

from IPython import get_ipython

from robsmooth.explorer.controls import Controls
from robsmooth.explorer.describe import code, summary
from robsmooth.explorer.panels import Panels
from robsmooth.explorer.snapshot import Settings, Snapshot, judge, take_snapshot

DEBOUNCE = 0.004  # s without an event, before the newest settings are drawn
REST = 0.2  # s without an event, before the certified errors are sought

_thread = ThreadPoolExecutor(1, "robsmooth-explorer")


class Explorer:
    """Panels that show what a design does at some settings, and sliders for these.

    As the value of a notebook's cell it shows itself, with its sliders where they can be moved.
    """

    def __init__(self, settings: Settings | None = None):
        self.controls: Controls | None = None
        self._settings = settings or Settings()
        self._panels = Panels()
        self._following: asyncio.Task | None = None
        self._draw(take_snapshot(self._settings))

    @property
    def settings(self) -> Settings:
        """What the sliders say."""
        return self.controls.settings if self.controls else self._settings

    @property
    def snapshot(self) -> Snapshot:
        """What is shown, with all that there is to see."""
        self._draw(judge(take_snapshot(self.settings)))
        return self._snapshot

    def show_controls(self) -> Controls:
        """Return the sliders, which from now on say what is shown."""
        if self.controls is None:
            self.controls = Controls(self._settings, self._redraw)
            self._draw(self._snapshot)  # what is displayed has its image from the start
            self._redraw()
        return self.controls

    def __repr__(self) -> str:
        return f"Explorer({self.settings})"

    def _repr_mimebundle_(self, **_) -> dict[str, object]:
        live = self.show_controls().widget._repr_mimebundle_() if can_show_widgets() else {}
        shown = self._snapshot if live else self.snapshot
        image = base64.b64encode(self._panels.png()).decode()
        return {**live, "image/png": image, "text/plain": summary(shown)}

    def _redraw(self) -> None:
        """Have the newest settings drawn: soon, or at once where there is no event loop."""
        if self.controls is None:  # they are being made
            return
        if self._following:
            self._following.cancel()
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:
            self._draw(judge(take_snapshot(self.settings)))
        else:
            self._following = loop.create_task(self._follow(loop))

    async def _follow(self, loop: asyncio.AbstractEventLoop) -> None:
        """Draw what is found at once, and later all; newer settings cancel this."""
        await asyncio.sleep(DEBOUNCE)
        self._draw(take_snapshot(self.settings))
        await asyncio.sleep(REST)
        self._draw(await loop.run_in_executor(_thread, judge, self._snapshot))

    def _draw(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        self._panels.update(snapshot)
        if self.controls:
            settings = snapshot.settings
            self.controls.update(self._panels.png(), summary(snapshot), code(settings))


def can_show_widgets() -> bool:
    """Tell whether a frontend could show sliders: in a batch it could answer no question either."""
    kernel = getattr(get_ipython(), "kernel", None)
    return bool(kernel and kernel.get_parent("shell").get("content", {}).get("allow_stdin"))
