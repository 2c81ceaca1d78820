"""Estimates written to a file, by a run that can be resumed.

An interrupted run leaves its file, and a journal of its progress and the smoother's state. To
resume, the record is read anew and compared by a digest; the file is cut to the last note's size.
"""

import base64
import gzip
import hashlib
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from robsmooth._support.checkpoint import ANEW, CheckpointError, open_journal
from robsmooth._support.extras import pyarrow
from robsmooth._support.files import atomic_path
from robsmooth._support.validation import Matrix
from robsmooth.estimators.discrete import DiscreteSmoother
from robsmooth.estimators.sample_loop import Memory
from robsmooth.io.formats import Record

HEADER = 128  # bytes of an NPY file
KEPT = 64  # chunks between notes in the journal


def written(
    smoother: DiscreteSmoother,
    smooth: Callable[[Matrix], tuple[Matrix, Matrix]],
    pieces: Iterator[Matrix],
    target: Path,
    writer: Callable[[Path, int], Any],
    identity: Callable[[], dict[str, Any]] | None,
) -> int:
    """Write a record's estimates; return their number. An identity resumes a run that has it."""
    notes, found = None, {}
    if identity is not None:
        before, first = smoother._checkpoint(), list(islice(pieces, 1))
        estimates = [smooth(np.nan_to_num(values, nan=1.0))[1].tobytes() for values in first]
        smoother._restore(before)
        digest = hashlib.sha256(b"".join(estimates))  # tells smoothers apart, also in gaps
        found = {"smoother": repr(smoother), "first estimates": digest.hexdigest(), **identity()}
        notes, pieces = target.with_name(target.name + ".resume"), chain(first, pieces)
    kept, rows, begin, digest = ".part" if notes else "", 0, 0, hashlib.sha256()
    with open_journal(notes, found) as journal, atomic_path(target, kept) as path:
        if journal and (last := journal.last):
            while rows < last["rows"] and (values := next(pieces, None)) is not None:
                rows += len(values)
                digest.update(values.tobytes())
            begin = last["bytes"]
            there = path.stat().st_size if path.exists() else 0
            if digest.hexdigest() != last["digest"] or there < begin:
                other = f"of another record, or of another file than {path}"
                raise CheckpointError(f"the checkpoint {journal.path} is {other}: {ANEW}")
            memory = np.load(io.BytesIO(base64.b64decode(last["state"])))
            smoother._restore((Memory(*memory.values()), last["samples"]))
        with writer(path, begin) as (put, file):
            for number, values in enumerate(pieces, 1):
                put(*smooth(values))
                rows += len(values)
                if journal is None:
                    continue
                digest.update(values.tobytes())
                if number % KEPT == 0:
                    file.flush()
                    os.fsync(file.fileno())
                    place = {"rows": rows, "bytes": file.tell(), "digest": digest.hexdigest()}
                    np.savez(memory := io.BytesIO(), *smoother._checkpoint()[0])
                    state = base64.b64encode(memory.getvalue()).decode()
                    journal.append(place | {"samples": smoother.samples, "state": state})
    if notes:
        notes.unlink()
    return rows


@contextmanager
def writer(
    record: Record, clock: int | None, delimiter: str, names: list[str], path: Path, begin: int
) -> Iterator[Any]:
    """Open a file, cut to `begin` bytes; yield a function of times and estimates, and the file."""
    with open(path, "r+b" if begin else "wb") as file:
        file.truncate(begin)
        file.seek(begin)
        if not delimiter:
            file.write(bytes(HEADER if not begin else 0))
            yield lambda _, w: file.write(w.astype("<f8").tobytes()), file
            columns = len(names) - 1
            rows = (file.tell() - HEADER) // (8 * columns)
            header = {"descr": "<f8", "fortran_order": False, "shape": (rows, columns)}
            file.seek(0)
            npy.write_array_header_1_0(file, header)
            return
        csv = pyarrow().csv
        bare = csv.WriteOptions(include_header=False, delimiter=delimiter, quoting_style="none")
        zipped = gzip.GzipFile("", "wb", 6, file, 0) if path.suffix.lower() == ".gz" else None
        with zipped or nullcontext(file) as sink:
            if not begin:
                sink.write(f"{delimiter.join(names)}\n".encode())

            def put(times: Matrix, w: Matrix) -> None:
                csv.write_csv(record.table(clock, times, w, names, file=True), sink, bare)

            yield put, file
