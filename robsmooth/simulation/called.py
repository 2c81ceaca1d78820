"""The functions of a loop, by addresses that compiled code calls with a row for each argument.

What numba or NumPy has compiled runs without Python. Other functions are called back, with arrays.
"""

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from robsmooth.estimators.copies import is_compiled, jitted
from robsmooth.simulation.kernel import Calls
from robsmooth.simulation.noise import sine
from robsmooth.systems.functions import Combination, on_arrays

_REALS = types.CPointer(types.float64)
_Called = ctypes.CFUNCTYPE(None, ctypes.c_double, *3 * [ctypes.c_ssize_t])


class Function(NamedTuple):
    """Part of xi-tilde that is a function."""

    inputs: list[int]  # rows of xi-tilde
    outputs: list[int]  # rows of zeta-tilde
    function: Callable  # of a number, or of t and (outputs, paths), which gives (inputs, paths)
    elementwise: bool  # whether it is of a number: an input depends on one output

    def compiled(self) -> Any:
        """Return compiled code of (t, arguments, values, their number), or None."""
        compiled = self.elementwise and is_compiled(self.function)
        return _of_rows(self.function) if compiled else None

    def values(self, time: float, arguments: NDArray) -> NDArray:
        """Return its values, (inputs, paths), of arguments, (outputs, paths)."""
        if self.elementwise:
            return on_arrays(self.function)(arguments.ravel()).reshape(arguments.shape)
        return self.function(time, arguments)

    def called_back(self, errors: list[BaseException]) -> Any:
        """Return the same in Python: the first error is kept, and then nothing is called."""

        def of_rows(time: float, arguments: int, values: int, size: int) -> None:
            paths = size // len(self.outputs)
            given = _array(arguments, len(self.outputs), paths)
            found = _array(values, len(self.inputs), paths)
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    found[:] = np.nan if errors else self.values(time, given.copy())
            except BaseException as error:  # an interrupt, too: compiled code cannot pass it on
                errors.append(error)

        return _Called(of_rows)


@lru_cache(maxsize=256)  # of few places in memory, which each call uses again
def _array(address: int, rows: int, count: int) -> NDArray[np.float64]:
    memory = (ctypes.c_double * (rows * count)).from_address(address)
    return np.frombuffer(memory).reshape(rows, count)


def with_fast_sine(function: Callable) -> Callable:
    """Return a function with the vectorised sine of `noise`, to 2e-11, in the place of NumPy's."""
    if isinstance(function, Combination):
        return replace(function, function=with_fast_sine(function.function))
    return numba.njit(lambda value: sine(value)) if function is np.sin else function


class CalledFunctions:
    """Functions of a loop with their addresses, which are those of this process."""

    def __init__(self, functions: Sequence[Function]) -> None:
        self._errors: list[BaseException] = []
        found = [function.compiled() for function in functions]
        self.in_python = not all(found)
        pairs = zip(functions, found, strict=True)
        self._kept = [code or function.called_back(self._errors) for function, code in pairs]
        pointers = [getattr(one, "ctypes", one) for one in self._kept]
        addresses = [ctypes.cast(pointer, ctypes.c_void_p).value for pointer in pointers]
        sizes = np.reshape([(len(f.outputs), len(f.inputs)) for f in functions], (-1, 2))
        self.calls = Calls(np.array(addresses, np.intp), np.cumsum(sizes, axis=0, dtype=np.int64))

    def check(self) -> None:
        """Raise the error of a function that was called back."""
        if self._errors:
            error = self._errors[0]
            self._errors.clear()
            raise error


@lru_cache(maxsize=64)
def _of_rows(function: Callable) -> Any:
    """Return compiled code that calls a function of a number for each argument, or None."""
    of_number = jitted(with_fast_sine(function))

    def of_rows(time, arguments, values, count):
        given, found = numba.carray(arguments, (count,)), numba.carray(values, (count,))
        for i in range(count):
            found[i] = of_number(given[i])

    try:
        return numba.cfunc(types.void(types.float64, _REALS, _REALS, types.intp))(of_rows)
    except (NumbaError, TypeError):
        return None
