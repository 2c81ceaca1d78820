"""A checkpoint: a file of records, from which a long computation resumes.

The file is an SQLite database with one table. Record 0 is the identity of the computation. Each
record has a checksum, because SQLite does not notice a changed bit in a value. SQLite's rollback
journal makes a record whole or absent. The write-ahead log would need memory that processes share;
two machines of a network file system share none.
"""

import hashlib
import itertools
import json
import os
import sqlite3
import warnings
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path

from robsmooth._support import files, validation

APPLICATION = int.from_bytes(b"rsmo", "big")  # SQLite's mark of the program that made a database
_decoded = partial(str, encoding="utf-8", errors="replace")  # a damaged text fails its checksum
ANEW = "give another path, or delete the file to start anew"
_TABLE = "CREATE TABLE record (number INTEGER PRIMARY KEY, checksum, text)"
# Other SQL in a file could change or hide records, or have no end.
_FOREIGN = f"SELECT application_id != {APPLICATION} OR EXISTS (SELECT * FROM sqlite_master "
_FOREIGN += f"WHERE sql IS NOT '{_TABLE}') FROM pragma_application_id"
NOT_ONE = "{} is not a checkpoint of this version of robsmooth: give another path"
_text = partial(json.dumps, sort_keys=True, ensure_ascii=False)
OF_DAMAGE = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR, sqlite3.SQLITE_TOOBIG}


class CheckpointError(ValueError):
    """A file cannot be this computation's checkpoint; it is left as it was."""


@contextmanager
def open_journal(
    path: str | os.PathLike[str] | None, identity: Mapping[str, object]
) -> "Iterator[Journal | None]":
    """Open or make a computation's journal, with its folders; without a path, give None.

    The identity is all that the records depend on. Another file raises a CheckpointError and stays.
    A damaged file is renamed, with a warning, and a new one begins with its whole records.
    """
    if path is None:
        yield None
        return
    path, identity = validation.path("checkpoint", path).absolute(), _text(dict(identity))
    with ExitStack() as stack:
        try:
            # SQLite would take a file of one byte for an empty database.
            if path.exists() and (not path.is_file() or path.stat().st_size == 1):
                raise CheckpointError(NOT_ONE.format(path))
            try:
                journal = Journal(path, stack.enter_context(files.exclusive_lock(path)), identity)
            except (sqlite3.DatabaseError, UnicodeDecodeError) as error:  # the last: of damaged SQL
                if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) not in OF_DAMAGE:
                    raise
                stack.close()
                aside, records = _set_aside(path, identity)
                database = stack.enter_context(files.exclusive_lock(path))
                journal = Journal(path, database, identity, *records)
                what = f"is now {aside}: {len(records)} of its records are whole, and kept here"
                warnings.warn(f"the checkpoint {path} was damaged, and {what}", stacklevel=4)
        except BlockingIOError as error:
            raise CheckpointError(f"the checkpoint {error}, or give another path") from None
        except (OSError, sqlite3.Error) as error:
            if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_NOTADB:
                raise CheckpointError(NOT_ONE.format(path)) from None
            what = f"cannot be opened: {getattr(error, 'strerror', None) or error}; {ANEW}"
            raise CheckpointError(f"the checkpoint {path} {what}") from None
        yield journal


class Journal:
    """The records of one computation, in a file that is locked; a new one begins with `records`."""

    def __init__(self, path: Path, database: sqlite3.Connection, identity: str, *records: str):
        self.path, self._file = path, path.stat()
        self._database, self._identity = database, identity
        database.text_factory = _decoded
        is_new = self._file.st_size == 0
        if not is_new and self._value(_FOREIGN):
            raise CheckpointError(NOT_ONE.format(path))
        database.execute("PRAGMA journal_mode = DELETE")
        database.execute("PRAGMA synchronous = FULL")
        database.execute("PRAGMA fullfsync = ON")  # on macOS: past the cache of the disk
        if is_new:
            database.execute("BEGIN")
            database.execute(f"PRAGMA application_id = {APPLICATION}")
            database.execute(_TABLE)
            for number, text in enumerate([identity, *records]):
                self._insert(number, text)
            database.execute("COMMIT")
        there, here = (_texts(json.loads(text)) for text in (self._whole(0), identity))
        if found := validation.differences("{} is {} there and {} here", there, here):
            what = f"is of another computation: {validation.line('; '.join(found), 400)}"
            raise CheckpointError(f"the checkpoint {path} {what}; {ANEW}")
        # The number of records on opening, and the last of them.
        self._found = self._value("SELECT max(number) FROM record")
        texts = map(self._whole, range(1, self._found + 1))
        self.last = json.loads(deque(texts, maxlen=1).pop()) if self._found else None
        if self._value("PRAGMA quick_check(1)") != "ok":
            raise sqlite3.DatabaseError("database disk image is malformed")

    def records(self) -> Iterator[dict]:
        """Yield the records that there were on opening, in order; only one is in memory."""
        yield from map(json.loads, map(self._whole, range(1, self._found + 1)))

    def append(self, record: Mapping[str, object]) -> None:
        """Add a record of JSON values: it is on the disk on return. OSError where it cannot be."""
        if not (self.path.exists() and os.path.samestat(self.path.stat(), self._file)):
            what = "was removed or replaced while this run used it"
            raise OSError(f"the checkpoint {self.path} {what}: leave it in place until the end")
        text = _text(dict(record))
        try:
            self._insert(self._value("SELECT max(number) + 1 FROM record"), text)
        except sqlite3.Error as error:
            advice = "what it held before is kept: mend that, and the same run resumes from it"
            what = f"takes no more, as where the disk is full: {error}; {advice}"
            raise OSError(f"the checkpoint {self.path} {what}") from None

    def _insert(self, number: int, text: str) -> None:
        row = (number, _checksum(number, text, self._identity), text)
        self._database.execute("INSERT INTO record VALUES (?, ?, ?)", row)

    def _whole(self, number: int) -> str:
        query = "SELECT * FROM record WHERE number = ?"
        text = _whole(self._database.execute(query, (number,)).fetchone(), self._identity)
        if text is None:
            raise sqlite3.DatabaseError(f"record {number} is damaged")
        return text

    def _value(self, query: str) -> object:
        return self._database.execute(query).fetchone()[0]


def _set_aside(path: Path, identity: str) -> tuple[Path, list[str]]:
    """Rename a damaged checkpoint; return its new path and the whole records of a computation."""
    records = {}
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.text_factory = _decoded
        database.execute("PRAGMA writable_schema = ON")  # reads a file that was cut off, too
        if database.execute(_FOREIGN).fetchone()[0]:
            raise CheckpointError(NOT_ONE.format(path))
        for order in ("ASC", "DESC"):  # from both ends up to what cannot be read
            with suppress(sqlite3.Error, UnicodeDecodeError):
                for row in database.execute(f"SELECT * FROM record ORDER BY number {order}"):
                    records[row[0]] = _whole(row, identity)
    names = (path.with_name(f"{path.name}.damaged-{number}") for number in itertools.count(1))
    aside = path.rename(next(name for name in names if not name.exists()))
    return aside, [text for number, text in sorted(records.items()) if number and text]


def _whole(row: tuple | None, identity: str) -> str | None:
    """Return a record's text as it was written, with this number and identity, or None."""
    number, checksum, text = row or (0, None, None)
    return text if checksum == _checksum(number, text, identity) else None


def _checksum(number: int, text: str | None, identity: str) -> str:
    content = f"{number} {identity if number else ''} {text}"
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def _texts(identity: Mapping, prefix: str = "") -> dict[str, str]:
    """Return the items of a mapping as JSON; those of inner mappings have dotted names."""
    texts = {}
    for name, value in identity.items():
        inner = isinstance(value, Mapping) and value
        texts |= _texts(value, f"{prefix}{name}.") if inner else {prefix + name: _text(value)}
    return texts
