"""Progress bars in notebooks and terminals, unless ``CI`` or ``TQDM_DISABLE`` is set."""

import os
import sys
from collections.abc import Iterable
from importlib.util import find_spec

from tqdm import tqdm


def progress_bar(iterable: Iterable | None = None, *, shown: bool = True, **settings) -> tqdm:
    """Return a bar with settings of `tqdm.tqdm`; where none is shown, it counts in silence."""
    ipython = sys.modules.get("IPython")
    in_notebook = ipython is not None and hasattr(ipython.get_ipython(), "kernel")
    switches = (os.environ.get(name, "").lower() for name in ("CI", "TQDM_DISABLE"))
    shown = shown and all(switch in ("", "0", "false") for switch in switches)
    if shown and in_notebook and find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm as notebook_bar

        return notebook_bar(iterable, disable=False, **settings)
    shown = shown and (in_notebook or sys.stderr.isatty())
    return tqdm(iterable, disable=not shown, **settings)
