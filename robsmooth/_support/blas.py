"""One BLAS thread: for many small matrices, more threads cost several times what they save."""

import os
import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import scipy.linalg  # noqa: F401 - loads the BLAS libraries, so that the controller finds them
from threadpoolctl import ThreadpoolController

F = TypeVar("F", bound=Callable[..., Any])


class _OneThread:
    """The limit, which is the process's: the first call sets it and the last one takes it back.

    An interrupt may come at any step; so the way out may be taken again, and is.
    """

    def __init__(self) -> None:
        self._libraries = ThreadpoolController().select(user_api="blas").lib_controllers
        self._calls: dict[object, int] = {}  # that run now, with their threads
        self._original: list[int] = []  # numbers of threads, while there is the limit
        self._renew()
        if hasattr(os, "register_at_fork"):  # not on Windows
            os.register_at_fork(after_in_child=self._renew)

    def _renew(self) -> None:
        self._lock, here = threading.Lock(), threading.get_ident()  # a child has one thread only
        self._calls = {call: thread for call, thread in self._calls.items() if thread == here}

    def __call__(self, function: F) -> F:
        @wraps(function)
        def limited(*arguments: Any, **options: Any) -> Any:
            call = object()
            try:
                self._enter(call)
                return function(*arguments, **options)
            finally:
                try:
                    self._leave(call)
                finally:  # again, as an interrupt may have ended it
                    self._leave(call)

        return limited  # type: ignore[return-value]

    def _enter(self, call: object) -> None:
        with self._lock:
            self._calls[call] = threading.get_ident()
            if not self._original:
                self._original = [library.num_threads for library in self._libraries]
                self._set([1] * len(self._libraries))

    def _leave(self, call: object) -> None:
        with self._lock:
            self._calls.pop(call, None)
            if self._original and not self._calls:
                self._set(self._original)
                self._original = []

    def _set(self, numbers: list[int]) -> None:
        for library, number in zip(self._libraries, numbers, strict=True):
            # since threadpoolctl 3.7 only one thread may set it, unless that is cleared
            clear = getattr(library, "clear_controlling_thread", lambda force: None)
            clear(force=True)
            library.set_num_threads(number)
            clear(force=True)


one_thread = _OneThread()
