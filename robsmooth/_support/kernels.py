"""Functions that numba compiles, on machines where it cannot keep them or is switched off."""

import warnings
from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])


def kept(**options: bool) -> Callable[[F], F]:
    """Return `numba.njit` with these options, which keeps what it compiles where it can."""

    def decorate(function: F) -> F:
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


def check_compiler(what: str) -> None:
    """Check that NUMBA_DISABLE_JIT does not switch numba's compiler off."""
    if numba.config.DISABLE_JIT:
        raise RuntimeError(
            f"{what} needs numba's compiler, which NUMBA_DISABLE_JIT switches off: unset it"
        )
