import json
import os
import sqlite3
import subprocess
import sys

import numpy as np
import pytest

from robsmooth._support import files


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "new folder" / "figure.svg"
    files.write_text(path, "old")
    with files.atomic_path(path) as temporary:
        assert temporary.parent == path.parent
        assert temporary.suffix == path.suffix
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(path.parent) == ["figure.svg"]


def test_a_link_stays_a_link_and_permissions_are_kept(tmp_path):
    path, link = tmp_path / "there" / "result.json", tmp_path / "link.json"
    files.write_text(path, "old")
    path.chmod(0o600)
    link.symlink_to("there/result.json")
    files.write_text(link, "new")
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o600
    assert os.listdir(path.parent) == ["result.json"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "result.json"
    files.write_text(path, "old")
    with pytest.raises(error), files.atomic_path(path) as temporary:
        temporary.write_bytes(b"ne")
        raise error
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["result.json"]


def test_a_block_that_writes_nothing_is_an_error_and_leaves_the_old_file(tmp_path):
    path = tmp_path / "result.json"
    files.write_text(path, "old")
    with pytest.raises(FileNotFoundError), files.atomic_path(path):
        pass
    assert path.read_bytes() == b"old"


def test_json_keeps_order_and_values(tmp_path):
    path = tmp_path / "result.json"
    value = {"b": np.float64(0.1), "a": [0, 1, 2], "runs": 5, "λ": True}
    files.write_json(path, value)
    text = path.read_text(encoding="utf-8")
    assert text.endswith("}\n")
    assert list(json.loads(text)) == ["b", "a", "runs", "λ"]
    assert json.loads(text) == {"b": 0.1, "a": [0, 1, 2], "runs": 5, "λ": True}


@pytest.mark.parametrize("value", [float("nan"), np.inf, [1.0, np.nan]])
def test_json_refuses_what_is_not_finite(tmp_path, value):
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.write_json(tmp_path / "result.json", {"value": value})
    assert not os.listdir(tmp_path)


def test_json_names_a_type_it_cannot_write(tmp_path):
    with pytest.raises(TypeError, match="type set is not JSON serializable"):
        files.write_json(tmp_path / "result.json", {1, 2})


# --- a lock ---------------------------------------------------------------------------------------

# Whatever has SQLite can ask for the lock; this starts faster than a program that imports the room.
LOCK = """
import sqlite3, sys
lock = sqlite3.connect(sys.argv[1], timeout=0, isolation_level=None)
lock.execute("BEGIN EXCLUSIVE")
print("locked", flush=True)
sys.stdin.read()
"""


def another_process(path):
    return subprocess.Popen(
        [sys.executable, "-c", LOCK, path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_one_has_the_lock_and_the_file_stays_empty(tmp_path):
    path = tmp_path / "lock"
    for _ in range(2):
        with files.exclusive_lock(path):
            for _ in range(2):  # being refused in this process takes nothing from the lock
                with pytest.raises(BlockingIOError), files.exclusive_lock(path):
                    pass
                _, refusal = another_process(path).communicate()
                assert "database is locked" in refusal
    assert os.listdir(tmp_path) == ["lock"]
    assert path.read_bytes() == b""


def test_a_process_that_is_killed_leaves_the_lock_to_others(tmp_path):
    path = tmp_path / "lock"
    with another_process(path) as other:
        assert other.stdout.readline() == "locked\n"
        with pytest.raises(BlockingIOError), files.exclusive_lock(path):
            pass
        other.kill()
    with files.exclusive_lock(path):
        pass


def test_a_file_that_cannot_be_locked_is_an_error(tmp_path):
    with pytest.raises(sqlite3.Error, match="unable to open"), files.exclusive_lock(tmp_path):
        pass
    notes = tmp_path / "notes.txt"
    notes.write_text("of a user\n")
    with pytest.raises(sqlite3.DatabaseError), files.exclusive_lock(notes):
        pass
    assert notes.read_text() == "of a user\n"
