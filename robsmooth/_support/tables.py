"""Tables, written once and shown in notebooks, HTML, Markdown and CSV."""

import csv
import html
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support import files
from robsmooth._support.extras import extra

if TYPE_CHECKING:
    from pandas import DataFrame as DataFrame

Cell = str | int | float | None

# A number, perhaps with an error, a unit or a per cent sign; or nothing.
_NUMBER = re.compile(r"([-+−]?(\d[\d.,]*(e[-+]?\d+)?|inf|nan)(\s?[%±µ].*)?)?")


@dataclass(frozen=True)
class Table:
    """A table with a caption. Text cells may hold mathematics between dollar signs."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str  # empty for none
    digits: int = 4  # significant ones, of numbers in print; CSV has twelve

    @classmethod
    def of_records(
        cls, records: Iterable[Mapping[str, Cell]], caption: str, digits: int = 4
    ) -> "Table":
        """Return the table of rows that map column headers to cells; cells may be absent."""
        records = list(records)
        fullest_first = sorted(records, key=len, reverse=True)  # it has the order of the columns
        columns = tuple(dict.fromkeys(column for record in fullest_first for column in record))
        rows = [tuple(record.get(column) for column in columns) for record in records]
        return cls(columns, rows, caption, digits)

    def markdown(self) -> str:
        """Return the table for Markdown."""
        rows = [self.columns, ["---"] * len(self.columns), *self._printed_rows()]
        lines = [" | ".join(cell.replace("|", r"\|") for cell in row) for row in rows]
        body = "\n".join(f"| {line} |" for line in lines)
        return f"{body}\n\n*{self.caption}*\n" if self.caption else f"{body}\n"

    __repr__ = markdown

    def html(self) -> str:
        """Return the table for HTML with MathJax, in a box that scrolls it where it is too wide."""
        columns = list(zip(*self._printed_rows(), strict=True)) or [()] * len(self.columns)
        numeric = [any(column) and all(map(_NUMBER.fullmatch, column)) for column in columns]
        styles = [f'style="text-align: {"right" if each else "left"}"' for each in numeric]
        names = map(_html, self.columns)
        header = "".join(map('<th scope="col" {}>{}</th>'.format, styles, names))
        rows = ("".join(map(self._html_cell, row, styles)) for row in self.rows)
        body = "\n".join(f"<tr>{row}</tr>" for row in rows)
        caption = f"<caption>{_html(self.caption)}</caption>\n" if self.caption else ""
        # The formulas that MathJax hides for screen readers do not make the box scroll.
        hidden = 'style="overflow: hidden"'
        return (
            f'<div style="overflow-x: auto">\n<table class="tex2jax_process" {hidden}>\n{caption}'
            f"<thead>\n<tr>{header}</tr>\n</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n</div>\n"
        )

    _repr_html_ = html

    def csv(self) -> str:
        """Return the table as comma-separated values, numbers to twelve digits."""
        text = io.StringIO()
        full = replace(self, digits=12)  # further digits differ between machines
        csv.writer(text, lineterminator="\n").writerows([self.columns, *full._printed_rows()])
        return text.getvalue()

    def save(self, directory: Path | str, name: str) -> None:
        """Write the table as `name`.md and .csv."""
        for suffix, text in (("md", self.markdown()), ("csv", self.csv())):
            files.write_text(Path(directory) / f"{name}.{suffix}", text)

    def _html_cell(self, cell: Cell, style: str) -> str:
        text = _html(self._text(cell))
        if isinstance(cell, float):
            text = re.sub("e(.+)", lambda found: f"×10<sup>{int(found[1])}</sup>", text)
        return f"<td {style}>{text}</td>"

    def _printed_rows(self) -> list[list[str]]:
        return [[self._text(cell) for cell in row] for row in self.rows]

    def _text(self, cell: Cell) -> str:
        if cell is None:
            return ""
        return f"{cell:.{self.digits}g}" if isinstance(cell, float) else str(cell)


def data_frame(axes: Mapping[str, Any], values: Mapping[str, ArrayLike]) -> "DataFrame":
    """Return a data frame of axes and arrays over them, with a row for each point of the grid."""
    with extra("frames", "a data frame"):
        import pandas
    index = pandas.MultiIndex.from_product(axes.values(), names=axes)
    shape = [len(axis) for axis in axes.values()]
    columns = {name: np.broadcast_to(each, shape).ravel() for name, each in values.items()}
    return pandas.DataFrame(columns, index).reset_index()


def _html(text: str) -> str:
    r"""Escape what HTML would misread, and put mathematics between \( and \)."""
    return re.sub(r"\$([^$]+)\$", r"\\(\1\\)", html.escape(text))
