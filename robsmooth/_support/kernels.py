"""Functions that numba compiles, and keeps on disk where it can."""

import warnings
from collections.abc import Callable

import numba


def kept(**options: bool) -> Callable[[Callable], Callable]:
    """Return `numba.njit` with these options and, where possible, a cache on disk."""

    def decorate(function: Callable) -> Callable:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:
            warnings.warn(
                "numba may write neither beside robsmooth's sources nor in the home, so each "
                "process compiles anew: set NUMBA_CACHE_DIR to a folder that can be written",
                RuntimeWarning,
                stacklevel=1,  # one place: Python shows the warning once
            )
            return numba.njit(**options)(function)

    return decorate
