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
    """Return a progress bar, which does nothing where it is not to be shown.

    Parameters
    ----------
    iterable : iterable, optional
        To go through; without one, ``.update(count)`` says how far it is.
    shown : bool
        Whether to show it, where somebody may watch.
    **settings
        Those of `tqdm.tqdm`, such as total and unit.

    Returns
    -------
    tqdm.tqdm
    """
    in_notebook = _in_notebook()
    disabled = _is_set("CI") or _is_set("TQDM_DISABLE")
    shown = shown and not disabled and (in_notebook or _in_terminal())
    if shown and in_notebook and find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm as notebook_bar

        return notebook_bar(iterable, disable=False, **settings)
    return tqdm(iterable, disable=not shown, **settings)


def _is_set(name: str) -> bool:
    return os.environ.get(name, "").lower() not in ("", "0", "false")


def _in_terminal() -> bool:
    return sys.stderr.isatty()


def _in_notebook() -> bool:
    """Tell whether this is a Jupyter kernel."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return hasattr(shell, "kernel")
