"""Functions of nonlinearities, vectorised or compiled by numba."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from robsmooth._support import validation

Function = Callable[[Any], Any]


@dataclass(frozen=True)
class Combination:
    r"""The function :math:`\nu \mapsto b f(a\nu) - c\nu`, which can be pickled if f can."""

    function: Function
    argument: float = 1.0  # a
    value: float = 1.0  # b
    slope: float = 0.0  # c
    called: str = ""  # its name, by default a formula

    @property
    def __name__(self) -> str:
        if self.called:
            return self.called
        name = name_of(self.function)
        if (self.argument, self.value) != (1.0, 1.0):
            name = f"{self.value:.6g} {name}({self.argument:.6g} nu)"
        return f"{name} - {self.slope:.6g} nu" if self.slope else name

    def __call__(self, nu: Any) -> Any:  # noqa: D102
        value = self.function(np.multiply(self.argument, nu))
        return self.value * value - np.multiply(self.slope, nu)


def compiled(made: Combination) -> Function:
    """Return a combination, compiled by numba if its function is."""
    return _compiled(made) if hasattr(made.function, "py_func") else made


@lru_cache(maxsize=64)
def _compiled(made: Combination) -> Function:
    import numba

    function, a, b, c, _ = vars(made).values()

    def of_number(nu):
        return b * function(a * nu) - c * nu

    of_number.__qualname__ = of_number.__name__ = made.__name__
    return numba.njit(of_number)


def name_of(function: Function) -> str:
    """Return the name that a function is saved by."""
    called = getattr(function, "__name__", type(function).__qualname__)  # NumPy's, before 2.2
    return getattr(function, "__qualname__", called)


def check_function(name: str, function: Function) -> None:
    """Check that a function is vectorised, and zero at zero."""
    if not callable(function):
        raise TypeError(f"{name} must be callable, got {validation.shown(function)}")
    at = np.zeros(2)
    if hasattr(function, "py_func"):  # compiled by numba: it may be for scalars only
        with suppress(Exception):
            function(0.0)
            at = 0.0
    try:
        values = np.asarray(function(at))
    except Exception as error:
        cause = f"{type(error).__name__}: {validation.line(error)}"
        hint = "NumPy's functions are (np.sin, not math.sin), and numpy.vectorize makes any so"
        what = f"an array of shape (2,) gave {cause}; {hint}"
        raise ValueError(f"{name} must be vectorised: {what}") from error
    if values.shape != np.shape(at):
        given = f"an argument of shape {np.shape(at)} gave shape {values.shape}"
        raise ValueError(f"{name} must be vectorised: {given}")
    at_zero = np.ravel(values)[0]
    if at_zero != 0.0:
        hint = "move the constant into the measurement or the state"
        raise ValueError(f"{name} must be zero at zero, got {at_zero}: {hint}")


def on_arrays(function: Function) -> Function:
    """Return the function for arrays of one dimension, compiled for them if it is numba's."""
    if hasattr(function, "py_func"):
        try:
            function(np.zeros(2))
        except Exception:  # a typing error, or a branch on an array
            import numba

            return numba.vectorize(function.py_func)
    return function
