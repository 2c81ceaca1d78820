"""Checkpoints, for the tests of what writes them: how many records are there, and a full disk."""

import resource
import sqlite3
from contextlib import closing, contextmanager


def records(path):
    """Number of records in a checkpoint that nothing has open; 0 where there is none yet."""
    if not path.exists():
        return 0
    with closing(sqlite3.connect(path)) as database:
        return database.execute("SELECT max(number) FROM record").fetchone()[0]


@contextmanager
def largest_file(size):
    """A limit that holds for the files of this process, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
