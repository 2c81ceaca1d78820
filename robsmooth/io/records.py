"""Measured records in files: read, smoothed and written in chunks.

A record has a row for each sample and a column for each measurement, the mean of dy/dt over the
sample's interval: a CSV or Parquet file, or an NPY file with an array of numbers.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from robsmooth._support import validation
from robsmooth._support.files import atomic_path
from robsmooth._support.progress import progress_bar
from robsmooth._support.validation import Matrix
from robsmooth.estimators.discrete import OUTPUTS, DiscreteSmoother
from robsmooth.io import formats
from robsmooth.io.formats import Record

CHUNK = 65_536  # rows
TIMING = 0.5  # of a sample: by how much a row may come too early or too late
DRIFT = 1e-3  # by how much the record's clock may differ from dt's
HEAD = 1000  # rows by which times are known

Column = int | str
Columns = Column | Sequence[Column] | None  # or False, for time


def smooth_record(
    smoother: DiscreteSmoother,
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    columns: Columns = None,
    reference: Columns = None,
    time: Column | Literal[False] | None = None,
    output: str = "smoothed",
    delimiter: str | None = None,
    decimal: str = ".",
    header: bool | None = None,
    skip_rows: int = 0,
    missing: str | Sequence[str] = formats.MISSING,
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
        A ``.csv`` or ``.tsv`` file, in gzip or not, a ``.parquet`` file, or a ``.npy`` file with an
        array (N, columns) or (N,). Where it has nan or a gap, a measurement is missing.
    target : path
        For the estimates: a ``.csv`` or ``.tsv`` file with the columns ``time``, ``w[0]``,
        ``w[1]``..., in gzip as ``.csv.gz``, or a ``.npy`` file of an (N, m) array.
    columns, reference : int, str or sequence of them, optional
        The l columns that are measurements, by default all others, and the g ones of the reference
        of the nonlinearities, as in `DiscreteSmoother.run`: indices, or names of a header.
    time : int, str or False, optional
        A column with the begins of the rows' intervals, s or dates. A row that is missing, or a
        wrong dt, is refused. The times of the estimates are in this clock: a row's time plus dt,
        less the `delay` where they are smoothed; without it, those of `DiscreteSmoother.times`.
        A column that looks like times is refused as a measurement by default, and checked where
        ``columns`` leaves it out; with False neither is done.
    output : {"smoothed", "filtered"}, which estimates to write
    delimiter, decimal : str, one character each of CSV files, by their suffix and "." by default
    header : bool, optional
        Whether a CSV file begins with names; by default whether its first line has words and no
        numbers. One that may be either, as ``0,1`` or ``NA,NA``, is refused.
    skip_rows : int, lines of a CSV file before the header or the first sample
    missing : str or sequence of str
        What stands for a gap in a CSV file: by default nothing, NA, N/A, #N/A, null, nan or a dot.
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
    OSError, ImportError
        Where a file cannot be opened or written, or wants PyArrow, of the extra ``records``.

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
    source, target = (Path(os.path.expanduser(path)) for path in (source, target))
    record = formats.opened(source, delimiter, decimal, header, skip_rows, missing)
    mark = formats.delimiter_of("target", target, delimiter)
    if target.exists() and target.samefile(source):
        raise ValueError(f"target must be another file than source, got {target} for both")
    chosen = _choice(record, smoother, columns, reference, time)
    timed = time is not None and time is not False
    shift = smoother.dt - (smoother.delay if output == "smoothed" else 0.0)
    ends = [smoother.l, smoother.l + (0 if reference is None else smoother.g)]
    before = smoother._checkpoint()
    bar = progress_bar(total=record.size, unit=record.unit, unit_scale=True, shown=progress)
    rows, date = 0, record.dates.get(chosen[-1]) if timed else None
    try:
        with bar, atomic_path(target) as path, formats.writer(path, smoother.m, mark, date) as put:
            for values in _checked(record, chosen, ends, smoother.dt, chunk):
                y, known, own = np.split(values, ends, axis=1)
                estimates = smoother.run(y, reference=known if known.size else None, output=output)
                put(own[:, 0] + shift if timed else smoother.times(len(y), output), estimates)
                rows += len(y)
                bar.update(record.read - bar.n)
    except BaseException:
        smoother._restore(before)
        raise
    return rows


def _choice(record: Record, smoother: DiscreteSmoother, *given: Columns) -> list[int]:
    """Return the columns that are used: measurements, reference and times, in this order."""
    columns, reference, time = given
    known = _positions(record, "reference", reference, smoother.g)
    times = _positions(record, "time", time, 1)
    measured = _positions(record, "columns", columns, smoother.l)
    rest = [i for i in range(len(record.keys)) if i not in (*known, *times, *measured)]
    if time is None:
        times = [i for i in rest if i in record.dates or _rises_evenly(record, i)][:1]
    if columns is None:
        if time is None and times:
            found, says = (
                record.name(times[0]),
                f"say time={times[0]}, or time=False where it is not",
            )
            raise ValueError(f"{record.path}: {found} looks like times: {says}")
        measured = _positions(record, "columns", rest, smoother.l)
    chosen = [*measured, *known, *times]
    if len({*chosen}) < len(chosen) or record.dates.keys() & {*measured, *known}:
        raise ValueError(f"columns, reference and time must be distinct, and no dates: {chosen}")
    return chosen


def _positions(record: Record, name: str, chosen: Columns, wanted: int) -> list[int]:
    """Return the positions of the columns that the argument of this name chooses."""
    if chosen is None or chosen is False:
        return []
    path, names, found = record.path, list(record.names), []
    for column in [chosen] if isinstance(chosen, int | np.integer | str) else chosen:
        if isinstance(column, str) and names.count(column) != 1:
            there = "twice" if column in names else "not"
            known = ", ".join(map(repr, names)) or "no header"
            raise ValueError(f"{name}: {column!r} is {there} in {path}, which has {known}")
        index = names.index(column) if isinstance(column, str) else column
        found.append(validation.integer(name, index, low=0))
        if index >= len(record.keys):
            raise ValueError(f"{name}: {path} has {len(record.keys)} columns, there is no {index}")
    if len(found) != wanted:
        given = ", ".join(record.name(i) for i in found)
        raise ValueError(
            f"{name} must name {wanted} columns of {path}, got {len(found)}: {given}{record.advice}"
        )
    return found


def _rises_evenly(record: Record, column: int) -> bool:
    """Return whether a column begins as times would, of which a few are missing."""
    with suppress(ValueError, TypeError):
        steps = np.diff(next(record.rows([column], HEAD), np.empty((0, 1)))[:, 0])
        if len(steps) > 2 and (steps > 0).all():
            return float(np.mean(np.abs(steps / np.median(steps) - 1.0) < TIMING)) > 0.7
    return False


def _checked(
    record: Record, chosen: list[int], ends: list[int], dt: float, chunk: int
) -> Iterator[Matrix]:
    """Yield the rows of a record whose numbers and times are as they must be."""
    done, begin, last = 0, 0.0, 0.0

    def place(i: int, j: int) -> str:
        called = "line" if record.unit == "B" else "row"
        return f"{record.path}, {called} {record.first + done + i}, {record.name(chosen[j])}"

    for values in record.rows(chosen, chunk):
        wrong = ~np.isfinite(values)
        wrong[:, : ends[0]] &= ~np.isnan(values[:, : ends[0]])
        if wrong.any():
            i, j = np.argwhere(wrong)[0]
            raise ValueError(f"{place(i, j)}: {values[i, j]} where there must be a finite number")
        for times in values[:, ends[1] :].T:
            count = done + np.arange(len(times))
            begin, last = (begin, last) if done else (times[0], times[0] - dt)
            late, drift = np.diff(times, prepend=last) / dt, (times - begin) / dt - count
            wrong = (np.abs(late - 1) >= TIMING) | (np.abs(drift) >= TIMING + DRIFT * count)
            if wrong.any():
                i = int(wrong.argmax())
                raise ValueError(
                    f"{place(i, -1)}: {times[i]:.15g} s is {late[i]:.6g} samples after the row "
                    f"before and {drift[i]:+.6g} samples off the times of the record's begin with "
                    f"dt = {dt:g} s; time=False takes all rows as regular"
                )
            last = times[-1]
        yield values
        done += len(values)
