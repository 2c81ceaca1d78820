import math
import os
import random
import re
import signal
import subprocess
import sys
import textwrap
from contextlib import nullcontext

import pytest

from robsmooth._support.checkpoint import CheckpointError, Journal
from tests.helpers.waiting import PATIENCE

IDENTITY = {"seed": 1, "parameters": {"kappa": 0.1, "beta": 1e-300}, "digest": "ab" * 32}
RECORDS = [{"block": 1, "mean": 0.1 + 0.2}, {"block": 2, "word": "λ\n"}, {"block": 3, "a": [1.0]}]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.journal"


def written(path, records=RECORDS, identity=IDENTITY):
    """Write a journal; return where each of its lines ends."""
    with Journal(path, identity) as journal:
        for record in records:
            journal.append(record)
    return [match.end() for match in re.finditer(b"\n", path.read_bytes())]


def read(path, identity=IDENTITY):
    with Journal(path, identity) as journal:
        return journal.records


def run(source, *arguments, **options):
    """Run a program that finds `Journal` imported."""
    program = (
        "import os, sys\nfrom robsmooth._support.checkpoint import Journal\n"
        + textwrap.dedent(source)
    )
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, **options)


# --- records --------------------------------------------------------------------------------------


def test_records_come_back_in_order_and_more_can_follow(path):
    written(path)
    with Journal(path, IDENTITY) as journal:
        assert journal.records == RECORDS
        assert journal.last == RECORDS[-1]
        journal.append({"block": 4})
        assert journal.records == RECORDS, "records are those found on entry"
    assert read(path) == [*RECORDS, {"block": 4}]


def test_a_new_journal_is_empty_and_has_its_folders_made(tmp_path):
    path = tmp_path / "new" / "folder" / "run.journal"
    with Journal(path, IDENTITY) as journal:
        assert (journal.records, journal.last, journal.dropped) == ([], None, 0)
    assert read(path) == []


def test_floats_keep_every_bit(path):
    draw = random.Random(0)
    values = [draw.uniform(-1, 1) * 10.0 ** draw.randint(-320, 300) for _ in range(500)]
    values += [-0.0, 5e-324, sys.float_info.max, math.inf, -math.inf, 0.1]
    written(path, [{"values": values}, {"nothing": math.nan}])
    first, second = read(path)
    assert [value.hex() for value in first["values"]] == [value.hex() for value in values]
    assert math.isnan(second["nothing"])


def test_the_file_is_lines_of_text(path):
    written(path)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + len(RECORDS)
    assert re.fullmatch(r'[0-9a-f]{16} \{"block": 1, "mean": 0\.30000000000000004\}', lines[1])


def test_a_record_without_a_json_form_is_refused_and_leaves_no_trace(path):
    with Journal(path, IDENTITY) as journal:
        with pytest.raises(TypeError, match="set is not JSON serializable"):
            journal.append({"value": {1}})
        journal.append({"value": 1})
    assert read(path) == [{"value": 1}]


def test_a_journal_that_is_not_open_says_so(path):
    journal = Journal(path, IDENTITY)
    assert not path.exists(), "nothing happens before entry"
    with journal:
        pass
    with pytest.raises(ValueError, match=r"run\.journal is not open"):
        journal.append({})
    with pytest.raises(ValueError, match=r"run\.journal is not open"):
        _ = journal.records


# --- damage ---------------------------------------------------------------------------------------


def test_a_kill_after_append_loses_nothing(path):
    ended = run(
        """
        with Journal(sys.argv[1], {}) as journal:
            for block in range(5):
                journal.append({"block": block})
            os.kill(os.getpid(), 9)
        """,
        path,
    )
    assert ended.returncode == -signal.SIGKILL
    assert [record["block"] for record in read(path, {})] == [0, 1, 2, 3, 4]


def test_a_file_cut_anywhere_resumes_with_its_whole_records(path):
    ends = written(path)
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        count = max(sum(end <= size for end in ends) - 1, 0)
        torn = size > ends[0] and size not in ends
        with pytest.warns(RuntimeWarning, match="1 line") if torn else nullcontext():
            assert read(path) == RECORDS[:count]
        assert path.read_bytes() == whole[: ends[count]], "the torn line is cut off"


@pytest.mark.parametrize(
    ("tail", "lines"),
    [
        (b"\xff\xfe\x00garbage", 1),
        (b"\x00" * 5000, 1),
        (b"0123456789abcdef {}\n", 1),
        (b"\n\n", 2),
        (b'{"block": 4}\nsecond\nthird', 3),
    ],
)
def test_garbage_at_the_end_is_cut_off(path, tail, lines):
    written(path)
    whole = path.read_bytes()
    path.write_bytes(whole + tail)
    with (
        pytest.warns(RuntimeWarning, match=rf"{lines} line\(s\) after record 3 are cut off"),
        Journal(path, IDENTITY) as journal,
    ):
        assert journal.dropped == lines
        assert journal.records == RECORDS
        journal.append({"block": 4})
    assert read(path) == [*RECORDS, {"block": 4}]


def test_no_single_flipped_bit_passes_for_a_record(path):
    ends = written(path)
    whole = path.read_bytes()
    for position in range(ends[0], len(whole)):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << position % 8
        path.write_bytes(damaged)
        with pytest.warns(RuntimeWarning, match="damaged"):
            found = read(path)
        assert found == RECORDS[: sum(end <= position for end in ends) - 1]


def test_a_warning_made_an_error_leaves_the_file_as_it_was(path):
    written(path)
    damaged = path.read_bytes() + b"torn"
    path.write_bytes(damaged)
    with pytest.raises(RuntimeWarning), Journal(path, IDENTITY):
        pass
    assert path.read_bytes() == damaged


# --- files that are refused -----------------------------------------------------------------------


def test_another_identity_is_refused_and_each_difference_named(path):
    written(path)
    before = path.read_bytes()
    other = {"seed": 2, "parameters": {"kappa": 0.1, "beta": 0.5}, "digest": "cd" * 32, "new": True}
    with pytest.raises(CheckpointError) as caught, Journal(path, other):
        pass
    message = str(caught.value)
    assert "of another computation" in message
    assert "seed is 1 there and 2 here" in message
    assert "parameters.beta is 1e-300 there and 0.5 here" in message
    assert "new is absent there and true here" in message
    assert re.search(r'digest is "abab\w*\.\.\.\w*" there and "cdcd\w*\.\.\.\w*" here', message)
    assert "kappa" not in message
    assert message.endswith("give another path, or delete the file to start anew")
    assert path.read_bytes() == before


def test_the_order_of_the_identity_does_not_matter(path):
    written(path)
    assert read(path, dict(reversed(IDENTITY.items()))) == RECORDS


@pytest.mark.parametrize(
    "content", [b"a user's notes\n", b"no end of line", b"\n", b"\x80\n", b"a\0" * 2_000_000]
)
def test_a_file_that_is_no_journal_is_refused_and_kept(path, content):
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="not a checkpoint"), Journal(path, IDENTITY):
        pass
    assert path.read_bytes() == content


def test_a_damaged_header_is_refused_and_kept(path):
    written(path)
    damaged = path.read_bytes().replace(b'"seed": 1', b'"seed": 3', 1)
    path.write_bytes(damaged)
    with pytest.raises(CheckpointError, match="first line is damaged"), Journal(path, IDENTITY):
        pass
    assert path.read_bytes() == damaged


def test_another_format_is_refused(path, monkeypatch):
    monkeypatch.setattr("robsmooth._support.checkpoint.FORMAT", 2)
    written(path)
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match=r"has format 2, and .* reads format 1"):
        read(path)


def test_two_runs_cannot_use_one_journal(path):
    with Journal(path, IDENTITY) as journal:
        with pytest.raises(CheckpointError, match="in use by another run"):
            read(path)
        ended = run("with Journal(sys.argv[1], {}): pass", path)
        assert "in use by another run" in ended.stderr
        journal.append({"block": 1})
    assert read(path) == [{"block": 1}]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (".", "Is a directory"),
        ("file/run.journal", "File exists|Not a directory"),
        ("file/folder/run.journal", "File exists|Not a directory"),
        ("a" * 300, "File name too long"),
    ],
)
def test_a_path_that_no_file_can_have_is_one_clear_error(tmp_path, name, reason):
    (tmp_path / "file").write_text("here")
    with pytest.raises(CheckpointError, match=f"cannot be opened: ({reason}); give another path"):
        read(tmp_path / name)


def test_what_is_not_a_regular_file_is_refused(path):
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match="not a regular file"):
        read(path)


@pytest.mark.parametrize("path", [None, 3, "", True])
def test_what_is_no_path_is_refused(path):
    with pytest.raises(
        TypeError, match=r"checkpoint must be the path of a file, got (None|3|''|T)"
    ):
        Journal(path, IDENTITY)


# --- full disk ------------------------------------------------------------------------------------


def test_a_full_disk_keeps_what_was_written(path):
    ended = run(
        """
        import resource
        with Journal(sys.argv[1], {}) as journal:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
            for block in range(100):
                journal.append({"block": block})
        """,
        path,
    )
    last = ended.stderr.splitlines()[-1]
    assert last.startswith("OSError")
    assert "the file has reached the largest size allowed" in last
    assert "what it held before is kept" in last
    assert path.read_bytes().endswith(b"\n"), "the torn line was taken back"
    blocks = [record["block"] for record in read(path, {})]
    assert blocks == list(range(len(blocks)))
    assert len(blocks) > 10


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has /dev/full")
@pytest.mark.parametrize("truncates", [True, False])
def test_writing_goes_on_after_room_was_made(path, monkeypatch, truncates):
    """A disk that fills within a line, and then has room again."""
    with open("/dev/full", "wb", buffering=0) as full:

        def write_a_little(file, data, offset):
            if len(data) < 20:
                return full.write(data)
            return write(file, data[:15], offset)

        def truncate(*_):
            raise OSError(5, "Input/output error")

        write = os.pwrite
        with Journal(path, IDENTITY) as journal:
            journal.append(RECORDS[0])
            monkeypatch.setattr(os, "pwrite", write_a_little)
            if not truncates:
                monkeypatch.setattr(os, "ftruncate", truncate)
            size = path.stat().st_size
            with pytest.raises(OSError, match="the disk is full; what it held before is kept"):
                journal.append({"text": "long" * 20})
            assert (path.stat().st_size == size) == truncates
            monkeypatch.undo()
            journal.append({"text": "and longer" * 20})
    assert read(path) == [RECORDS[0], {"text": "and longer" * 20}]


def test_a_failing_sync_is_an_error(path, monkeypatch):
    def fail(_):
        raise OSError(5, "Input/output error")

    with Journal(path, IDENTITY) as journal:
        monkeypatch.setattr(os, "fsync", fail)
        with pytest.raises(OSError, match="writing fails, Input/output error"):
            journal.append(RECORDS[0])
        monkeypatch.undo()
    assert read(path) == []
