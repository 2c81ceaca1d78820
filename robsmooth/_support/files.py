"""Files that are written whole or not at all, and locks."""

import json
import os
import secrets
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: str | os.PathLike[str], kept: str = "") -> Iterator[Path]:
    """Yield a path beside `path` to write to; on success the file there, on disk, replaces `path`.

    After a failure `path` is as it was, and the temporary file is removed, unless it is `kept`
    under the path with this suffix. Symbolic links and permissions are preserved.
    """
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    name = path.name + kept if kept else f".{path.stem}.{secrets.token_hex(4)}{path.suffix}"
    temporary = path.with_name(name)
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, temporary)
        os.replace(temporary, path)
    except BaseException:
        if not kept:
            temporary.unlink(missing_ok=True)
        raise


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` to `path` as UTF-8 with its line ends as they are, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode())


def write_json(path: str | os.PathLike[str], value: object) -> None:
    """Write `value` as readable JSON; numbers are finite."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


@contextmanager
def exclusive_lock(path: str | os.PathLike) -> Iterator[sqlite3.Connection]:
    """Open the SQLite database at a path, or make it with its folders, and lock it.

    The lock ends with the process at the latest. This process must not open the file again: on
    POSIX systems the lock ends when that is closed. BlockingIOError where the file is locked,
    sqlite3.Error where it cannot be opened or has other content.
    """
    path = Path(path).absolute()  # ":memory:" is the name of a file, too
    path.parent.mkdir(parents=True, exist_ok=True)
    with closing(sqlite3.connect(path, timeout=0, isolation_level=None)) as connection:
        try:
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")  # until it is closed
            connection.execute("BEGIN EXCLUSIVE")
            connection.execute("ROLLBACK")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise
            message = f"{path} is in use by another run: wait until that ends"
            raise BlockingIOError(message) from None
        yield connection
