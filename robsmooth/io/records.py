"""Measured records in files: read, smoothed and written in chunks.

A record is a CSV file, or an NPY file with an array of numbers. It has a row for each sample and a
column for each measurement, the mean of dy/dt over the sample's interval.
"""

import csv
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from robsmooth._support import validation
from robsmooth._support.files import atomic_path
from robsmooth._support.progress import progress_bar
from robsmooth._support.validation import Matrix
from robsmooth.estimators.discrete import OUTPUTS, DiscreteSmoother

CHUNK = 65_536  # rows
TIMING = 0.5  # of a sample: by how much a row may come too early or too late
DRIFT = 1e-3  # by how much the record's clock may differ from dt's

Column = int | str
Columns = Column | Sequence[Column] | None
Write = Callable[[Matrix, Matrix], None]


def smooth_record(
    smoother: DiscreteSmoother,
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    columns: Columns = None,
    reference: Columns = None,
    time: Column | None = None,
    output: str = "smoothed",
    delimiter: str = ",",
    chunk: int = CHUNK,
    progress: bool = False,
) -> int:
    """Smooth a record from file to file, gigabytes in the memory of a chunk.

    The smoother goes on from its state, as in `DiscreteSmoother.run`. Where this fails or is
    interrupted, its state and the target are what they were before.

    Parameters
    ----------
    smoother : DiscreteSmoother, made by ``estimator.discretize(dt)``
    source : path
        A ``.csv`` file, of which a first line without any number is a header, or a ``.npy`` file
        with an array (N, columns) or (N,). Where it has nan or an empty cell, a measurement is
        missing.
    target : path
        For the estimates: a ``.csv`` file with the columns ``time``, s, as in
        `DiscreteSmoother.times`, ``w[0]``, ``w[1]``..., or a ``.npy`` file of an (N, m) array.
    columns, reference : int, str or sequence of them, optional
        The l columns that are measurements, by default all others, and the g ones of the reference
        of the nonlinearities, as in `DiscreteSmoother.run`: indices, or names of a header.
    time : int or str, optional
        A column with times, s: a row that is missing, or a wrong dt, is refused.
    output : {"smoothed", "filtered"}, which estimates to write
    delimiter : str, one character, of CSV files
    chunk : int, rows in memory at a time
    progress : bool, whether to show a progress bar

    Returns
    -------
    int
        The number of rows.

    Raises
    ------
    ValueError, TypeError
        For what cannot be read, or is no number; the message names the file, row and column.
    ArithmeticError
        Where the smoother's state leaves the range of floats.
    OSError
        Where a file cannot be opened or written.

    See Also
    --------
    DiscreteSmoother.run : does it with an array.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import robsmooth as rs
    >>> smoother = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system()).discretize(1e-7)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(folder + "/y.npy", np.zeros((100, 1)))
    ...     rs.smooth_record(smoother, folder + "/y.npy", folder + "/w.csv")
    100
    """
    validation.instance("smoother", smoother, DiscreteSmoother)
    output = validation.choice("output", output, OUTPUTS)
    validation.boolean("progress", progress)
    chunk = validation.integer("chunk", chunk, low=1)
    if not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter in '"\r\n':
        raise ValueError(f"delimiter must be one character, not a quote, got {delimiter!r}")
    source, target = Path(source), Path(target)
    if target.resolve() == source.resolve():
        raise ValueError(f"target must be another file than source, got {target} for both")
    for name, path in (("source", source), ("target", target)):
        if path.suffix.lower() not in _FORMATS:
            raise ValueError(f"{name} must end in {' or '.join(_FORMATS)}, got {path.name!r}")
    record = _FORMATS[source.suffix.lower()][0](source, delimiter)
    writer = _FORMATS[target.suffix.lower()][1]
    record.choose(smoother, columns, reference, time)
    before = smoother._checkpoint()
    bar = progress_bar(total=record.size, unit=record.unit, unit_scale=True, shown=progress)
    try:
        with bar, atomic_path(target) as path, writer(path, smoother.m, delimiter) as write:
            rows = 0
            for values, size in record.chunks(record.chosen, chunk):
                y, known = record.parts(values, rows)
                estimates = smoother.run(y, reference=known, output=output)
                write(smoother.times(len(estimates), output), estimates)
                rows += len(values)
                bar.update(size)
    except BaseException:
        smoother._restore(before)
        raise
    return rows


class _Record:
    """A file with a row for each sample."""

    path: Path
    width: int  # number of columns
    size: int  # in units
    unit: str
    first: tuple[str, int]  # what a row is called, and the number of the first one
    header: Sequence[str] = ()

    def choose(self, smoother: DiscreteSmoother, *given: Columns) -> None:
        """Choose the columns that are used: measurements, reference and time, in this order."""
        columns, reference, time = given
        known = self._columns("reference", reference, smoother.g, "nonlinearities")
        times = self._columns("time", time, 1, "time")
        if columns is None:
            columns = [i for i in range(self.width) if i not in (*known, *times)]
        measurements = self._columns("columns", columns, smoother.l, "measurements")
        self.chosen, self.dt = [*measurements, *known, *times], smoother.dt
        self.ends = np.cumsum([len(measurements), len(known)])

    def _columns(self, name: str, chosen: Columns, wanted: int, what: str) -> list[int]:
        """Return the positions of the columns that the argument of this name chooses."""
        if chosen is None:
            return []
        single = isinstance(chosen, int | np.integer | str)
        found = [self._index(name, column) for column in ([chosen] if single else chosen)]
        if len(found) != wanted:
            raise ValueError(
                f"{name} must name {wanted} of the columns of {self.path}, one for each of the "
                f"{what}, got {len(found)} ({', '.join(map(self.name, found))})"
            )
        return found

    def _index(self, name: str, column: Column) -> int:
        if isinstance(column, str):
            if self.header.count(column) != 1:
                found = "twice" if column in self.header else "not"
                names = ", ".join(map(repr, self.header)) or "no header"
                raise ValueError(f"{name}: {column!r} is {found} in {self.path}, which has {names}")
            return self.header.index(column)
        index = validation.integer(name, column, low=0)
        if index >= self.width:
            raise ValueError(f"{name}: {self.path} has {self.width} columns, there is no {index}")
        return index

    def name(self, column: int) -> str:
        return f"column {column}" + (f" ({self.header[column]!r})" if self.header else "")

    def place(self, row: int, column: int) -> str:
        called, first = self.first
        return f"{self.path}, {called} {first + row}, {self.name(column)}"

    def parts(self, values: Matrix, row: int) -> tuple[Matrix, Matrix | None]:
        """Return measurements and reference of a chunk that begins at a row, after its check."""
        y, known, times = np.split(values, self.ends, axis=1)
        wrong = ~np.isfinite(values)
        wrong[:, : y.shape[1]] &= ~np.isnan(y)
        if wrong.any():
            i, j = np.argwhere(wrong)[0]
            place = self.place(row + i, self.chosen[j])
            raise ValueError(f"{place}: {values[i, j]} where there must be a finite number")
        if times.size:
            self._check_times(times[:, 0], row)
        return y, known if known.shape[1] else None

    def _check_times(self, times: Matrix, row: int) -> None:
        if row == 0:
            self.first_time, self.last_time = times[0], times[0] - self.dt
        late = np.diff(times, prepend=self.last_time) / self.dt - 1.0
        count = row + np.arange(len(times))
        drift = (times - self.first_time) / self.dt - count
        wrong = (np.abs(late) >= TIMING) | (np.abs(drift) >= TIMING + DRIFT * count)
        if wrong.any():
            i = int(wrong.argmax())
            raise ValueError(
                f"{self.place(row + i, self.chosen[-1])}: the time {times[i]:.9g} s is "
                f"{1 + late[i]:.6g} samples after that of the row before and {drift[i]:+.6g} "
                f"samples off the times of the record's begin with dt = {self.dt:g} s"
            )
        self.last_time = times[-1]


class _Npy(_Record):
    """An NPY file. It is mapped anew for each chunk: what was read need not stay in memory."""

    unit, first = "row", ("row", 0)

    def __init__(self, path: Path, _delimiter: str):
        self.path = path
        array = self._open()
        if array.dtype.kind not in "iuf":
            raise TypeError(f"{path} must hold real numbers, got entries of {array.dtype}")
        if array.ndim not in (1, 2):
            raise ValueError(f"{path} must hold an array (N, columns), got shape {array.shape}")
        self.size = len(array)
        self.width = 1 if array.ndim == 1 else array.shape[1]

    def _open(self) -> NDArray:
        try:
            return npy.open_memmap(self.path, mode="r")
        except (ValueError, SyntaxError, TokenError) as error:  # the last two for a header
            raise ValueError(
                f"{self.path} must be an NPY file of plain numbers, without Python objects, which "
                f"are never unpickled: {error}"
            ) from None

    def chunks(self, columns: list[int], rows: int) -> Iterator[tuple[Matrix, int]]:
        """Yield the chosen columns of the next rows, and their number."""
        for start in range(0, self.size, rows):
            part = self._open()[start : start + rows].reshape(-1, self.width)
            values = np.array(part[:, columns], dtype=float)
            del part
            yield values, len(values)


class _Csv(_Record):
    """A CSV file."""

    unit = "B"

    def __init__(self, path: Path, delimiter: str):
        self.path, self.delimiter = path, delimiter
        self.size = path.stat().st_size
        with self._open() as file:
            cells = self._cells(file.readline(), 1)
        if not cells:
            raise ValueError(f"{path} must begin with a header or a row of numbers, got a blank")
        self.width = len(cells)
        is_header = any(cells) and all(_number(cell) is None for cell in cells if cell)
        self.header = [cell.strip() for cell in cells] if is_header else []
        self.first = "line", 1 + is_header

    def _open(self):
        return open(self.path, encoding="utf-8-sig", errors="replace", newline="")

    def chunks(self, columns: list[int], rows: int) -> Iterator[tuple[Matrix, int]]:
        """Yield the chosen columns of the next lines, and the size of these in bytes."""
        begin = self.first[1]
        with self._open() as file:
            lines = islice(self._lines(file), begin - 1, None)
            while part := list(islice(lines, rows)):
                yield self._parsed(part, begin, columns), sum(map(len, part))
                begin += len(part)

    def _lines(self, file: Iterable[str]) -> Iterator[str]:
        """Yield the lines of a file, of which only the last may be blank."""
        blank = 0
        for number, line in enumerate(file, 1):
            if not line.strip("\r\n ".replace(self.delimiter, "")):
                blank = blank or number
            elif blank:
                message = "blank; a row of gaps has its nan or commas"
                raise ValueError(f"{self.path}, line {blank}: {message}")
            else:
                yield line

    def _parsed(self, lines: list[str], number: int, columns: list[int]) -> Matrix:
        """Return the numbers of some lines, the first of which has this number."""
        with suppress(ValueError):  # NumPy's parser is faster by far, but knows no empty cells
            if all(line.count(self.delimiter) == self.width - 1 for line in lines):
                layout = {"delimiter": self.delimiter, "usecols": columns}
                return np.loadtxt(lines, comments=None, ndmin=2, **layout)
        values = np.empty((len(lines), len(columns)))
        for i, line in enumerate(lines):
            cells = self._cells(line, number + i)
            place = f"{self.path}, line {number + i}"
            if len(cells) != self.width:
                wanted = f"where the first line has {self.width}"
                raise ValueError(f"{place}: {len(cells)} cells, {wanted}")
            for j, column in enumerate(columns):
                cell = cells[column].strip()
                value = _number(cell or "nan")
                if value is None:
                    raise ValueError(f"{place}, {self.name(column)}: {cell!r} is not a number")
                values[i, j] = value
        return values

    def _cells(self, line: str, number: int) -> list[str]:
        try:
            return next(csv.reader([line], delimiter=self.delimiter), [])
        except csv.Error as error:
            raise ValueError(f"{self.path}, line {number}: {error}") from None


def _number(cell: str) -> float | None:
    with suppress(ValueError):
        return None if "_" in cell else float(cell)  # 1_000 is a number in Python only
    return None


@contextmanager
def _npy_writer(path: Path, outputs: int, _delimiter: str) -> Iterator[Write]:
    """Give what appends rows to an NPY file."""
    layout = {"descr": "<f8", "fortran_order": False, "shape": (0, outputs)}
    with open(path, "wb") as file:

        def write(_times: Matrix, estimates: Matrix) -> None:
            file.write(estimates.astype("<f8").tobytes())
            layout["shape"] = (layout["shape"][0] + len(estimates), outputs)

        npy.write_array_header_1_0(file, layout)
        yield write
        file.seek(0)
        npy.write_array_header_1_0(file, layout)  # it has room for any number of rows


@contextmanager
def _csv_writer(path: Path, outputs: int, delimiter: str) -> Iterator[Write]:
    """Give what appends rows, with their times, to a CSV file."""
    with open(path, "w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, delimiter=delimiter, lineterminator="\n")
        rows.writerow(["time", *(f"w[{i}]" for i in range(outputs))])

        def write(times: Matrix, estimates: Matrix) -> None:
            rows.writerows(
                [f"{t:.15g}", *w] for t, w in zip(times, estimates.tolist(), strict=True)
            )

        yield write


_FORMATS = {".csv": (_Csv, _csv_writer), ".npy": (_Npy, _npy_writer)}
