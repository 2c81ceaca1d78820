"""One BLAS thread: for many small matrices, more threads cost several times what they save."""

import os
import threading
from contextlib import ContextDecorator

import scipy.linalg  # noqa: F401 - loads the BLAS libraries, so that the controller finds them
from threadpoolctl import ThreadpoolController


class _OneThread(ContextDecorator):
    """The limit, which is the process's: the first call sets it and the last one takes it back."""

    def __init__(self) -> None:
        self._libraries = ThreadpoolController().select(user_api="blas")
        self._calls = 0
        self._renew_lock()
        if hasattr(os, "register_at_fork"):  # not on Windows
            os.register_at_fork(after_in_child=self._renew_lock)

    def _renew_lock(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        with self._lock:
            if not self._calls:
                self._limit = self._libraries.limit(limits=1)
            self._calls += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._calls -= 1
            if not self._calls:
                self._let_any_thread_set_it()
                self._limit.restore_original_limits()
                self._let_any_thread_set_it()

    def _let_any_thread_set_it(self) -> None:
        for library in self._libraries.lib_controllers:
            if hasattr(library, "clear_controlling_thread"):  # threadpoolctl 3.7 and above
                library.clear_controlling_thread(force=True)


one_thread = _OneThread()
