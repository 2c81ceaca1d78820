"""What the kernels share: the count of cycle slips, threads, and when compiled code is stale."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numba
import numpy as np
from numba import njit

from robsmooth.homodyne.montecarlo import noise

TURN = 2 * np.pi
SLIP = 0.75 * TURN  # this far from the point that it was locked to, a loop is at the next one


@njit
def slip(away):
    """By how many turns a path has slipped, from how far it is from where it was locked: 0 or +-1.

    A loop is locked where its phase is near the local oscillator's, up to whole turns. The quarter
    turn beyond the middle keeps a single passage from being counted more than once.
    """
    return (1.0 if away > SLIP else 0.0) - (1.0 if away < -SLIP else 0.0)


@contextmanager
def threads_of_kernels(count: int | None) -> Iterator[None]:
    """Have kernels use `count` threads, or as many of them as there are; None changes nothing."""
    if count is None:
        yield
        return
    before = numba.get_num_threads()
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        numba.set_num_threads(before)


def shared_sources() -> str:
    """Digest of what is compiled into each kernel, besides its own file.

    A default argument of this value has the kernel compiled anew when one of the sources changes:
    numba itself looks at the kernel's own file only.
    """
    sources = (Path(file) for file in (__file__, noise.__file__))
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
