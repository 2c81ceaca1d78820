"""Files with a row for each sample: CSV and Parquet by PyArrow, NPY by NumPy."""

import csv
import gzip
import io
import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy

from robsmooth._support import validation
from robsmooth._support.extras import extra
from robsmooth._support.validation import Matrix

BLOCK = 1 << 18  # bytes of a CSV file at a time, and more than a line of it has
DATE = re.compile(r"\d{4}-\d\d-\d\d(?:[T ][\d:.]*(Z|[-+]\d\d:?\d\d)?)?")
MISSING = ("", "NA", "N/A", "#N/A", "null", "nan", ".")
NO_NAMES = ("None", "<NA>", "NaT", "-", "--", "?")  # gaps of others rather than names of columns


def pyarrow() -> Any:
    """Return PyArrow, which an extra brings."""
    with extra("records", "a CSV or Parquet file"):
        import pyarrow.csv
        import pyarrow.parquet
    return pyarrow


def delimiter_of(name: str, path: Path, given: str | None) -> str:
    """Return what stands between the cells of a file of this suffix, nothing where it has none."""
    found = re.search(r"(\.csv|\.tsv)(\.gz)?$|\.npy$|\.parquet$", path.name.lower())
    unwritten = found and name == "target" and found[0] == ".parquet"
    if not found or unwritten or (path.exists() and not path.is_file()):
        allowed = "that ends in .csv, .tsv, .csv.gz, .tsv.gz, .npy or, to be read, .parquet"
        raise ValueError(f"{name} must be a file, no pipe or device, {allowed}, got {path}")
    if given is not None and not re.fullmatch(r"(?![\w\"'.+-])[\t -~]", str(given)):
        allowed = "one character of ASCII, not a quote and in no number"
        raise ValueError(f"delimiter must be {allowed}, got {given!r}")
    return (given or {".csv": ",", ".tsv": "\t"}[found[1]]) if found[1] else ""


class Record:
    """A file with a row for each sample."""

    unit, first, read, advice = "row", 0, 0, ""  # of the size; the first row; how much was read
    names: Sequence[str] = ()
    dates: Mapping[int, Any] = {}  # the types of columns of dates, which are read as Unix seconds

    def name(self, column: int) -> str:
        """Return what a column is called in messages."""
        return f"column {column}" + (f" ({self.names[column]!r})" if self.names else "")


class Npy(Record):
    """An NPY file. It is mapped anew for each chunk: what was read need not stay in memory."""

    def __init__(self, path: Path) -> None:
        try:
            array = npy.open_memmap(path, mode="r")
        except (ValueError, SyntaxError, TokenError) as error:  # the last two for a header
            plain = "plain numbers, without Python objects, which are never unpickled"
            raise ValueError(f"{path} must be an NPY file of {plain}: {error}") from None
        if array.dtype.kind not in "iuf":
            raise TypeError(f"{path} must hold real numbers, got entries of {array.dtype}")
        if array.ndim not in (1, 2):
            raise ValueError(f"{path} must hold an array (N, columns), got shape {array.shape}")
        self.path, self.size = path, len(array)
        self.keys = range(array.shape[1] if array.ndim == 2 else 1)

    def rows(self, columns: list[int], chunk: int) -> Iterator[Matrix]:
        """Yield columns of the next rows."""
        for i in range(0, self.size, chunk):
            part = npy.open_memmap(self.path, mode="r")[i : i + chunk].reshape(-1, len(self.keys))
            self.read = i + len(part)
            yield part[:, columns].astype(float)


class Parquet(Record):
    """A Parquet file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._failures(), pyarrow().parquet.ParquetFile(path) as file:
            self.size, schema = file.metadata.num_rows, file.schema_arrow
        self.names = self.keys = schema.names
        dates = [(i, t) for i, t in enumerate(schema.types) if re.match("timestamp|date", str(t))]
        self.dates = {i: pyarrow().timestamp("ns", getattr(t, "tz", None)) for i, t in dates}

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Say in which file, and where in it, a library found something wrong."""
        wrong = EOFError, zlib.error, gzip.BadGzipFile, csv.Error, pyarrow().ArrowException
        try:
            yield
        except wrong as error:
            what = re.sub(r"Row #(\d+)", lambda n: f"line {self.first + int(n[1]) - 1}", str(error))
            raise ValueError(f"{self.path}: {what[:200]}{self.advice}") from None

    def rows(self, columns: list[int], chunk: int) -> Iterator[Matrix]:
        """Yield columns of the next rows."""
        kinds = {self.keys[i]: self.dates.get(i, pyarrow().float64()) for i in columns}
        with self._failures():
            for batch in self._batches(kinds, chunk):
                for part in (batch[i : i + chunk] for i in range(0, len(batch), chunk)):
                    yield np.column_stack([_numbers(part[key], kinds[key]) for key in kinds])

    def _batches(self, kinds: dict[str, Any], chunk: int) -> Iterator[Any]:
        self.read = 0
        with pyarrow().parquet.ParquetFile(self.path) as file:
            for batch in file.iter_batches(chunk, columns=list(kinds)):
                if "bool" in map(str, batch.schema.types):
                    raise TypeError(f"{self.path} must hold real numbers, got booleans")
                self.read += len(batch)
                yield batch


def _numbers(column: Any, kind: Any) -> Matrix:
    column = column.cast(kind, safe=False)
    if str(kind) == "double":
        return column.to_numpy(zero_copy_only=False)
    return column.cast("int64").to_numpy(zero_copy_only=False) / 1e9


class Csv(Parquet):
    """A CSV file, as it is or in gzip."""

    unit = "B"
    advice = "; header=, skip_rows=, columns=, delimiter=, decimal= and missing= say how to read it"

    def __init__(self, path: Path, delimiter: str, *dialect: Any) -> None:
        decimal, header, skip, missing = dialect
        if validation.choice("decimal", decimal, (".", ",")) == delimiter:
            raise ValueError(f"delimiter and decimal must differ, got {decimal!r} for both")
        gaps = [missing] if isinstance(missing, str) else missing
        if not (isinstance(gaps, Sequence) and all(isinstance(word, str) for word in gaps)):
            raise TypeError(f"missing must be the words for a gap, got {missing!r}")
        self._parse = pyarrow().csv.ParseOptions(delimiter=delimiter)
        self.path, self.size = path, path.stat().st_size
        self.first = 1 + validation.integer("skip_rows", skip, low=0)
        with self._failures(), _Text(path, skip) as text:
            lines = [text.readline(BLOCK) for _ in range(2)]
            for rule, broken in {
                "begin with a header or a row of numbers, not a blank": not lines[0].strip(),
                f"have lines of less than {BLOCK} bytes": BLOCK in map(len, lines),
                "be text in UTF-8 with line ends of LF": re.search(rb"[\0-\10]|\r(?!\n)", lines[0]),
                "have one space between numbers": delimiter == " " and b"  " in lines[0],
            }.items():
                if broken:
                    raise ValueError(f"{path} must {rule}")
            decoded = [line.decode("utf-8-sig", "replace") for line in lines]
            rows = csv.reader(decoded, delimiter=delimiter)
            head, below = ([cell.strip() for cell in next(rows, ())] for _ in lines)
        gaps = [*gaps, *(f" {word}" for word in gaps if word or len(head) > 1)]
        self._values = {"decimal_point": decimal, "null_values": gaps}
        self.keys = [str(i) for i in range(len(head))]
        if self._has_names(head, below) if header is None else validation.boolean("header", header):
            self.names, self.first, head = head, self.first + 1, below
        dates = [(i, date) for i, cell in enumerate(head) if (date := DATE.fullmatch(cell))]
        self.dates = {i: pyarrow().timestamp("ns", date[1] and "UTC") for i, date in dates}

    def _has_names(self, cells: list[str], below: list[str]) -> bool:
        """Return whether the first line is a header; refuse one that may have samples, too."""
        gaps = {word.lower() for word in (*self._values["null_values"], *MISSING, *NO_NAMES)}
        given = [cell for cell in cells if cell.lower() not in gaps]
        numbers = [cell for cell in given if re.match(r"[-+.]?\d", cell)]
        below = [cell for cell in below if re.fullmatch(r"[-+]?\d*[.,]\d+(e.*)?", cell)]
        counted = [cell.removesuffix(".0") for cell in given] == [str(i) for i in range(len(given))]
        distinct = all(map(str.isdecimal, given)) and len({*given}) == len(given)
        alike = not numbers and len({*given}) == 1 < len(given)  # a gap's word, perhaps
        if 0 < len(numbers) < len(given) or counted or alike or (distinct and below):
            line = f"{self.path}, line {self.first}, {','.join(cells)[:60]!r},"
            raise ValueError(f"{line} may be a header or a sample: say header=True or header=False")
        return not numbers

    def _batches(self, kinds: dict[str, Any], chunk: int) -> Iterator[Any]:
        pc, rows, names = pyarrow().csv, 0, list(kinds)
        values = pc.ConvertOptions(**self._values, column_types=kinds, include_columns=names)
        layout = pc.ReadOptions(use_threads=False, block_size=BLOCK, column_names=self.keys)
        with _Text(self.path, self.first - 1) as text:
            if not text.peek().strip(b"\r\n"):
                return
            for batch in pc.open_csv(text, layout, self._parse, values):
                rows, self.read = rows + len(batch), os.lseek(text.fileno(), 0, os.SEEK_CUR)
                yield batch
            if rows != text.lines:
                raise csv.Error(f"{text.lines} lines hold {rows} rows: a quote runs over several")


class _Text(io.BufferedReader):
    """The text of a CSV file, of which only the last lines may be blank."""

    def __init__(self, path: Path, skip: int) -> None:
        with open(path, "rb") as file:
            zipped = file.read(2) == b"\x1f\x8b"
        super().__init__(gzip.GzipFile(path) if zipped else io.FileIO(path))  # type: ignore
        self.lines, self._end = 0, b"\n"  # of those that were read, and with what these ended
        for _ in range(skip):
            self.readline()

    def read(self, size: int | None = -1) -> bytes:
        text = self._end + (block := super().read(size))
        body = text.rstrip(b"\r\n")
        if blank := re.search(rb"\n\r?\n", body):
            row = self.lines + body.count(b"\n", 0, blank.start()) + 1
            raise csv.Error(f"Row #{row}: blank; a row of gaps has its nan or delimiters")
        self.lines, self._end = self.lines + body.count(b"\n"), text[len(body) :]
        return block


def opened(path: Path, delimiter: str | None, *dialect: Any) -> Npy | Parquet:
    """Open a record; the dialect is that of `Csv`."""
    if mark := delimiter_of("source", path, delimiter):
        return Csv(path, mark, *dialect)
    if dialect != (".", None, 0, MISSING):
        raise ValueError(f"decimal, header, skip_rows and missing are for CSV files, not {path}")
    return Npy(path) if path.suffix.lower() == ".npy" else Parquet(path)


@contextmanager
def writer(path: Path, outputs: int, delimiter: str, date: Any) -> Iterator[Any]:
    """Give what appends rows to an NPY file or, with their times, to a CSV file."""
    if delimiter:
        pa, number = pyarrow(), pyarrow().float64()
        w = [(f"w[{i}]", number) for i in range(outputs)]
        schema = pa.schema([("time", date or number), *w])
        bare = {"include_header": False, "quoting_style": "none", "delimiter": delimiter}
        with pa.output_stream(path) as file:  # in gzip where the path ends so
            file.write(f"{delimiter.join(schema.names)}\n".encode())
            with pa.csv.CSVWriter(file, schema, write_options=pa.csv.WriteOptions(**bare)) as table:
                as_given = (lambda t: np.round(1e6 * t).astype("M8[us]")) if date else np.asarray
                yield lambda times, w: table.write(pa.table([as_given(times), *w.T], schema=schema))
        return
    with open(path, "wb") as file:
        file.write(bytes(128))  # for the header
        yield lambda _, w: file.write(w.astype("<f8").tobytes())
        shape = (file.tell() - 128) // (8 * outputs), outputs
        file.seek(0)
        npy.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
