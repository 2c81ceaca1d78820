"""Numbers as the text of a cell, where several tables have them."""

import math
from collections.abc import Iterable

from robsmooth.homodyne.montecarlo import MeanSquare


def number(value: float, form: str = ".4f") -> str:
    """Return a number in a format; "none" where it is not a number."""
    return "none" if math.isnan(value) else f"{value:{form}}"


def estimate(error: MeanSquare, form: str = ".5f", error_form: str | None = None) -> str:
    """Return a mean square error ± its standard error; "none" where there is none."""
    if math.isnan(error.mean_square):
        return "none"
    return f"{error.mean_square:{form}} ± {error.standard_error:{error_form or form}}"


def numbers(values: Iterable[complex], digits: int = 4) -> str:
    """Return numbers in a row."""
    return ", ".join(f"{value:.{digits}g}" for value in values).replace("+0j", "")


def poles(values: Iterable[complex], digits: int) -> str:
    """Return poles in a row, one of each conjugate pair."""
    return numbers((pole for pole in values if pole.imag >= 0.0), digits)
