"""One BLAS thread for the many small problems here: more cost several times what they save."""

from collections.abc import Callable
from typing import TypeVar

import scipy.linalg  # noqa: F401 - only libraries that are loaded by now are found; this loads all
from threadpoolctl import ThreadpoolController

F = TypeVar("F", bound=Callable)
_LIBRARIES = ThreadpoolController()


def one_thread(function: F) -> F:
    """Have a function run with one BLAS thread; what calls it keeps its own number."""
    return _LIBRARIES.wrap(limits=1, user_api="blas")(function)
