"""A long computation's checkpoint: an append-only file of records, from which it resumes.

Each line is a record, ``<checksum> <JSON>``; the first is a header with the identity of the
computation. A record is on the disk when `Journal.append` returns. A line that a crash left
unfinished fails its checksum: at the next opening it is cut off, and all before it count.
"""

import errno
import fcntl
import hashlib
import json
import os
import stat
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import BinaryIO

FORMAT = 1
LONGEST_HEADER = 2**20  # bytes that are read of a file which may be anything
LONGEST_SHOWN = 40  # characters of a value in a message

FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file has reached the largest size allowed",
}


class CheckpointError(ValueError):
    """A file that cannot be this computation's checkpoint; it was left as it is."""


def open_journal(
    path: str | os.PathLike[str] | None, identity: Mapping[str, object]
) -> "AbstractContextManager[Journal | None]":
    """Return the `Journal` at a path, to be entered; with no path, what gives None on entry."""
    return nullcontext() if path is None else Journal(path, identity)


class Journal:
    """The records of one computation, in a file that nothing else writes to meanwhile.

    A context manager: on entry the file is opened, locked and checked, or made with its folders.

    Parameters
    ----------
    path : path-like
        A file that is not this computation's journal is refused, never overwritten.
    identity : mapping of str to JSON values
        Everything that the records depend on: a journal with another identity is refused.

    Attributes
    ----------
    path : Path
    last : dict or None
        The last record that was there on entry.
    dropped : int
        Lines cut off on entry because they, or one before them, were damaged; a warning says so.

    Raises
    ------
    CheckpointError
        On entry, where the file cannot be used.
    """

    def __init__(self, path: str | os.PathLike[str], identity: Mapping[str, object]):
        if not isinstance(path, str | os.PathLike) or not os.fspath(path):
            raise TypeError(f"checkpoint must be the path of a file, got {path!r}")
        self.path = Path(path)
        self.last: dict | None = None
        self.dropped = 0
        self._header = _line({"format": FORMAT, "identity": dict(identity), "journal": "robsmooth"})
        self._file: int | None = None
        self._end = 0  # of the last whole line
        self._found = 0  # where that was on entry

    def __enter__(self) -> "Journal":
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
            self._lock()
            self._read_header()
            self._read_records()
        except OSError as error:
            self._close()
            raise CheckpointError(
                f"the checkpoint {self.path} cannot be opened: {error.strerror or error}; give "
                "another path"
            ) from None
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *_) -> None:
        self._close()

    @property
    def records(self) -> list[dict]:
        """The records that were there on entry, in order; read anew from the file each time."""
        with self._reader(len(self._header)) as file:
            return [_parse(line) for line in file.read(self._found - file.tell()).splitlines(True)]

    def append(self, record: Mapping[str, object]) -> None:
        """Add a record of JSON values; it is on the disk on return. Floats keep every bit.

        Raises
        ------
        OSError
            Where it cannot be written, as on a full disk. The records before it are kept.
        """
        self._check_open()
        line = _line(dict(record))
        try:
            self._write(line)
        except OSError as error:
            reason = FULL.get(error.errno, f"writing fails, {error.strerror}")
            raise OSError(
                error.errno,
                f"the checkpoint {self.path} takes no more: {reason}; what it held before is kept, "
                "and the same run resumes from it once that is mended",
            ) from None

    def _check_open(self) -> None:
        if self._file is None:
            raise ValueError(f"the checkpoint {self.path} is not open: use it in a with statement")

    def _lock(self) -> None:
        if not stat.S_ISREG(os.fstat(self._file).st_mode):
            raise CheckpointError(f"{self.path} is not a regular file: give another path")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CheckpointError(
                f"the checkpoint {self.path} is in use by another run: wait until that ends, or "
                "give another path"
            ) from None

    def _read_header(self) -> None:
        with self._reader() as file:
            first = file.readline(LONGEST_HEADER)
        if first == self._header:
            self._end = len(first)
        elif self._header.startswith(first):  # a new file, or one whose creation a crash cut short
            self._write(self._header)
            _sync_folder(self.path.parent)
        else:
            raise CheckpointError(self._refusal(first))

    def _refusal(self, first: bytes) -> str:
        """Why a file with another header is refused."""
        there, here = _parse(first), _parse(self._header)
        if there is None or there.get("journal") != here["journal"]:
            return (
                f"{self.path} is not a checkpoint, or its first line is damaged: give another "
                "path, or delete the file"
            )
        if there["format"] != FORMAT:
            return (
                f"the checkpoint {self.path} has format {there['format']}, and this version of "
                f"robsmooth reads format {FORMAT}: give another path, or delete the file"
            )
        there, here = dict(_items(there["identity"])), dict(_items(here["identity"]))
        differences = "; ".join(
            f"{name} is {_shown(there, name)} there and {_shown(here, name)} here"
            for name in sorted(there | here)
            if _text(there.get(name)) != _text(here.get(name)) or (name in there) != (name in here)
        )
        return (
            f"the checkpoint {self.path} is of another computation: {differences}; give another "
            "path, or delete the file to start anew"
        )

    def _read_records(self) -> None:
        count = 0
        with self._reader(self._end) as file:
            for line in file:
                record = _parse(line)
                if record is None:
                    self.dropped = 1 + sum(1 for _ in file)
                    break
                self.last = record
                self._end += len(line)
                count += 1
        self._found = self._end
        if self.dropped:
            warnings.warn(
                f"the checkpoint {self.path} was damaged, as when a run is ended while it writes: "
                f"{self.dropped} line(s) after record {count} are cut off, and what they held is "
                "computed again",
                RuntimeWarning,
                stacklevel=3,
            )
            os.ftruncate(self._file, self._end)
            os.fsync(self._file)

    @contextmanager
    def _reader(self, start: int = 0) -> Iterator[BinaryIO]:
        self._check_open()
        with open(self._file, "rb", closefd=False) as file:
            file.seek(start)
            yield file

    def _write(self, line: bytes) -> None:
        done = 0
        try:
            # Always from the end of the last whole line: over what a failure may have left there.
            while done < len(line):
                done += os.pwrite(self._file, line[done:], self._end + done)
            os.fsync(self._file)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._file, self._end)
            raise
        self._end += done

    def _close(self) -> None:
        if self._file is not None:
            os.close(self._file)  # releases the lock
            self._file = None


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False)


def _line(value: dict) -> bytes:
    text = _text(value).encode() + b"\n"
    return _checksum(text) + b" " + text


def _parse(line: bytes) -> dict | None:
    """The value of a line, or None where the line is not whole."""
    checksum, _, text = line.partition(b" ")
    whole = text.endswith(b"\n") and checksum == _checksum(text)
    return json.loads(text) if whole else None


def _checksum(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:16].encode()


def _items(identity: Mapping, prefix: str = "") -> Iterator[tuple[str, object]]:
    """The items of a mapping, those of the mappings in it under dotted names."""
    for name, value in identity.items():
        if isinstance(value, Mapping) and value:
            yield from _items(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _shown(identity: Mapping, name: str) -> str:
    """The value of an item for a message: short, and both ends of a long one."""
    if name not in identity:
        return "absent"
    text = _text(identity[name])
    return text if len(text) <= LONGEST_SHOWN else f"{text[:16]}...{text[-8:]}"


def _sync_folder(path: Path) -> None:
    """Make sure that a new file in a folder is still there after a power failure."""
    with suppress(OSError):  # not every file system can
        folder = os.open(path, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
