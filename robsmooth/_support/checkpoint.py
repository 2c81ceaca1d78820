"""A checkpoint: a file of records, from which a long computation resumes.

The file is an SQLite database with one table. Record 0 is the identity of the computation. Each
record has a checksum, because SQLite does not notice a changed bit in a value. SQLite's rollback
journal makes a record whole or absent. The write-ahead log would need memory that processes share;
two machines of a network file system share none.
"""

import hashlib
import json
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from robsmooth._support import files

APPLICATION = int.from_bytes(b"rsmo", "big")  # SQLite's mark of the program that made a database
ANEW = "give another path, or delete the file to start anew"
NOT_ONE = "{} is not a checkpoint of this version of robsmooth: give another path"


class CheckpointError(ValueError):
    """A file cannot be this computation's checkpoint; it is left as it was."""


@contextmanager
def open_journal(
    path: str | os.PathLike[str] | None, identity: Mapping[str, object]
) -> "Iterator[Journal | None]":
    """Open or make a computation's journal, with its folders; without a path, give None.

    The identity is all that the records depend on. Another file raises a CheckpointError and stays.
    """
    if path is None:
        yield None
        return
    if not isinstance(path, str | os.PathLike) or not os.fspath(path):
        raise TypeError(f"checkpoint must be the path of a file, got {path!r}")
    path = Path(path)
    with ExitStack() as stack:
        try:
            # SQLite would take a file of one byte for an empty database.
            if path.exists() and (not path.is_file() or path.stat().st_size == 1):
                raise CheckpointError(NOT_ONE.format(path))
            database = stack.enter_context(files.exclusive_lock(path))
            journal = Journal(path, database, dict(identity))
        except BlockingIOError as error:
            raise CheckpointError(f"the checkpoint {error}, or give another path") from None
        except (OSError, sqlite3.Error, UnicodeDecodeError) as error:  # the last: of damaged SQL
            if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_NOTADB:
                raise CheckpointError(NOT_ONE.format(path)) from None
            what = f"cannot be opened: {getattr(error, 'strerror', None) or error}; {ANEW}"
            raise CheckpointError(f"the checkpoint {path} {what}") from None
        yield journal


class Journal:
    """The records of one computation, in a file that is locked."""

    def __init__(self, path: Path, database: sqlite3.Connection, identity: dict):
        self.path = path
        self._database = database
        # Damaged text is read, too: it fails its checksum.
        database.text_factory = lambda text: text.decode(errors="replace")
        is_new = path.stat().st_size == 0
        if not is_new and self._value("PRAGMA application_id") != APPLICATION:
            raise CheckpointError(NOT_ONE.format(path))
        database.execute("PRAGMA journal_mode = DELETE")
        database.execute("PRAGMA synchronous = FULL")
        database.execute("PRAGMA fullfsync = ON")  # on macOS: past the cache of the disk
        if is_new:
            database.execute("BEGIN")
            database.execute(f"PRAGMA application_id = {APPLICATION}")
            database.execute("CREATE TABLE record (number INTEGER PRIMARY KEY, checksum, text)")
            self._insert(0, identity)
            database.execute("COMMIT")
        if self._value("PRAGMA quick_check(1)") != "ok":
            raise sqlite3.DatabaseError("database disk image is malformed")
        there, here = _texts(self._read(0)), _texts(identity)
        differences = [
            f"{name} is {_short(there.get(name))} there and {_short(here.get(name))} here"
            for name in sorted(there | here)
            if there.get(name) != here.get(name)
        ]
        if differences:
            what = f"is of another computation: {'; '.join(differences)}"
            raise CheckpointError(f"the checkpoint {path} {what}; {ANEW}")
        # The number of records on opening, and the last of them.
        self._found = self._value("SELECT max(number) FROM record")
        self.last = self._read(self._found) if self._found else None

    def records(self) -> Iterator[dict]:
        """Yield the records that there were on opening, in order; only one is in memory."""
        yield from map(self._read, range(1, self._found + 1))

    def append(self, record: Mapping[str, object]) -> None:
        """Add a record of JSON values: it is on the disk on return. OSError where it cannot be."""
        try:
            self._insert(self._value("SELECT max(number) + 1 FROM record"), dict(record))
        except sqlite3.Error as error:
            advice = "what it held before is kept: mend that, and the same run resumes from it"
            what = f"takes no more, as where the disk is full: {error}; {advice}"
            raise OSError(f"the checkpoint {self.path} {what}") from None

    def _insert(self, number: int, record: dict) -> None:
        text = _text(record)
        row = (number, _checksum(number, text), text)
        self._database.execute("INSERT INTO record VALUES (?, ?, ?)", row)

    def _read(self, number: int) -> dict:
        query = "SELECT checksum, text FROM record WHERE number = ?"
        checksum, text = self._database.execute(query, (number,)).fetchone() or (None, None)
        if checksum != _checksum(number, text):
            what = f"record {number} of the checkpoint {self.path} is damaged"
            raise CheckpointError(f"{what}: {ANEW}")
        return json.loads(text)

    def _value(self, query: str) -> object:
        return self._database.execute(query).fetchone()[0]


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False)


def _checksum(number: int, text: str | None) -> str:
    return hashlib.sha256(f"{number} {text}".encode()).hexdigest()[:16]


def _texts(identity: Mapping, prefix: str = "") -> dict[str, str]:
    """Return the items of a mapping as JSON; those of inner mappings have dotted names."""
    texts = {}
    for name, value in identity.items():
        inner = isinstance(value, Mapping) and value
        texts |= _texts(value, f"{prefix}{name}.") if inner else {prefix + name: _text(value)}
    return texts


def _short(text: str | None) -> str:
    """Return both ends of a long text."""
    text = "absent" if text is None else text
    return text if len(text) <= 40 else f"{text[:16]}...{text[-8:]}"
