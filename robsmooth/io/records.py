"""Measured records: read, smoothed and written in chunks.

A record has a row for each sample and a column for each measurement, the mean of dy/dt over the
sample's interval: in a file or in memory (`robsmooth.io.formats`).
"""

import math
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from robsmooth._support import validation
from robsmooth._support.validation import Matrix, shown
from robsmooth.estimators.discrete import OUTPUTS, SHORTEST, DiscreteSmoother
from robsmooth.io import formats, targets
from robsmooth.io.formats import Record

CHUNK = 65_536  # rows
TIMING = 0.5  # of a sample: by how much a row may come too early or too late
DRIFT = 1e-3  # by how much the record's clock may differ from dt's
COARSE = 1e-2  # of a sample: by how much rounding may change a time
HEAD = 1000  # rows by which times are known
GAP = 30  # times the median interval: a mean over a longer one is likely to be none

Column = int | str
Columns = Column | Sequence[Column] | None  # or False, for time


def smooth_record(
    smoother: DiscreteSmoother,
    source: Any,
    target: str | os.PathLike[str] | None = None,
    *,
    columns: Columns = None,
    reference: Columns = None,
    time: Column | Literal[False] | None = None,
    regular: bool = True,
    output: str = "smoothed",
    return_std: bool = False,
    delimiter: str | None = None,
    decimal: str = ".",
    header: bool | None = None,
    skip_rows: int = 0,
    missing: str | Sequence[str] = formats.MISSING,
    chunk: int = CHUNK,
    progress: bool = False,
    resume: bool = False,
) -> Any:
    """Smooth a record in memory, or from file to file with a chunk in memory at a time.

    The smoother continues from its state, as in `DiscreteSmoother.run`: of a gap between two
    records it knows where an iterator has both. A failure leaves state and target as they were.

    Parameters
    ----------
    smoother : DiscreteSmoother, made by ``estimator.discretize(dt)``
    source : path, array, data frame or iterator
        A ``.csv``, ``.tsv``, ``.parquet`` or ``.npy`` file, the former two in gzip or not; an array
        (N, columns) or (N,); a frame or series of pandas, polars or xarray, a table of PyArrow; or
        an iterator of these. What is nan, null, masked or a gap is missing.
    target : path, optional
        For the estimates: a ``.csv`` or ``.tsv`` file with the columns ``time``, ``w[0]``,
        ``w[1]``..., in gzip as ``.csv.gz``, or a ``.npy`` file of an (N, m) array.
    columns, reference : int, str or sequence of them, optional
        Indices or names of the l measurements, by default all other columns, and of the g
        references, as in `DiscreteSmoother.run`.
    time : int, str or False, optional
        The column of the rows' times, s or dates; by default a frame's index that does more than
        count. A row's time is the begin of its interval, or that of its sample with
        ``discretize(samples="instants")``. Estimates have times of this clock: the end of the
        interval, less the `delay` where they are smoothed; without, those of
        `DiscreteSmoother.times`. A column that looks like times is refused as a measurement, and
        checked where ``columns`` omits it; False turns both off.
    regular : bool
        Whether to refuse a missing row or a wrong dt. With False an interval lasts from one row's
        time to the next, which a mean is over; a row without a neighbour has dt.
    output : {"smoothed", "filtered"}
    return_std : bool, whether to add the errors' standard deviations, as `DiscreteSmoother.run`
        In columns ``std[0]``, ``std[1]``... behind those of ``w``; as a second array for arrays.
    delimiter, decimal, header, skip_rows, missing : optional
        The dialect of a CSV file: both marks; whether it begins with names, where the first line
        could be either; the number of lines before; the words for a gap, exactly as in the file.
    chunk : int, rows in memory at a time
    progress : bool, whether to show a progress bar
    resume : bool, whether the same call can resume an interrupted one, to the same bytes

    Returns
    -------
    int, array, data frame or iterator
        With a target the number of rows. Else the estimates (N, m) in the type of the source, in a
        frame with their times; an iterator yields arrays, and advances the smoother with each.

    Raises
    ------
    ValueError, TypeError, ArithmeticError, OSError, ImportError
        For what cannot be read, or is no number, by file, row and column; where the state exceeds
        the range of floats; and where a file or the extra ``records`` is missing.

    Examples
    --------
    >>> smoother = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system()).discretize(1e-7)
    >>> rs.smooth_record(smoother, np.zeros((100, 1))).shape
    (100, 1)
    """
    validation.instance("smoother", smoother, DiscreteSmoother)
    output = validation.choice("output", output, OUTPUTS)
    for name, flag in (("progress", progress), ("resume", resume), ("regular", regular)):
        validation.boolean(name, flag)
    kinds = ("w", "std")[: 1 + validation.boolean("return_std", return_std)]
    chunk = validation.integer("chunk", chunk, low=1)
    record = formats.opened(source, delimiter, decimal, header, skip_rows, missing)
    path, mark = _target(record, target, delimiter, resume)
    chosen, clock = _choice(record, smoother, columns, reference, time)
    names = ["time"] + [f"{kind}[{i}]" for kind in kinds for i in range(smoother.m)]
    ends = [smoother.l, smoother.l + (0 if reference is None else smoother.g)]
    if clock is None and not regular:
        raise ValueError("time must be given where regular=False")
    if smoother.p:
        raise ValueError("smoother must have no known inputs, which run(y, inputs=...) takes")
    timed = target is not None or isinstance(record, formats.Table)
    delay = smoother.delay if output == "smoothed" else 0.0
    digits = (6 if regular else 15) - math.floor(math.log10(smoother.dt))  # of times

    def smooth(values: Matrix) -> tuple[Matrix, Matrix]:
        y, known, own = np.split(values, ends, axis=1)
        length = smoother.dt if regular else own[:, 1]
        how = {"reference": known if known.size else None, "return_std": return_std}
        w = smoother.run(y, **how, output=output, intervals=None if regular else length)
        if clock is not None:
            times = own[:, 0] + (0.0 if smoother.instants else length) - delay
        else:
            times = smoother.times(len(y), output) if timed else np.zeros(len(y))
        return np.round(times, digits), np.hstack(w) if return_std else w

    def apart(w: Matrix) -> Any:
        return tuple(np.hsplit(w, 2)) if return_std else w

    record.shown = progress
    pieces = _checked(record, chosen, ends, smoother.dt, regular, chunk)
    if not regular:
        pieces = _with_lengths(pieces, smoother.dt, smoother.instants)
    if target is None and isinstance(record, formats.Chunks):
        return (apart(smooth(values)[1]) for values in pieces)
    before = smoother._checkpoint()
    try:
        if target is None:
            none = np.empty(0), np.empty((0, len(names) - 1))
            times, w = map(np.concatenate, zip(none, *map(smooth, pieces), strict=True))
            framed = isinstance(record, formats.Table)
            return record.as_given(clock, times, w, names) if framed else apart(w)
        given = {"columns": chosen, "clock": clock, "delimiter": mark, "chunk": chunk}
        identity = (lambda: given | {"first date": str(record.origin)}) if resume else None
        writer = partial(targets.writer, record, clock, mark, names)
        return targets.written(smoother, smooth, pieces, path, writer, identity)
    except BaseException:
        smoother._restore(before)
        raise


def _target(record: Record, target: Any, delimiter: str | None, resume: bool) -> tuple[Path, str]:
    """Return where to write, and the delimiter there."""
    if target is None:
        if resume or isinstance(record.path, Path):
            raise TypeError("target must be given where source is a file, and for resume=True")
        return Path(), ""
    path = validation.path("target", target)
    mark = formats.delimiter_of("target", path, delimiter)
    if isinstance(record.path, Path) and path.exists() and path.samefile(record.path):
        raise ValueError(f"target must be another file than source, got {path} for both")
    if resume and path.suffix.lower() == ".gz":
        raise ValueError(f"target must be no file in gzip where resume=True, got {path}")
    return path, mark


def _choice(
    record: Record, smoother: DiscreteSmoother, columns: Columns, reference: Columns, time: Columns
) -> tuple[list[int], int | None]:
    """Return the columns of measurements, reference and times, and the one that is the clock."""
    known = _positions(record, "reference", reference, smoother.g)
    times = _positions(record, "time", time, 1)
    if time is None and record.index is not None:
        times = [record.index]
    clock = times[0] if times else None
    measured = _positions(record, "columns", columns, smoother.l)
    rest = [i for i in range(record.width) if i not in {*known, *times, *measured, record.index}]
    if time is None and clock is None:
        times = [i for i in rest if i in record.dates or _rises_evenly(record, i)][:1]
    if columns is None:
        if times and clock is None:
            what = f"{record.path}: {record.name(times[0])} looks like times"
            key = record.names[times[0]] if record.names else times[0]
            raise ValueError(f"{what}: say time={key!r}, or time=False where it is not")
        measured = _positions(record, "columns", rest, smoother.l)
    chosen = [*measured, *known, *times]
    if len({*chosen}) < len(chosen) or record.dates.keys() & {*measured, *known}:
        raise ValueError(f"columns, reference and time must be distinct, and no dates: {chosen}")
    return chosen, clock


def _positions(record: Record, name: str, chosen: Columns, wanted: int) -> list[int]:
    """Return the positions of the columns that the argument of this name chooses."""
    if chosen is None or (chosen is False and name == "time"):
        return []
    path, names, found = record.path, list(record.names), []
    single = isinstance(chosen, str) or validation.is_single(chosen)
    for column in [chosen] if single else validation.sequence(name, chosen, of="columns"):
        named = isinstance(column, str)
        if named and names.count(column) != 1:
            there = "twice" if column in names else "not"
            known = ", ".join(map(repr, names)) or "no header"
            raise ValueError(f"{name}: {shown(column)} is {there} in {path}, which has {known}")
        index = validation.integer(name, names.index(column) if named else column, low=0)
        if index >= record.width:
            raise ValueError(f"{name}: {path} has {record.width} columns, there is no {index}")
        if not named and str(index) in names and names[index] != str(index):
            raise ValueError(f"{name}: {path} has another column named {index}: say names")
        found.append(index)
    if len(found) != wanted:
        given = ", ".join(record.name(i) for i in found[:10])
        advice = "; its .T has a row for each sample" if record.size == wanted else record.advice
        given = f"{len(found)}: {given}{advice}"
        raise ValueError(f"{name} must name {wanted} columns of {path}, got {given}")
    return found


def _rises_evenly(record: Record, column: int) -> bool:
    """Return whether a column begins like times, perhaps with a few rows missing."""
    with suppress(ValueError, TypeError), np.errstate(invalid="ignore"):
        steps = np.diff(next(record.rows([column], HEAD), np.empty((0, 1)))[:, 0])
        if len(steps) > 2 and (steps > 0).all():
            return float(np.mean(np.abs(steps / np.median(steps) - 1.0) < TIMING)) > 0.7
    return False


def _checked(
    record: Record, chosen: list[int], ends: list[int], dt: float, regular: bool, chunk: int
) -> Iterator[Matrix]:
    """Yield the rows of a record; refuse wrong numbers and times."""
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
            if np.spacing(np.abs(times).max(initial=0.0)) > COARSE * dt:
                rule = f"floats of this size do not tell samples of {dt:g} s apart"
                raise ValueError(f"{place(0, -1)}: {rule}: give dates, or s from the begin")
            late, drift = np.diff(times, prepend=last) / dt, (times - begin) / dt - count
            wrong = (np.abs(late - 1) >= TIMING) | (np.abs(drift) >= TIMING + DRIFT * count)
            wrong = wrong if regular else late < SHORTEST
            if wrong.any():
                i = int(wrong.argmax())
                advice = "times must rise" + " by dt: " * regular
                if regular and done + i == 1 and late[i] > 0:
                    advice += f"is dt {late[i] * dt:.6g}? Or divide them by {late[i]:.6g}, or "
                if regular:
                    advice += "put a row of nan for each missing row; regular=False is only for "
                    advice += "means that reach to the next row's time"
                after = f"{late[i]:.6g} samples after the row before"
                off = f"{drift[i]:+.6g} off regular times with dt = {dt:g} s"
                time = f"{times[i]:.15g} s is {after} and {off}"
                raise ValueError(f"{place(i, -1)}: {time}; {advice}")
            last = times[-1]
        yield values
        done += len(values)


def _with_lengths(pieces: Iterator[Matrix], dt: float, instants: bool) -> Iterator[Matrix]:
    """Yield rows and their intervals' lengths, to the next row or, for instants, from the last."""
    before = np.empty((0, 0))
    for values in pieces:
        if instants:
            begin = before[:, -1] if before.size else values[:1, -1] - dt
            yield np.column_stack([values, np.diff(values[:, -1], prepend=begin)])
        else:
            values = np.vstack([before, values]) if before.size else values
            lengths = np.diff(values[:, -1])
            if len(lengths) and lengths.max() > GAP * np.median(lengths):
                row, most = values[lengths.argmax(), -1], lengths.max()
                what = f"the row at {row:.15g} s counts as a mean over {most:.6g} s"
                warnings.warn(f"{what}: put a row of nan for each missing row", stacklevel=2)
            yield np.column_stack([values[:-1], lengths])
        before = values[-1:]
    if before.size and not instants:
        yield np.column_stack([before, [dt]])
