import math
import os
import random
import re
import sqlite3
import subprocess
import sys
import textwrap
import tracemalloc
import warnings
from contextlib import closing

import pytest

from robsmooth._support.checkpoint import CheckpointError, open_journal
from tests.helpers.checkpoints import largest_file
from tests.helpers.waiting import PATIENCE

IDENTITY = {"seed": 1, "parameters": {"kappa": 0.1, "beta": 1e-300}, "digest": "ab" * 32}
RECORDS = [{"block": 1, "mean": 0.1 + 0.2}, {"block": 2, "word": "λ\n"}, {"block": 3, "a": [1.0]}]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.journal"


def write(path, records=RECORDS, identity=IDENTITY):
    with open_journal(path, identity) as journal:
        for record in records:
            journal.append(record)


def read(path, identity=IDENTITY):
    with open_journal(path, identity) as journal:
        return list(journal.records())


def run(source, *arguments):
    """Run a program that finds `open_journal` imported."""
    program = (
        "import os, sys\nfrom robsmooth._support.checkpoint import open_journal\n"
        + textwrap.dedent(source)
    )
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)


# --- records --------------------------------------------------------------------------------------


def test_records_come_back_in_order_and_more_can_follow(path):
    write(path)
    with open_journal(path, IDENTITY) as journal:
        assert list(journal.records()) == RECORDS
        assert journal.last == RECORDS[-1]
        found = journal.records()
        assert next(found) == RECORDS[0]
        journal.append({"block": 4})
        assert list(found) == RECORDS[1:], "records are those found on opening"
    assert read(path) == [*RECORDS, {"block": 4}]


def test_a_new_journal_is_empty_and_has_its_folders_made(tmp_path):
    path = tmp_path / "new" / "folder" / "run.journal"
    with open_journal(path, IDENTITY) as journal:
        assert (list(journal.records()), journal.last) == ([], None)
    assert read(path) == []


def test_without_a_path_there_is_no_journal():
    with open_journal(None, IDENTITY) as journal:
        assert journal is None


def test_floats_keep_every_bit(path):
    draw = random.Random(0)
    values = [draw.uniform(-1, 1) * 10.0 ** draw.randint(-320, 300) for _ in range(500)]
    values += [-0.0, 5e-324, sys.float_info.max, math.inf, -math.inf, 0.1]
    write(path, [{"values": values}, {"nothing": math.nan}])
    first, second = read(path)
    assert [value.hex() for value in first["values"]] == [value.hex() for value in values]
    assert math.isnan(second["nothing"])


def test_a_record_without_a_json_form_is_refused_and_leaves_no_trace(path):
    with open_journal(path, IDENTITY) as journal:
        with pytest.raises(TypeError, match="set is not JSON serializable"):
            journal.append({"value": {1}})
        journal.append({"value": 1})
    assert read(path) == [{"value": 1}]


def test_reading_many_records_takes_the_memory_of_one(path):
    write(path)
    size = 10_000
    with open_journal(path, IDENTITY) as journal:
        journal._database.execute("BEGIN")  # to be quick
        for _ in range(2_000):
            journal.append({"text": "x" * size})
        journal._database.execute("COMMIT")
    tracemalloc.start()
    with open_journal(path, IDENTITY) as journal:
        assert sum(len(record.get("text", "")) for record in journal.records()) == 2_000 * size
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 100 * size


# --- damage ---------------------------------------------------------------------------------------


def test_a_record_is_written_through_to_the_disk(path):
    with open_journal(path, IDENTITY) as journal:
        settings = {
            name: journal._database.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("journal_mode", "synchronous", "locking_mode")
        }
    full = 2
    assert settings == {"journal_mode": "delete", "synchronous": full, "locking_mode": "exclusive"}


def test_no_kill_loses_a_record_that_append_has_returned_from(path):
    """Ten times a process appends without end and is killed at a moment of no choosing."""
    ended = run(
        """
        import random, signal, time
        draw, acknowledged = random.Random(0), 0
        for _ in range(10):
            reading, writing = os.pipe()
            if (child := os.fork()) == 0:
                with open_journal(sys.argv[1], {}) as journal:
                    number = journal.last["number"] if journal.last else 0
                    while True:
                        number += 1
                        journal.append({"number": number, "text": "x" * random.randint(0, 9000)})
                        os.write(writing, b".")
            os.close(writing)
            for _ in range(draw.randint(1, 20)):
                assert os.read(reading, 1)
            time.sleep(draw.uniform(0, 0.01))
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            with os.fdopen(reading, "rb") as rest, open_journal(sys.argv[1], {}) as journal:
                before, numbers = acknowledged, [each["number"] for each in journal.records()]
                acknowledged = len(numbers)
                assert numbers == list(range(1, acknowledged + 1))
                print(acknowledged - before)
        """,
        path,
    )
    assert ended.returncode == 0, ended.stderr
    assert len(ended.stdout.split()) == 10
    assert len(read(path, {})) == sum(map(int, ended.stdout.split())) >= 10


def test_no_single_flipped_bit_passes_for_a_record(path):
    write(path)
    whole = path.read_bytes()
    used = [position for position, byte in enumerate(whole) if byte]
    for position in [*used, *range(0, len(whole), 97)]:
        damaged = bytearray(whole)
        damaged[position] ^= 1 << position % 8
        read_damaged(path, bytes(damaged))


def read_damaged(path, content):
    """Read a damaged file; return whether it was refused, set aside or read as if it were whole."""
    path.write_bytes(content)
    aside = path.with_name(f"{path.name}.damaged-1")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = read(path)
        except CheckpointError as error:
            assert "\n" not in str(error)
            assert path.read_bytes() == content
            return "refused"
    if not caught:
        assert found == RECORDS
        return "read"
    assert f"was damaged, and is now {aside}: {len(found)} of its" in str(caught[0].message)
    assert [each for each in RECORDS if each in found] == found
    assert aside.read_bytes() == content
    assert read(path) == found, "the new file is whole"
    aside.unlink()
    return "set aside"


def test_a_file_that_is_cut_off_or_overwritten_is_kept(path):
    write(path)
    whole = path.read_bytes()
    damaged = [whole[:size] for size in range(1, len(whole), 1000)]
    damaged += [whole[:size] + b"\xff" * 1000 + whole[size + 1000 :] for size in (0, 3500, 7192)]
    found = [read_damaged(path, content) for content in damaged]
    assert set(found) == {"refused", "set aside"}


def test_a_damaged_record_in_the_middle_leaves_the_others(path):
    write(path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE record SET text = replace(text, 'word', 'work') WHERE number = 2")
    with pytest.warns(UserWarning, match="2 of its records are whole"):
        assert read(path) == [RECORDS[0], RECORDS[2]]


def test_two_records_that_were_swapped_are_no_records(path):
    write(path)
    with closing(sqlite3.connect(path)) as database, database:
        for old, new in ((1, 9), (3, 1), (9, 3)):
            database.execute("UPDATE record SET number = ? WHERE number = ?", (new, old))
    with pytest.warns(UserWarning, match="1 of its records are whole"):
        assert read(path) == [RECORDS[1]]


@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_that_is_taken_away_while_in_use_is_noticed(path, replaced):
    with open_journal(path, IDENTITY) as journal:
        journal.append(RECORDS[0])
        path.rename(path.with_name("other"))
        if replaced:
            path.write_bytes(b"other")
        with pytest.raises(OSError, match="was removed or replaced while this run used it"):
            journal.append(RECORDS[1])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_forked_process_does_not_keep_the_lock(path):
    with open_journal(path, IDENTITY):
        ended, end = os.pipe()
        if (child := os.fork()) == 0:
            os.close(end)
            os.read(ended, 1)
            os._exit(0)
    try:
        assert read(path) == []
    finally:
        os.close(end)
        os.waitpid(child, 0)


def test_garbage_behind_the_end_is_no_part_of_the_file(path):
    write(path)
    with open(path, "ab") as file:
        file.write(b"\xff" * 5000)
    with open_journal(path, IDENTITY) as journal:
        assert list(journal.records()) == RECORDS
        journal.append({"text": "x" * 20_000})
    assert read(path) == [*RECORDS, {"text": "x" * 20_000}]


# --- files that are refused -----------------------------------------------------------------------


def test_another_identity_is_refused_and_each_difference_named(path):
    write(path)
    before = path.read_bytes()
    other = {"seed": 2, "parameters": {"kappa": 0.1, "beta": 0.5}, "digest": "cd" * 32, "new": None}
    with pytest.raises(CheckpointError) as caught:
        read(path, other)
    message = str(caught.value)
    assert "of another computation" in message
    assert "seed is 1 there and 2 here" in message
    assert "parameters.beta is 1e-300 there and 0.5 here" in message
    assert "new is absent there and null here" in message
    assert re.search(r'digest is "abab\w*\.\.\.\w*" there and "cdcd\w*\.\.\.\w*" here', message)
    assert "kappa" not in message
    assert message.endswith("give another path, or delete the file to start anew")
    assert path.read_bytes() == before


def test_the_order_of_the_identity_does_not_matter(path):
    write(path)
    assert read(path, dict(reversed(IDENTITY.items()))) == RECORDS


@pytest.mark.parametrize(
    "content",
    [b"a user's notes\n", b"no end of line", b"\n", b"\x80\n", b"\x80\n" * 300, b"a\0" * 2_000_000],
)
def test_a_file_that_is_no_journal_is_refused_and_kept(path, content):
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        read(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("mode", ["DELETE", "WAL"])
def test_the_database_of_another_program_is_refused_and_kept(path, mode):
    with closing(sqlite3.connect(path)) as database:
        database.execute(f"PRAGMA journal_mode = {mode}")
        database.execute("CREATE TABLE record (number INTEGER PRIMARY KEY, checksum, text)")
    content = path.read_bytes()
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        read(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "sql",
    [
        "CREATE TRIGGER t AFTER INSERT ON record BEGIN DELETE FROM record; END",
        """DROP TABLE record; CREATE VIEW record AS WITH RECURSIVE endless(number) AS
           (SELECT 1 UNION ALL SELECT number + 1 FROM endless) SELECT number, 1, 2 FROM endless""",
        """DROP TABLE record; CREATE TABLE record (number INTEGER PRIMARY KEY, checksum, text,
           hidden AS (NULL) NOT NULL ON CONFLICT IGNORE)""",
        "CREATE INDEX other ON record (text)",
    ],
    ids=["trigger", "endless view", "silent constraint", "index"],
)
@pytest.mark.parametrize("is_damaged", [False, True])
def test_a_checkpoint_with_sql_of_its_own_is_refused_and_kept(path, sql, is_damaged):
    write(path)
    with closing(sqlite3.connect(path)) as database:
        database.executescript(sql)
        if is_damaged:
            database.executescript(
                "PRAGMA writable_schema = ON; INSERT INTO sqlite_master VALUES ('table', 'x', 'x', "
                "9, 'CREATE TABLE')"
            )
    content = path.read_bytes()
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        read(path)
    assert path.read_bytes() == content


def test_many_differences_are_one_sentence_that_can_be_read(path):
    write(path)
    with pytest.raises(CheckpointError, match=r"\.\.\.; give another path") as caught:
        read(path, {f"number_{i}": i for i in range(100)})
    assert len(str(caught.value)) - len(str(path)) < 550


def test_a_checkpoint_of_an_older_version_is_refused_and_kept(path):
    content = b'0123456789abcdef {"format": 1, "identity": {}, "journal": "robsmooth"}\n'
    path.write_bytes(content)
    with pytest.raises(
        CheckpointError, match="not a checkpoint of this version of robsmooth: give another"
    ):
        read(path)
    assert path.read_bytes() == content


def test_two_runs_cannot_use_one_journal(path):
    with open_journal(path, IDENTITY) as journal:
        with pytest.raises(CheckpointError, match="in use by another run"):
            read(path)
        ended = run("with open_journal(sys.argv[1], {}): pass", path)
        assert "in use by another run: wait until that ends" in ended.stderr.splitlines()[-1]
        journal.append({"block": 1})
    assert read(path) == [{"block": 1}]


def test_a_journal_that_was_half_read_or_refused_is_free_for_others(path):
    write(path)
    with open_journal(path, IDENTITY) as journal:
        half_read = journal.records()
        next(half_read)
    with pytest.raises(CheckpointError) as refused:
        read(path, {})
    program = """
import sqlite3, sys
sqlite3.connect(sys.argv[1], timeout=0).execute("BEGIN EXCLUSIVE")
"""
    subprocess.run([sys.executable, "-c", program, path], check=True)
    assert half_read and refused, "both are still there"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (".", "not a checkpoint"),
        ("file/run.journal", "cannot be opened: (File exists|Not a directory)"),
        ("file/folder/run.journal", "cannot be opened: (File exists|Not a directory)"),
        ("a" * 300, "cannot be opened: (File name too long|unable to open database file)"),
    ],
)
def test_a_path_that_no_file_can_have_is_one_clear_error(tmp_path, name, reason):
    (tmp_path / "file").write_text("here")
    with pytest.raises(CheckpointError, match=f"{reason}.*[:;] give another path"):
        read(tmp_path / name)


def test_what_is_not_a_regular_file_is_refused(path):
    os.mkfifo(path)
    for other in (path, "/dev/null"):
        with pytest.raises(CheckpointError, match="not a checkpoint"):
            read(other)


def test_a_name_that_means_something_to_sqlite_is_that_of_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(":memory:")
    assert read(":memory:") == RECORDS


@pytest.mark.parametrize("path", [3, "", True])
def test_what_is_no_path_is_refused(path):
    with pytest.raises(TypeError, match=r"checkpoint must be the path of a file, got (3|''|T)"):
        read(path)


# --- full disk ------------------------------------------------------------------------------------


def test_a_full_disk_keeps_what_was_written(path):
    blocks = []
    with (
        open_journal(path, IDENTITY) as journal,
        largest_file(40_000),
        pytest.raises(OSError, match=r"takes no more, as where the disk is full: .* is kept"),
    ):
        for block in range(100):
            journal.append({"block": block, "text": "x" * 1000})
            blocks.append(block)
    assert [record["block"] for record in read(path)] == blocks
    assert len(blocks) > 10


def test_writing_goes_on_after_room_was_made(path):
    with open_journal(path, IDENTITY) as journal:
        journal.append(RECORDS[0])
        journal._database.execute("PRAGMA max_page_count = 3")
        for _ in range(2):
            with pytest.raises(OSError, match="is full; what it held before is kept"):
                journal.append({"text": "long" * 2000})
        journal._database.execute("PRAGMA max_page_count = 100")
        journal.append({"text": "and longer" * 2000})
    assert read(path) == [RECORDS[0], {"text": "and longer" * 2000}]


def test_a_disk_that_is_full_at_the_start_is_one_clear_error(path):
    with largest_file(5000), pytest.raises(CheckpointError, match="cannot be opened: disk I/O"):
        read(path)
    write(path)
    assert read(path) == RECORDS
