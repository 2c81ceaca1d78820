"""Packages that only a part of robsmooth needs, and what to say where one is missing."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class MissingExtraError(ImportError):
    """A part of robsmooth was asked for whose packages are not installed."""


@contextmanager
def extra(name: str, part: str) -> Iterator[None]:
    """Say which extra `part` needs, where an import in the block finds no package."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "robsmooth"):
            raise
        raise MissingExtraError(
            f"{part} needs the package {package}: pip install 'robsmooth[{name}]'",
            name=error.name,
        ) from None


def pyarrow() -> Any:
    """Return PyArrow, which the extra ``records`` brings."""
    with extra("records", "a data frame, CSV or Parquet"):
        import pyarrow.csv
        import pyarrow.parquet
    return pyarrow
