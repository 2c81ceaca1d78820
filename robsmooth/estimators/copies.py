"""Functions that compiled code calls by address, such as an estimator's copies of nonlinearities.

A loop is compiled once for all. What numba cannot compile is called in Python.
"""

import ctypes
import signal
import threading
import warnings
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core.errors import NumbaError
from numba.extending import intrinsic, is_jitted, overload
from numpy.typing import NDArray

from robsmooth._support import validation
from robsmooth.systems.channels import Nonlinearity
from robsmooth.systems.functions import Combination, compiled, name_of

_Vectorized = type(numba.vectorize(lambda value: value))
_TRIED = np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 20), -np.geomspace(1e-6, 1e3, 20)])
_ROUNDING = 1e-12  # by which a compiled function may differ from the one given
Function = Callable[[Any], Any]
# Of the time, the addresses of the arguments and of the values, and the number of arguments.
_Called = ctypes.CFUNCTYPE(None, ctypes.c_double, *3 * [ctypes.c_ssize_t])
_REALS = types.CPointer(types.float64)


def running_copies(estimator: Any) -> list[int]:
    """Return the indices of the copies that have an argument and a gain."""
    system = estimator.plant.system
    inputs, arguments = estimator.B_c[:, system.l :], estimator.C_c[system.m :]
    return [i for i in range(system.g) if inputs[:, i].any() and arguments[i].any()]


def running_functions(
    nonlinearities: Sequence[Nonlinearity],
    given: Iterable[Function | None] | None,
    running: Sequence[int],
) -> tuple[Function, ...]:
    """Return the functions of the running copies: the given one, or by default the plant's."""
    given = [None] * len(nonlinearities) if given is None else given
    given = validation.sequence("functions", given, "callables", len(nonlinearities))
    functions = [
        own.function if f is None else replace(own, function=f).function
        for own, f in zip(nonlinearities, given, strict=True)
    ]
    for i in running:
        if functions[i] is None:
            how = "give Nonlinearity(..., function=psi), or discretize(dt, functions=[psi])"
            why = "because the estimator runs a copy of it"
            raise ValueError(f"nonlinearities[{i}] must have a function, {why}: {how}")
    return tuple(functions[i] for i in running)


class CalledFunctions:
    """Functions by their addresses, which are those of this process.

    Of each, there is the code of `of_rows`, or None; the function of t and (outputs, paths) that
    gives (inputs, paths), which is called in Python where there is no code; and these two numbers.
    """

    def __init__(self, parts: Iterable[tuple[Any, Callable[[float, Any], Any], int, int]]) -> None:
        self.in_python, self._kept, self._errors = False, [], list[BaseException]()
        for code, *of in parts:
            self.in_python |= code is None
            self._kept.append(code or self._called_back(*of))
        pointers = (getattr(code, "ctypes", code) for code in self._kept)
        addresses = [ctypes.cast(pointer, ctypes.c_void_p).value for pointer in pointers]
        self.addresses = np.array(addresses, dtype=np.intp)

    def _called_back(self, function: Callable[[float, Any], Any], outputs: int, inputs: int) -> Any:
        """Return a function in Python: its first error is kept, and then nothing is called."""

        def of_rows(time: float, arguments: int, values: int, size: int) -> None:
            paths = size // outputs
            given, found = _array(arguments, outputs, paths), _array(values, inputs, paths)
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    found[:] = np.nan if self._errors else function(time, given.copy())
            except BaseException as error:  # an interrupt, too: compiled code cannot pass it on
                self._errors.append(error)
                found[:] = np.nan

        return _Called(of_rows)

    def __enter__(self) -> None:
        """Keep interrupts for `check`: at the beginning of a callback one would be lost."""
        usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        alone = threading.current_thread() is threading.main_thread()  # which gets the signals
        self._keeps = self.in_python and usual and alone
        if self._keeps:
            signal.signal(signal.SIGINT, lambda *_: self._errors.append(KeyboardInterrupt()))

    def __exit__(self, *_: object) -> None:
        if self._keeps:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def check(self, finite: bool = True, what: str = "") -> None:
        """Raise the error of a function, or an ArithmeticError where `what` is not finite."""
        errors, self._errors[:] = self._errors[:1], []
        if errors:
            raise errors[0]
        if not finite:
            raise ArithmeticError(f"{what} left the range of floating-point numbers")


@lru_cache(maxsize=256)  # of few places in memory, which each call uses again
def _array(address: int, rows: int, count: int) -> NDArray[np.float64]:
    memory = (ctypes.c_double * (rows * count)).from_address(address)
    return np.frombuffer(memory).reshape(rows, count)


class Functions(CalledFunctions):
    """Functions of one number, which copies run."""

    def __init__(self, given: Iterable[Function]) -> None:
        self.given = tuple(given)
        jit = not numba.config.DISABLE_JIT
        codes = [_of_copy(f) if jit and isinstance(f, Hashable) else None for f in self.given]
        super().__init__(
            (code, lambda _, x, function=function: np.asarray(function(x[0]))[0], 1, 1)
            for code, function in zip(codes, self.given, strict=True)
        )
        self.compiled = jit and not self.in_python

    def __reduce__(self) -> tuple[type, tuple[tuple[Function, ...]]]:
        return type(self), (self.given,)


@lru_cache(maxsize=64)
def _of_copy(function: Function) -> Any:
    """Return a function as `of_rows` compiles it; None, with a warning, if it cannot."""
    code = of_rows(function)
    own = is_jitted(function) or isinstance(function, _Vectorized)
    if code is not None and (own or _agree(function, code)):
        return code
    warnings.warn(
        f"numba cannot compile the function {name_of(function)}, which a copy runs: each sample "
        "calls it in Python, which takes some microseconds",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _agree(function: Function, code: Any) -> bool:
    with np.errstate(all="ignore"):
        expected = np.asarray(function(_TRIED))
    call(code.address, 0.0, _TRIED, found := np.empty_like(_TRIED))
    return np.allclose(found, expected, rtol=_ROUNDING, atol=_ROUNDING, equal_nan=True)


@lru_cache(maxsize=64)
def of_rows(function: Function) -> Any:
    """Return compiled code that calls a function of a number for each argument, or None."""
    try:
        of_number = jitted(function)

        @numba.cfunc(types.void(types.float64, _REALS, _REALS, types.intp))
        def code(_, arguments, values, count):
            given, found = numba.carray(arguments, (count,)), numba.carray(values, (count,))
            for i in range(count):
                try:
                    found[i] = of_number(given[i])
                except Exception:
                    found[i] = np.nan

    except (NumbaError, TypeError):
        return None
    return code


def is_compiled(function: Function) -> bool:
    """Tell whether numba or NumPy has compiled a function, or what it is a combination of."""
    while isinstance(function, Combination):
        function = function.function
    return is_jitted(function) or isinstance(function, _Vectorized | np.ufunc)


def jitted(function: Function) -> Function:
    """Return a function that compiled code can call."""
    if is_jitted(function) or isinstance(function, _Vectorized):
        return function
    if isinstance(function, Combination):
        return compiled(replace(function, function=jitted(function.function)))
    if isinstance(function, np.ufunc):
        return numba.njit(lambda argument: function(argument))
    return numba.njit(function)


def call(address: int, time: float, arguments: NDArray, values: NDArray) -> None:
    """Write the values of the function at an address."""
    _Called(int(address))(time, arguments.ctypes.data, values.ctypes.data, arguments.size)


@intrinsic
def call_at(_typing, address, time, arguments, values, count):
    """Do as `call`, with pointers to the first of `count` arguments and values."""

    def generate(_context, builder, _signature, given):
        real, word = ir.DoubleType(), ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [real, word, word, word])
        builder.call(builder.inttoptr(given[0], kind.as_pointer()), given[1:])
        return ir.Constant(ir.IntType(1), 0)

    words = (types.intp, types.float64, types.intp, types.intp, types.intp)
    return types.boolean(*words), generate


@overload(call)
def _compiled_call(address, time, arguments, values):
    def called(address, time, arguments, values):
        call_at(address, time, arguments.ctypes.data, values.ctypes.data, arguments.size)

    return called
