"""Checks of arguments: each returns the clean value or raises one clear sentence."""

import math
import numbers
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

INF = math.inf
_NO_NUMBERS = bool, np.bool_, np.timedelta64  # though Python or NumPy calls them integers
Matrix = NDArray[np.float64]
T = TypeVar("T", bound=np.generic)
_NUMBERS = "{} must be an array of numbers, got entries of type {}"
_NUMBERS += ": np.array(..., dtype=float) makes numbers of them"


def numbers_of(name: str, value: ArrayLike) -> NDArray[Any]:
    """Return `value` as an array of real numbers of any type, with NaN where masked."""
    parts = _parts(value)
    for each in parts:
        if isinstance(each, _NO_NUMBERS):
            raise TypeError(_NUMBERS.format(name, type(each).__name__))
        if hasattr(each, "magnitude") or hasattr(each, "to_value"):  # of pint, astropy or unyt
            got = f"a {type(each).__name__}: its .to(...).magnitude or .to_value(...) has them"
            raise TypeError(f"{name} must be numbers without a unit, got {got}")
    try:
        result = np.asarray(value)
    except ValueError:
        rule = f"{name} must be a rectangular array of numbers"
        raise ValueError(f"{rule}, got {repr(value)[:60]}") from None
    if result.dtype.kind == "c":
        raise ValueError(f"{name} must be real, got complex entries: its .real is")
    if result.dtype.kind not in "iuf" and result.size:
        raise TypeError(_NUMBERS.format(name, result.dtype))
    if not any(map(np.ma.is_masked, parts)):
        return result
    return np.where(np.ma.getmaskarray(np.ma.array(value)), np.nan, result)


def _parts(value: ArrayLike) -> list[Any]:
    """Return a value and the entries of lists in it, which may have their own masks or units."""
    nested = value if isinstance(value, list | tuple) else ()
    return [value, *(part for each in nested for part in _parts(each))]


def array(name: str, value: ArrayLike, ndim: int) -> Matrix:
    """Return `value` as a read-only float array of `ndim` dimensions, finite and real."""
    if any(map(np.ma.is_masked, _parts(value))):
        raise ValueError(f"{name} must have no masked entries; .filled(...) gives them a value")
    given = numbers_of(name, value)
    if given.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimension(s), got shape {given.shape}")
    with np.errstate(over="ignore"):  # a long double beyond the floats is not finite
        result = np.array(given, dtype=float)
    if not np.isfinite(result).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(result))[0])
        raise ValueError(f"{name} must be finite, got {result[where]} at index {where}")
    return frozen(result)


def matrix(name: str, value: ArrayLike, shape: Sequence[int | None]) -> Matrix:
    """Return `value` as a read-only array of the given shape; None leaves a size free."""
    result = array(name, value, ndim=len(shape))
    for wanted, size in zip(shape, result.shape, strict=True):
        if wanted is not None and wanted != size:
            sizes = ", ".join("any" if size is None else str(size) for size in shape)
            raise ValueError(f"{name} must have shape ({sizes}), got {result.shape}")
    return result


def real(
    name: str, value: float, *, low: float = -INF, high: float = INF, without: Sequence[float] = ()
) -> float:
    """Return `value` as a finite float within an interval, `without` some of its ends."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, _NO_NUMBERS) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name} must be a real number, got {value!r}")
    try:
        result = float(value)
    except OverflowError:  # an integer beyond the floats
        result = INF if value > 0 else -INF
    without = (-INF, INF, *without)
    if not low <= result <= high or result in without:
        left, right = "(" if low in without else "[", ")" if high in without else "]"
        allowed = f"finite and in {left}{low:g}, {high:g}{right}"
        raise ValueError(f"{name} must be {allowed}, got {result!r}")
    return result


def frozen(value: NDArray[T]) -> NDArray[T]:
    """Return the array as a view of a read-only copy, which cannot be made writeable."""
    owner = value.base if isinstance(value.base, np.ndarray) else value
    if value.flags.writeable or owner.flags.writeable:
        value = value.copy("K")
        value.flags.writeable = False
    return value.view()


class Frozen:
    """A dataclass with read-only arrays, also in its copies and pickles."""

    def __post_init__(self) -> None:
        self.__setstate__(vars(self))

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(_all_frozen(state))


def _all_frozen(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return frozen(value)
    if isinstance(value, tuple):
        parts = map(_all_frozen, value)
        return tuple(parts) if type(value) is tuple else type(value)(*parts)
    if type(value) is dict:
        return {name: _all_frozen(part) for name, part in value.items()}
    return value


def positive(name: str, value: float) -> float:
    """Return `value` as a finite float above zero."""
    return real(name, value, low=0.0, without=[0.0])


def integer(name: str, value: int, *, low: int) -> int:
    """Return `value` as an int that is at least `low`."""
    if isinstance(value, _NO_NUMBERS) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be an integer, got {value!r}")
    if value < low:
        raise ValueError(f"{name} must be an integer of at least {low}, got {value}")
    return int(value)


def boolean(name: str, value: bool) -> bool:
    """Return `value` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def instance(name: str, value: object, kind: type, hint: str = "") -> None:
    """Check that `value` is a `kind`; the hint says how to make one."""
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
