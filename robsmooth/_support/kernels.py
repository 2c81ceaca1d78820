"""Functions that numba compiles, on machines where it cannot keep them."""

import warnings
from collections.abc import Callable

import numba


def kept(**options: bool) -> Callable[[Callable], Callable]:
    """Return `numba.njit` with these options, which keeps what it compiles where it can."""

    def decorate(function: Callable) -> Callable:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:
            warnings.warn(
                "numba may write neither beside robsmooth's sources nor in the home, so each "
                "process compiles anew, for a Monte Carlo some 15 s: set NUMBA_CACHE_DIR to a "
                "folder that can be written",
                RuntimeWarning,
                stacklevel=1,  # of one place, the same warning is shown once
            )
            return numba.njit(**options)(function)

    return decorate
