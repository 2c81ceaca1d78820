"""Progress bars: where they are shown, and how.

In a notebook, a bar of ipywidgets; in a terminal, one of text. None where nobody watches: in CI
(``CI`` is set), where ``TQDM_DISABLE`` is set, as for the notebooks of the pipeline, and where
stderr goes to a file.
"""

import os
import sys
from collections.abc import Iterable
from importlib.util import find_spec

from tqdm import tqdm


def progress_bar(iterable: Iterable | None = None, *, shown: bool = True, **settings) -> tqdm:
    """Return a bar with settings of `tqdm.tqdm`, which does nothing where it is not to be shown."""
    ipython = sys.modules.get("IPython")
    in_notebook = ipython is not None and hasattr(ipython.get_ipython(), "kernel")
    shown = shown and not (_is_set("CI") or _is_set("TQDM_DISABLE"))
    if shown and in_notebook and find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm as notebook_bar

        return notebook_bar(iterable, disable=False, **settings)
    shown = shown and (in_notebook or _in_terminal())
    return tqdm(iterable, disable=not shown, **settings)


def _is_set(name: str) -> bool:
    return os.environ.get(name, "").lower() not in ("", "0", "false")


def _in_terminal() -> bool:
    return sys.stderr.isatty()
