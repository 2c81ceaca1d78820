r"""Numbers and matrices as short text and LaTeX, for what represents an object on a screen."""

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

LIMIT = 6  # rows, columns or entries that are shown; of more, dots replace the middle ones
_DIGITS = 4
_NO_ENTRY = 1e-16  # prints as 0: relative to the geometric mean of its row's and column's largest


def number(value: float) -> str:
    r"""Return a number as LaTeX, such as ``5.9\times10^{4}``."""
    if value == 0.0:
        return "0"  # without a sign
    if not math.isfinite(value):
        return {math.inf: r"\infty", -math.inf: r"-\infty"}.get(value, r"\mathrm{nan}")
    mantissa, _, exponent = f"{value:.{_DIGITS}g}".partition("e")
    if not exponent:
        return mantissa
    factor = {"1": "", "-1": "-"}.get(mantissa, rf"{mantissa}\times")
    return f"{factor}10^{{{int(exponent)}}}"


def matrix(value: ArrayLike) -> str:
    r"""Return a matrix as LaTeX, a single entry as a number."""
    value = np.asarray(value)
    if not value.size:
        return r"0_{{{}\times{}}}".format(*value.shape)
    sizes = np.abs(value)
    roots = np.sqrt(sizes.max(axis=1, keepdims=True)) * np.sqrt(sizes.max(axis=0))
    value = np.where(sizes < _NO_ENTRY * roots, 0.0, value)
    if value.shape == (1, 1):
        return number(value[0, 0])
    dots = " & ".join(_elided([r"\vdots"] * value.shape[1], r"\ddots"))
    lines = [
        dots if row is None else " & ".join(_elided(map(number, row), r"\cdots"))
        for row in _elided(value, None)
    ]
    return r"\begin{bmatrix}" + r" \\ ".join(lines) + r"\end{bmatrix}"


def product(factor: ArrayLike, symbol: str) -> str:
    r"""Return a matrix times a symbol as LaTeX: empty for zero, the symbol alone for one."""
    factor = np.asarray(factor)
    if not factor.any():
        return ""
    if factor.shape == (1, 1) and abs(factor[0, 0]) == 1.0:
        return f"-{symbol}" if factor[0, 0] < 0.0 else symbol
    return rf"{matrix(factor)}\,{symbol}"


def total(terms: Iterable[str]) -> str:
    """Return the sum of terms as LaTeX; an empty term is zero."""
    return " + ".join(filter(None, terms)).replace("+ -", "- ") or "0"


def array(value: ArrayLike) -> str:
    """Return an array as text: its entries, or the shape of a large matrix."""
    value = np.asarray(value)
    if value.ndim == 0:
        return f"{value:.5g}"
    if value.ndim > 1 and value.size > LIMIT:
        return f"<{' x '.join(map(str, value.shape))}>"
    return f"[{', '.join(_elided(map(array, value), '...'))}]"


def _elided(entries: Iterable, dots: str | None) -> list:
    entries = list(entries)
    return entries if len(entries) <= LIMIT else [*entries[: LIMIT - 2], dots, entries[-1]]
