"""Tables, written once and shown in notebooks, Markdown, CSV and LaTeX."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robsmooth import files

Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """A table with a caption. Text cells may hold mathematics between dollar signs.

    Attributes
    ----------
    columns : sequence of str
        Column headers.
    rows : sequence of sequences
        Cells: words, numbers, or None for an empty one.
    caption : str
        What the table shows.
    digits : int
        Significant digits of the numbers in print; CSV has twelve.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str
    digits: int = 4

    def markdown(self) -> str:
        """Return the table for Markdown."""
        rows = [self.columns, ["---"] * len(self.columns), *self._printed_rows()]
        lines = [" | ".join(cell.replace("|", r"\|") for cell in row) for row in rows]
        body = "\n".join(f"| {line} |" for line in lines)
        return f"{body}\n\n*{self.caption}*\n"

    def latex(self) -> str:
        """Return a LaTeX table, to be used with the booktabs package."""
        header, *rows = (
            " & ".join(_latex(cell) for cell in row) + r" \\"
            for row in [self.columns, *self._printed_rows()]
        )
        lines = (
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_latex(self.caption)}}}",
            rf"\begin{{tabular}}{{{'l' * len(self.columns)}}}",
            r"\toprule",
            header,
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        )
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Return the table as comma-separated values, numbers to twelve digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        full = replace(self, digits=12)  # the last few of sixteen differ from machine to machine
        writer.writerows(full._printed_rows())
        return text.getvalue()

    def save(self, directory: Path | str, name: str) -> None:
        """Write the table as `name`.md, .csv and .tex."""
        for suffix, text in (("md", self.markdown()), ("csv", self.csv()), ("tex", self.latex())):
            files.write_text(Path(directory) / f"{name}.{suffix}", text)

    def _repr_markdown_(self) -> str:
        return self.markdown()

    def __str__(self) -> str:
        return self.markdown()

    def _printed_rows(self) -> list[list[str]]:
        return [[self._text(cell) for cell in row] for row in self.rows]

    def _text(self, cell: Cell) -> str:
        if cell is None:
            return ""
        return f"{cell:.{self.digits}g}" if isinstance(cell, float) else str(cell)


_LATEX = {"±": r"$\pm$", "µ": r"$\mu$", "%": r"\%", "&": r"\&", "#": r"\#", "_": r"\_"}
_LATEX |= {"<": "$<$", ">": "$>$", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}


def _latex(text: str) -> str:
    """Escape what LaTeX would misread, outside of mathematics."""
    parts = text.split("$")
    for outside in range(0, len(parts), 2):
        parts[outside] = "".join(_LATEX.get(letter, letter) for letter in parts[outside])
    return "$".join(parts)
