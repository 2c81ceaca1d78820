"""Records with a row for each sample: tables by PyArrow, arrays by NumPy, in files or in memory."""

import csv
import gzip
import io
import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy

from robsmooth._support import validation
from robsmooth._support.extras import pyarrow
from robsmooth._support.progress import progress_bar
from robsmooth._support.validation import Matrix, line

BLOCK = 1 << 18  # bytes of a CSV file at a time; its lines are shorter
DATE = re.compile(r"\d{4}-\d\d-\d\d(?:[T ][\d:.]*(Z|[-+]\d\d:?\d\d)?)?")
NUMBER = r"(?i)[-+.−]?\d|[-+]?(inf(inity)?|nan(\(.*\))?)$"  # −: the sign of typographers
MISSING = ("", "NA", "N/A", "#N/A", "null", "nan", ".")
# gaps of other programs
NO_NAMES = ("None", "<NA>", "NaT", "-", "--", "?", "OL", "OVL", "#NUM!", "#DIV/0!", "#VALUE!")


def delimiter_of(name: str, path: Path, given: str | None) -> str:
    """Return the delimiter of a file by its suffix, empty where it has none."""
    found = re.search(r"(\.csv|\.tsv)(\.gz)?$|\.npy$|\.parquet$", path.name.lower())
    unwritten = found and name == "target" and found[0] == ".parquet"
    if not found or unwritten or (path.exists() and not path.is_file()):
        allowed = "that ends in .csv, .tsv, .csv.gz, .tsv.gz, .npy or, to be read, .parquet"
        raise ValueError(f"{name} must be a file, no pipe or device, {allowed}, got {line(path)}")
    if name == "source" and not path.exists():
        raise FileNotFoundError(f"source must be a file that exists, got {line(path)}")
    right = isinstance(given, str) and re.fullmatch(r"(?![\w\"'.+-])[\t -~]", given)
    if given is not None and not right:
        allowed = "one character of ASCII, not a quote and in no number"
        raise ValueError(f"delimiter must be {allowed}, got {validation.shown(given)}")
    return {".csv": given or ",", ".tsv": given or "\t"}.get(found[1], "")


class Record:
    """Rows of samples, in columns."""

    path: Path | str = "source"  # its name in messages
    names: Sequence[str] = ()
    width, size = 0, None  # numbers of columns, and of rows or, of a CSV file, bytes
    unit, read = "row", 0  # of the size; how much of it was read
    shown = False  # whether a bar shows that
    first, advice = 0, ""  # the number of the first row; the end of messages
    index: int | None = None  # the column that is the index of a data frame
    dates: Mapping[int, Any] = {}  # the types of columns of dates and of lengths of time
    origin: Any = None  # the first date, from which seconds count, ns
    pieces: Any  # a method: yields arrays with all columns, or tables with the chosen ones

    def name(self, column: int) -> str:
        """Return the name of a column in messages."""
        return f"column {column}" + (f" ({self.names[column]!r})" if self.names else "")

    def rows(self, columns: list[int], chunk: int) -> Iterator[Matrix]:
        """Yield columns of the next rows as numbers; dates are in s since the first."""
        bar = progress_bar(total=self.size, unit=self.unit, unit_scale=True, shown=self.shown)
        with self._failures(), bar:
            for piece in self.pieces(columns, chunk):
                for i in range(0, len(piece), chunk):
                    part = piece[i : i + chunk]
                    if isinstance(part, np.ndarray):
                        yield part[:, columns].astype(float)
                    else:
                        cells = zip(part.itercolumns(), columns, strict=True)
                        yield np.column_stack([self._numbers(*cell) for cell in cells])
                bar.update(self.read - bar.n)

    def _numbers(self, cells: Any, column: int) -> Matrix:
        if re.match("bool|extension", str(cells.type)):
            what = f"{self.path}, {self.name(column)}, must hold real numbers or dates"
            raise TypeError(f"{what}, got {cells.type}")
        if column not in self.dates:
            return cells.cast("double", safe=False).to_numpy(zero_copy_only=False)
        ticks = cells.cast(self.dates[column]).cast("int64").to_numpy(zero_copy_only=False)
        if self.origin is None:
            self.origin = 0 if str(self.dates[column]).startswith("duration") else ticks[0]
        return (ticks - self.origin) / 1e9

    def table(self, clock: int | None, times: Any, w: Matrix, names: list[str], file: bool) -> Any:
        """Return estimates with times as the clock has them; lengths of time are s in a file."""
        kind = str(self.dates.get(clock))
        if kind != "None" and not (file and kind.startswith("duration")):
            ticks = (self.origin or 0) + np.round(1e9 * times).astype(np.int64)
            times = pyarrow().array(ticks).cast(self.dates[clock])
        return pyarrow().table([times, *w.T], names=names)

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Turn an error of a library into one that names the file and the line."""
        wrong = EOFError, zlib.error, csv.Error, OverflowError, UnicodeDecodeError
        try:
            yield
        except Exception as error:
            own = isinstance(error, OSError) and error.errno is None  # of gzip and of PyArrow
            if not (own or isinstance(error, wrong) or type(error).__module__ == "pyarrow.lib"):
                raise
            what = re.sub(r"Row #(\d+)", lambda n: f"line {self.first + int(n[1]) - 1}", str(error))
            what = line(what, 200)
            raise ValueError(f"{self.path}: {what}{self.advice}") from None


class Array(Record):
    """An array (N, columns) or (N,), in memory or in an NPY file."""

    def __init__(self, source: Any) -> None:
        self._map = lambda: source
        if isinstance(source, Path):
            self.path, self._map = source, lambda: npy.open_memmap(source, mode="r")
        try:
            array = self._map()
        except (ValueError, TypeError, OverflowError, SyntaxError, TokenError) as error:
            plain = "plain numbers, without Python objects, which are never unpickled"
            what = f"{plain}: {line(error)}"
            raise ValueError(f"{self.path} must be an NPY file of {what}") from None
        array = validation.numbers_of(str(self.path), array)
        if array.ndim not in (1, 2):
            raise ValueError(f"{self.path} must be an array (N, columns), got shape {array.shape}")
        if not isinstance(source, Path):
            self._map = lambda: array
        self.size, self.width = (*array.shape, 1)[:2]

    def pieces(self, columns: list[int], chunk: int) -> Iterator[Any]:  # noqa: D102
        for i in range(0, self.size, chunk):
            part = self._map()[i : i + chunk]  # mapped anew, so that memory is freed
            self.read = i + len(part)
            yield part.reshape(-1, self.width)


class Table(Record):
    """A table in memory that PyArrow reads, as a data frame, or a Parquet file."""

    def __init__(self, source: Any) -> None:
        self._source, self.path = source, source if isinstance(source, Path) else "source"
        with self._failures():
            if isinstance(source, Path):
                file = pyarrow().parquet.ParquetFile(source)
                self.size, schema = file.metadata.num_rows, file.schema_arrow
                self._batches = lambda keys, chunk: file.iter_batches(chunk, columns=keys)
            else:
                table = pyarrow().table(_frame(source))
                self.size, schema = len(table), table.schema
                self._batches = lambda keys, chunk: table.select(keys).to_batches(chunk)
            self._keys, self.width = schema.names, len(schema.names)
        self.names = [re.sub("^__index_level_0__$", "time", name) for name in self._keys]
        kept = (schema.pandas_metadata or {}).get("index_columns", [])
        index = [self._keys.index(name) for name in kept if isinstance(name, str)]
        steps = {each["step"] for each in kept if not isinstance(each, str)}
        if steps - {1}:
            raise ValueError(f"{self.path} must have all its rows in order, got steps of {steps}")
        if len(index) > 1 or len({*self._keys}) < self.width:
            rule = "must have columns of distinct names, and an index of one level"
            raise ValueError(f"{self.path} {rule}, got {self._keys}")
        self.index = index[0] if index else None
        self.dates = {}
        for column, kind in enumerate(schema.types):
            if re.match("timestamp|date", str(kind)):
                self.dates[column] = pyarrow().timestamp("ns", getattr(kind, "tz", None))
            if re.match("duration", str(kind)):
                self.dates[column] = pyarrow().duration("ns")

    def pieces(self, columns: list[int], chunk: int) -> Iterator[Any]:  # noqa: D102
        self.read, keys = 0, [self._keys[i] for i in columns]
        for batch in self._batches(keys, chunk):
            self.read += len(batch)
            yield batch.select(keys)  # in this order

    def as_given(self, clock: int | None, times: Matrix, w: Matrix, names: list[str]) -> Any:
        """Return estimates with their times in the type of the record."""
        name = "time" if clock is None else self.names[clock]
        table = self.table(clock, times, w, [name, *names[1:]], file=False)
        frame = _frame(self._source)
        if hasattr(frame, "set_index"):  # of pandas, or of xarray by pandas
            found = table.to_pandas().set_index(name)
            return type(self._source)(found) if hasattr(self._source, "coords") else found
        return type(frame)(table) if hasattr(frame, "to_arrow") else table  # of polars, or Arrow


class Chunks(Record):
    """An iterator of arrays or tables, each with the next rows."""

    def __init__(self, chunks: Iterator[Any]) -> None:
        self._rest = map(in_memory, chunks)
        self._head = next((part for part in self._rest if part.size != 0), Array(np.empty((0, 0))))
        for name in ("width", "names", "index", "dates"):
            setattr(self, name, getattr(self._head, name))

    def pieces(self, columns: list[int], chunk: int) -> Iterator[Any]:  # noqa: D102
        for part in chain([self._head], self._rest):
            if (part.width, part.names, part.dates) != (self.width, self.names, self.dates):
                raise ValueError("source must have the same columns, of one kind, in each chunk")
            for piece in part.pieces(columns, chunk):
                self.read += len(piece)
                yield piece


class Csv(Record):
    """A CSV file, plain or in gzip."""

    unit = "B"
    advice = "; header=, skip_rows=, columns=, delimiter=, decimal= and missing= say how to read it"

    def __init__(self, path: Path, delimiter: str, *dialect: Any) -> None:
        decimal, header, skip, gaps = dialect
        if decimal == delimiter:
            raise ValueError(f"delimiter and decimal must differ, got {decimal!r} for both")
        self._parse = pyarrow().csv.ParseOptions(delimiter=delimiter)
        self.path, self.size = path, path.stat().st_size
        self.first = 1 + skip
        with self._failures(), _Text(path, skip) as text:
            lines = [text.readline(BLOCK) for _ in range(2)]
            given = lines[0].replace(delimiter.encode(), b".").strip()  # a tab is no space here
            if not given or re.search(rb"[\0-\10]|\r(?!\n)", lines[0]):
                rule = "begin with names or numbers, in UTF-8 with line ends of LF"
                raise ValueError(f"{path} must {rule}, got {lines[0][:20]!r}")
            decoded = [line.decode("utf-8-sig", "replace") for line in lines]
            rows = csv.reader(decoded, delimiter=delimiter)
            head, below = ([cell.strip() for cell in next(rows, ())] for _ in lines)
        gaps = [*gaps, *(f" {word}" for word in gaps if word or len(head) > 1)]
        self._values = {"decimal_point": decimal, "null_values": gaps}
        self.width = len(head)
        if self._has_names(head, below) if header is None else header:
            self.names, self.first, head = head, self.first + 1, below
        dates = [(i, date) for i, cell in enumerate(head) if (date := DATE.fullmatch(cell))]
        self.dates = {i: pyarrow().timestamp("ns", date[1] and "UTC") for i, date in dates}

    def _has_names(self, cells: list[str], below: list[str]) -> bool:
        """Return whether the first line is a header; refuse a line that could be samples, too."""
        gaps = {word.lower() for word in (*self._values["null_values"], *MISSING, *NO_NAMES)}
        given = [cell for cell in cells if cell.lower() not in gaps]
        numbers = [cell for cell in given if re.match(NUMBER, cell)]
        odd = not all(re.match(r"[^\W\d]|[#%°\ufffd]", c) for c in given if c not in numbers)
        counted = [cell.removesuffix(".0") for cell in given] == [str(i) for i in range(len(given))]
        whole = all(map(str.isdecimal, given)) and len({*given}) == len(given)
        fractions = any(re.fullmatch(r"[-+]?\d*[.,]\d+(e.*)?", cell) for cell in below)
        gap = not numbers and len({*given}) == 1 < len(given)  # perhaps a word for a gap
        mixed = 0 < len(numbers) < len(given)
        if mixed or counted or gap or odd or (whole and fractions):
            where = f"{self.path}, line {self.first}, {','.join(cells)[:60]!r},"
            rule = "may be a header or a sample: say header=True or header=False"
            raise ValueError(f"{where} {rule}")
        return not numbers

    def pieces(self, columns: list[int], chunk: int) -> Iterator[Any]:  # noqa: D102
        pc, rows, keys = pyarrow().csv, 0, [str(i) for i in range(self.width)]
        kinds = {keys[i]: self.dates.get(i, pyarrow().float64()) for i in columns}
        values = pc.ConvertOptions(**self._values, column_types=kinds, include_columns=list(kinds))
        layout = pc.ReadOptions(use_threads=False, block_size=BLOCK, column_names=keys)
        with _Text(self.path, self.first - 1) as text:
            if not text.peek().strip(b"\r\n"):
                return
            for batch in pc.open_csv(text, layout, self._parse, values):
                rows, self.read = rows + len(batch), os.lseek(text.fileno(), 0, os.SEEK_CUR)
                yield batch
            if rows != text.lines:
                raise csv.Error(f"{text.lines} lines hold {rows} rows: a quote runs over several")


class _Text(io.BufferedReader):
    """The text of a CSV file, without blank lines except at its end."""

    def __init__(self, path: Path, skip: int) -> None:
        with open(path, "rb") as file:
            zipped = file.read(2) == b"\x1f\x8b"
        super().__init__(gzip.GzipFile(path) if zipped else io.FileIO(path))  # type: ignore
        self.lines, self._end = 0, b"\n"  # the number of lines read, and their last line end
        while skip and self.readline():
            skip -= 1

    def read(self, size: int | None = -1) -> bytes:
        text = self._end + (block := super().read(size))
        body = text.rstrip(b"\r\n")
        if blank := re.search(rb"\n\r?\n", body):
            row = self.lines + body.count(b"\n", 0, blank.start()) + 1
            raise csv.Error(f"Row #{row}: blank; a row of gaps has its nan or delimiters")
        self.lines, self._end = self.lines + body.count(b"\n"), text[len(body) :]
        return block


def _frame(source: Any) -> Any:
    """Return the data frame of a series or of an array of xarray; all else as it is."""
    if hasattr(source, "dims"):
        source = source.to_pandas()
    return source.to_frame() if hasattr(source, "to_frame") else source


def in_memory(source: Any) -> Record:
    """Open an array, a data frame, or an iterator of them."""
    if hasattr(source, "dims") or hasattr(source, "to_frame") or hasattr(source, "columns"):
        return Table(source)
    return Chunks(source) if isinstance(source, Iterator) else Array(source)


def opened(source: Any, delimiter: str | None, *dialect: Any) -> Record:
    """Open a record; the dialect is that of `Csv`."""
    decimal, header, skip, missing = dialect
    gaps = [missing] if isinstance(missing, str) else validation.sequence("missing", missing)
    if not all(isinstance(word, str) and word.isprintable() for word in gaps):
        raise TypeError(f"missing must be the words for a gap, got {validation.shown(missing)}")
    header = header if header is None else validation.boolean("header", header)
    decimal = validation.choice("decimal", decimal, (".", ","))
    dialect = decimal, header, validation.integer("skip_rows", skip, low=0), (*gaps,)
    path = validation.path("source", source) if isinstance(source, str | os.PathLike) else None
    mark = delimiter_of("source", path, delimiter) if path else ""
    if path and mark:
        return Csv(path, mark, *dialect)
    if dialect != (".", None, 0, MISSING):
        given = path or type(source).__name__
        raise ValueError(f"decimal, header, skip_rows and missing are for CSV files, not {given}")
    if path is None:
        return in_memory(source)
    return Array(path) if path.suffix.lower() == ".npy" else Table(path)
