"""The signals that end a program: Ctrl-C, a request to end, a terminal that is lost."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has not the last


def handle(handler: Callable | signal.Handlers) -> dict:
    """Let a handler have the signals that this program does not ignore; return those before."""
    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    heeded = {number: old for number, old in before.items() if old not in (None, signal.SIG_IGN)}
    return {number: signal.signal(number, handler) for number in heeded}


@contextmanager
def held_back() -> Iterator[list[int]]:
    """Yield the signals that have come; the first takes effect when the block has ended."""
    came = []
    main = threading.current_thread() is threading.main_thread()  # no other has signals
    before = handle(lambda number, _: came.append(number)) if main else {}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
