"""Checks of what a user passes in: each returns the clean value or raises one clear sentence."""

import math
import numbers
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

INF = math.inf
Matrix = NDArray[np.float64]
T = TypeVar("T", bound=np.generic)


def array(name: str, value: ArrayLike, ndim: int) -> Matrix:
    """Return `value` as a read-only float array of `ndim` dimensions, finite and real."""
    parts = [value, *value] if isinstance(value, list | tuple) else [value]
    _check_plain(name, parts)
    if any(map(np.ma.is_masked, parts)):
        raise ValueError(f"{name} must have no masked entries; .filled(...) gives them a value")
    try:
        given = np.asarray(value)
    except ValueError:
        raise ValueError(f"{name} must be a rectangular array of numbers, got {value!r}") from None
    if given.dtype.kind == "c":
        raise ValueError(f"{name} must be real, got complex entries")
    if given.dtype.kind not in "iuf" and given.size:
        kind = f"got entries of type {given.dtype}; np.array(..., dtype=float) makes numbers"
        raise TypeError(f"{name} must be an array of numbers, {kind}")
    if given.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimension(s), got shape {given.shape}")
    with np.errstate(over="ignore"):  # a long double beyond the floats is not finite
        result = np.array(given, dtype=float)
    if not np.isfinite(result).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(result))[0])
        raise ValueError(f"{name} must be finite, got {result[where]} at index {where}")
    return frozen(result)


def matrix(name: str, value: ArrayLike, shape: Sequence[int | None]) -> Matrix:
    """Return `value` as a read-only matrix of the given shape; None leaves a size free."""
    result = array(name, value, ndim=2)
    for wanted, size in zip(shape, result.shape, strict=True):
        if wanted is not None and wanted != size:
            sizes = ", ".join("any" if size is None else str(size) for size in shape)
            raise ValueError(f"{name} must have shape ({sizes}), got {result.shape}")
    return result


def real(
    name: str, value: float, *, low: float = -INF, high: float = INF, without: Sequence[float] = ()
) -> float:
    """Return `value` as a finite float within an interval, `without` some of its ends."""
    _check_plain(name, [value])
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name} must be a real number, got {value!r}")
    try:
        result = float(value)
    except OverflowError:  # an integer beyond the floats
        result = INF if value > 0 else -INF
    without = (-INF, INF, *without)
    if not low <= result <= high or result in without:
        left, right = "(" if low in without else "[", ")" if high in without else "]"
        raise ValueError(
            f"{name} must be finite and in {left}{low:g}, {high:g}{right}, got {result!r}"
        )
    return result


def _check_plain(name: str, values: Iterable[object]) -> None:
    """Refuse quantities of pint, astropy and others, whose units NumPy would strip."""
    if any(hasattr(value, "units") or hasattr(value, "unit") for value in values):
        remedy = "give the value in SI units, of pint .to_base_units().magnitude"
        raise TypeError(f"{name} must be numbers without a unit, got a quantity; {remedy}")


def frozen(value: NDArray[T]) -> NDArray[T]:
    """Return the array read-only for good, as a view of a copy that is."""
    if value.flags.writeable:
        value = value.copy("K")
        value.flags.writeable = False
    return value.view()


class Frozen:
    """A dataclass whose arrays are read-only, those of its copies and pickles, too."""

    def __post_init__(self) -> None:
        self.__setstate__(vars(self))

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(_all_frozen(state))


def _all_frozen(value: Any) -> Any:
    """Return a value with the arrays in it read-only."""
    if isinstance(value, np.ndarray):
        return frozen(value)
    if type(value) is tuple:
        return tuple(map(_all_frozen, value))
    if type(value) is dict:
        return {name: _all_frozen(part) for name, part in value.items()}
    return value


def positive(name: str, value: float) -> float:
    """Return `value` as a finite float above zero."""
    return real(name, value, low=0.0, without=[0.0])


def integer(name: str, value: int, *, low: int) -> int:
    """Return `value` as an int that is at least `low`."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be an integer, got {value!r}")
    if value < low:
        raise ValueError(f"{name} must be an integer of at least {low}, got {value}")
    return int(value)


def boolean(name: str, value: bool) -> bool:
    """Return `value` as a bool, which it must be."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def instance(name: str, value: object, kind: type, hint: str = "") -> None:
    """Check that `value` is a `kind`; the hint says how to come by one."""
    if not isinstance(value, kind):
        kind, given = kind.__name__, type(value).__name__
        article = "an" if kind[0] in "AEIOU" else "a"
        raise TypeError(f"{name} must be {article} {kind}, got {given}{hint}")


def choice(name: str, value: str, allowed: Sequence[str]) -> str:
    """Return `value`, one of the words in `allowed`."""
    if value not in allowed:
        words = ", ".join(repr(word) for word in allowed)
        raise ValueError(f"{name} must be one of {words}, got {value!r}")
    return value
