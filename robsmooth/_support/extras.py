"""Packages that only a part of robsmooth needs, and the error where one is missing."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class MissingExtraError(ImportError):
    """A package that a part of robsmooth needs is not installed."""


@contextmanager
def extra(name: str, part: str) -> Iterator[None]:
    """Raise an error that names the extra for `part`, where an import in the block fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "robsmooth"):
            raise
        message = f"{part} needs the package {package}: pip install 'robsmooth[{name}]'"
        raise MissingExtraError(message, name=error.name) from None


def pyarrow() -> Any:
    """Return PyArrow, of the extra ``records``."""
    with extra("records", "a data frame, CSV or Parquet"):
        import pyarrow.csv
        import pyarrow.parquet
    return pyarrow
