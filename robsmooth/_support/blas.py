"""One BLAS thread: for many small matrices, more threads cost several times what they save."""

from collections.abc import Callable
from typing import TypeVar

import scipy.linalg  # noqa: F401 - loads the BLAS libraries, so that the controller finds them
from threadpoolctl import ThreadpoolController

F = TypeVar("F", bound=Callable)
_LIBRARIES = ThreadpoolController()


def one_thread(function: F) -> F:
    """Return a function that runs with one BLAS thread and leaves its caller's number alone."""
    return _LIBRARIES.wrap(limits=1, user_api="blas")(function)
