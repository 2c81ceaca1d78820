"""Checks of arguments: each returns the clean value or raises one clear sentence."""

import math
import numbers
import os
import reprlib
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Never, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

INF = math.inf
_NO_NUMBERS = bool, np.bool_, np.timedelta64  # though Python or NumPy calls them integers
Matrix = NDArray[np.float64]
T = TypeVar("T", bound=np.generic)
_NUMBERS = "{} must be an array of numbers, got entries of type {}"
_NUMBERS += ": np.array(..., dtype=float) makes numbers of them"
_RECTANGULAR = "{} must be a rectangular array of numbers, got {}"
_DEEPEST = 32  # lists in lists: no array of NumPy 1 has more dimensions
_MOST_NUMBERS = 10**10  # of an array
_COUNTED = 2**53  # floats, and compiled code, tell integers apart up to here
_MOST_VALUES = 1_000_000  # of a sequence of arguments: more are an error, or have no end
_SHORT = reprlib.Repr()
_SHORT.maxother = _SHORT.maxstring = _SHORT.maxlong = 80


def shown(value: object) -> str:
    """Return a value as an error says it: on one line and short, whatever it is."""
    try:
        return line(_SHORT.repr(value))
    except Exception:  # of the value's own, and of an integer with thousands of digits
        return f"a value of type {type(value).__name__}"


def line(text: object, most: int = 240) -> str:
    """Return a text on one line of at most so many characters."""
    text = " ".join(str(text).split())
    return text if len(text) <= most else f"{text[:most]}..."


def differences(form: str, one: dict[str, str], other: dict[str, str]) -> list[str]:
    """Return a text of the name, and of both ends of long texts, where two dicts differ."""
    pairs = [(name, *(each.get(name, "absent") for each in (one, other))) for name in one | other]
    return [form.format(name, _ends(a), _ends(b)) for name, a, b in sorted(pairs) if a != b]


def _ends(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:16]}...{text[-8:]}"


def is_single(value: object) -> bool:
    """Return whether a value is no array and no list, though perhaps no number either."""
    return not isinstance(value, list | tuple) and np.ndim(value) == 0  # type: ignore[arg-type]


def numbers_of(name: str, value: ArrayLike) -> NDArray[Any]:
    """Return `value` as an array of real numbers of any type, with NaN where masked."""
    parts = _parts(name, value)
    for each in parts:
        if isinstance(each, _NO_NUMBERS):
            raise TypeError(_NUMBERS.format(name, type(each).__name__))
        if hasattr(each, "magnitude") or hasattr(each, "to_value"):  # of pint, astropy or unyt
            got = f"a {type(each).__name__}: its .to(...).magnitude or .to_value(...) has them"
            raise TypeError(f"{name} must be numbers without a unit, got {got}")
    try:
        result = np.asarray(value)
    except (ValueError, TypeError, OverflowError):
        raise ValueError(_RECTANGULAR.format(name, shown(value))) from None
    if result.size > _MOST_NUMBERS:  # of one number that is broadcast
        raise ValueError(f"{name} must fit into memory, got shape {result.shape}")
    if result.dtype.kind == "c":
        raise ValueError(f"{name} must be real, got complex entries: its .real is")
    if result.dtype.kind not in "iuf" and result.size:
        raise TypeError(_NUMBERS.format(name, result.dtype))
    if not any(map(np.ma.is_masked, parts)):
        return result
    return np.where(np.ma.getmaskarray(np.ma.array(value)), np.nan, result)


def _parts(name: str, value: ArrayLike, around: tuple[Any, ...] = ()) -> list[Any]:
    """Return a value and the entries of lists in it, which may have their own masks or units."""
    if not isinstance(value, list | tuple):
        return [value]
    if len(around) == _DEEPEST or any(value is each for each in around):
        raise ValueError(_RECTANGULAR.format(name, shown(value)))
    return [value, *(part for each in value for part in _parts(name, each, (*around, value)))]


def array(name: str, value: ArrayLike, ndim: int) -> Matrix:
    """Return `value` as a read-only float array of `ndim` dimensions, finite and real."""
    if any(map(np.ma.is_masked, _parts(name, value))):
        raise ValueError(f"{name} must have no masked entries; .filled(...) gives them a value")
    given = numbers_of(name, value)
    if given.ndim != ndim:
        hint = ": [[...]] makes one row" if (ndim, given.ndim) == (2, 1) else ""
        raise ValueError(f"{name} must have {ndim} dimension(s), got shape {given.shape}{hint}")
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
        raise TypeError(f"{name} must be a real number, got {shown(value)}")
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
    value = np.asarray(value)  # of a subclass: a view of a masked array can be made writeable
    owner = value.base if isinstance(value.base, np.ndarray) else value
    if value.flags.writeable or owner.flags.writeable:
        value = value.copy("K")
        value.flags.writeable = False
    return value.view()


class FrozenDict(dict):
    """A dict that cannot be changed; unlike a `MappingProxyType` it can be pickled, and is JSON."""

    def _refuse(self, *_: Any, **__: Any) -> Never:
        raise TypeError("a dict of a result is read-only: dict(...) makes a copy to change")

    __setitem__ = __delitem__ = __ior__ = _refuse  # type: ignore[assignment]
    update = setdefault = pop = popitem = clear = _refuse  # type: ignore[assignment]

    def __reduce__(self) -> tuple[type, tuple[dict]]:
        return type(self), (dict(self),)


class Frozen:
    """A dataclass with read-only arrays and dicts, also in its copies and pickles."""

    def __post_init__(self) -> None:
        self.__setstate__(vars(self))

    def __setstate__(self, state: dict[str, object]) -> None:
        try:
            vars(self).update({name: _all_frozen(part) for name, part in state.items()})
        except RecursionError:
            what = f"a {type(self).__name__} must hold no list that is nested without end"
            raise ValueError(what) from None


def _all_frozen(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return frozen(value)
    if isinstance(value, tuple | list):
        parts = map(_all_frozen, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, dict):
        return FrozenDict({name: _all_frozen(part) for name, part in value.items()})
    return value


def positive(name: str, value: float) -> float:
    """Return `value` as a finite float above zero."""
    return real(name, value, low=0.0, without=[0.0])


def integer(name: str, value: int, *, low: int, high: int = _COUNTED, why: str = "") -> int:
    """Return `value` as an int within an interval, whose upper end may have a reason."""
    if isinstance(value, _NO_NUMBERS) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be an integer, got {shown(value)}")
    if value < low:
        raise ValueError(f"{name} must be an integer of at least {low}, got {shown(value)}")
    if value > high:
        raise ValueError(f"{name} must be at most {high}{why}, got {shown(value)}")
    return int(value)


def boolean(name: str, value: bool) -> bool:
    """Return `value` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def instance(name: str, value: object, kind: type, hint: str = "") -> None:
    """Check that `value` is a `kind`; the hint says how to make one."""
    if not isinstance(value, kind):
        kind, given = kind.__name__, type(value).__name__
        article = "an" if kind[0] in "AEIOU" else "a"
        raise TypeError(f"{name} must be {article} {kind}, got {given}{hint}")


def choice(name: str, value: str, allowed: Sequence[str]) -> str:
    """Return `value`, one of the words in `allowed`."""
    try:
        return {word: word for word in allowed}[value]
    except (KeyError, TypeError):  # the latter for an array, or what else has no hash
        words = ", ".join(map(repr, allowed))
        raise ValueError(f"{name} must be one of {words}, got {shown(value)}") from None


def sequence(name: str, value: Any, of: str = "values", count: int | None = None) -> list[Any]:
    """Return the entries of a list, an array or another iterable that has an order and an end."""
    try:
        if isinstance(value, str | bytes | bytearray | memoryview | Set | Mapping):
            raise TypeError
        found = list(islice(value, _MOST_VALUES + 1))
    except TypeError:  # also of what has no entries
        raise TypeError(f"{name} must be a sequence of {of}, got {shown(value)}") from None
    if len(found) > _MOST_VALUES or count not in (None, len(found)):
        allowed = f"at most {_MOST_VALUES}" if count is None else count
        raise ValueError(f"{name} must have {allowed} entries, got {len(found)}")
    return found


def path(name: str, value: str | os.PathLike[str]) -> Path:
    """Return `value` as a path, with the user's folder for ``~``."""
    with suppress(TypeError, UnicodeError):  # the latter of a name that no file can have
        found = Path(os.path.expanduser(value))
        if os.fspath(value) and b"\0" not in os.fsencode(found):
            return found
    raise TypeError(f"{name} must be the path of a file, got {shown(value)}")
