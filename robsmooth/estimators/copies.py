"""An estimator's copies of nonlinearities, as functions that compiled code calls by address.

The loop over samples is compiled once for all. What numba cannot compile is called in Python.
"""

import ctypes
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

from robsmooth.systems.channels import Nonlinearity
from robsmooth.systems.functions import Combination, compiled, name_of

_Vectorized = type(numba.vectorize(lambda value: value))
_TRIED = np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 20), -np.geomspace(1e-6, 1e3, 20)])
_ROUNDING = 1e-12  # by which a compiled function may differ from the one given
Function = Callable[[Any], Any]
_Address = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)


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
    if callable(given):
        raise TypeError("functions must be a sequence of callables, got a single one")
    given = [None] * len(nonlinearities) if given is None else list(given)
    if len(given) != len(nonlinearities):
        raise ValueError(
            f"functions must have {len(nonlinearities)} entries, one for each nonlinearity, got "
            f"{len(given)}"
        )
    functions = [
        own.function if f is None else replace(own, function=f).function
        for own, f in zip(nonlinearities, given, strict=True)
    ]
    for i in running:
        if functions[i] is None:
            raise ValueError(
                f"nonlinearities[{i}] must have a function, because the estimator runs a copy of "
                "it: give Nonlinearity(..., function=psi), or discretize(dt, functions=[psi])"
            )
    return tuple(functions[i] for i in running)


class Functions:
    """Functions of one number, and their addresses for compiled code."""

    def __init__(self, given: Iterable[Function]) -> None:
        self.given = tuple(given)
        self.error: Exception | None = None  # of a function that was called back
        jit = not numba.config.DISABLE_JIT
        numbers = [_of_number(f) if jit and isinstance(f, Hashable) else None for f in self.given]
        self.compiled = jit and all(numbers)
        pairs = zip(self.given, numbers, strict=True)
        self._kept = [number or self._called_back(function) for function, number in pairs]
        self.addresses = addresses_of(self._kept)

    def __reduce__(self) -> tuple[type, tuple[tuple[Function, ...]]]:
        return type(self), (self.given,)

    def _called_back(self, function: Function) -> Any:
        def value(argument: float) -> float:
            try:
                return float(np.asarray(function(np.array([argument])))[0])
            except Exception as error:
                self.error = error
                return np.nan

        return _Address(value)

    def check(self, finite: bool, what: str) -> None:
        """Raise the error of a function, or an ArithmeticError where `what` is not finite."""
        error, self.error = self.error, None
        if error is not None:
            raise error
        if not finite:
            raise ArithmeticError(f"{what} left the range of floating-point numbers")


def addresses_of(functions: Iterable[Any]) -> np.ndarray:
    """Return the addresses of functions of ctypes, or that numba compiled for calls from C."""
    pointers = (getattr(function, "ctypes", function) for function in functions)
    addresses = [ctypes.cast(pointer, ctypes.c_void_p).value for pointer in pointers]
    return np.array(addresses, dtype=np.intp)


@lru_cache(maxsize=64)
def _of_number(function: Function) -> Any:
    """Return a function as numba compiles it for a number; None, with a warning, if it cannot."""
    try:
        of_argument = jitted(function)

        @numba.cfunc(types.float64(types.float64), error_model="numpy")
        def number(argument):
            try:
                return of_argument(argument)
            except Exception:
                return np.nan

    except (NumbaError, TypeError):
        pass
    else:
        called = _Address(number.address)
        if is_jitted(function) or isinstance(function, _Vectorized) or _agree(function, called):
            return number
    warnings.warn(
        f"numba cannot compile the function {name_of(function)}, which a copy runs: each sample "
        "calls it in Python, which takes some microseconds",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _agree(function: Function, number: Callable[[float], float]) -> bool:
    with np.errstate(all="ignore"):
        expected = np.asarray(function(_TRIED))
    found = [number(argument) for argument in _TRIED]
    return np.allclose(found, expected, rtol=_ROUNDING, atol=_ROUNDING, equal_nan=True)


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


def call(address: int, argument: float) -> float:
    """Call the function at an address."""
    return _Address(int(address))(argument)


@intrinsic
def _call(_typing, address, argument):
    def generate(_context, builder, _signature, arguments):
        kind = ir.FunctionType(ir.DoubleType(), [ir.DoubleType()])
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), [arguments[1]])

    return types.float64(types.intp, types.float64), generate


@overload(call)
def _compiled_call(address, argument):
    return lambda address, argument: _call(address, argument)
