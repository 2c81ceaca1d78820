"""A record that is resumed after an interruption: to the same bytes, or not at all."""

import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from robsmooth._support.checkpoint import CheckpointError
from robsmooth.estimators import baselines
from robsmooth.io import targets
from robsmooth.io.records import smooth_record
from tests.helpers.strategies import random_system
from tests.io.test_records import DT, csv_text, discrete, record

ROWS = 2000
CALL = {"chunk": 7, "resume": True}  # 286 chunks, of which the journal knows each 64th
SOURCES = {"y.csv": csv_text(record(ROWS)), "y.npy": record(ROWS)}


@pytest.fixture(params=SOURCES)
def source(request, tmp_path):
    path = tmp_path / request.param
    if request.param == "y.npy":
        np.save(path, SOURCES["y.npy"])
    else:
        path.write_text(SOURCES["y.csv"])
    return path


class Interruption(BaseException):
    """What no handler expects."""


def interrupted_at(monkeypatch, samples, smoother, *arguments, **options):
    """Smooth a record up to a sample."""
    run = type(smoother).run

    def up_to(self, y, **of):
        if self.samples + len(y) > samples:
            raise Interruption
        return run(self, y, **of)

    with monkeypatch.context() as patch, pytest.raises(Interruption):
        patch.setattr(type(smoother), "run", up_to)
        smooth_record(smoother, *arguments, **options)


def made(kind="exact", dt=DT):
    """A smoother of two measurements: exact, with copies, or with a model of its delay."""
    if kind == "copies":
        return discrete(copies=True)
    system = random_system(np.random.default_rng(3), m=2, measurements=2)
    delay = "model" if kind == "model" else None
    return baselines.fixed_lag_smoother(system, 0.5, 2).discretize(dt, delay=delay)


def begun(kind="exact"):
    smoother = made(kind)
    smoother.run(record(5))
    return smoother


@pytest.mark.parametrize("target", ["w.npy", "w.csv"])
@pytest.mark.parametrize("kind", ["exact", "copies", "model"])
def test_a_resumed_run_writes_the_same_bytes(tmp_path, monkeypatch, source, target, kind):
    expected, target = tmp_path / f"whole{target}", tmp_path / target
    assert smooth_record(begun(kind), source, expected, chunk=7) == ROWS
    whole = begun(kind)
    smooth_record(whole, source, tmp_path / f"other{target.name}", **CALL)
    target.write_text("old")
    for samples in (300, 900, 950, 1990):  # no journal yet, two records, still two, four
        again = begun(kind)
        interrupted_at(monkeypatch, samples, again, source, target, **CALL)
        assert target.read_text() == "old"
        assert again.samples == 5
    taken, run = [], type(again).run
    counted = lambda self, y, **of: taken.append(len(y)) or run(self, y, **of)  # noqa: E731
    with monkeypatch.context() as patch:
        patch.setattr(type(again), "run", counted)
        assert smooth_record(again, source, target, **CALL) == ROWS
    assert sum(taken) < 0.2 * ROWS
    assert target.read_bytes() == expected.read_bytes()
    np.testing.assert_array_equal(again.state, whole.state)
    assert again.samples == ROWS + 5
    names = {source.name, expected.name, f"other{target.name}", target.name}
    assert {path.name for path in tmp_path.iterdir()} == names


KILLED = """
import os, signal, sys
from robsmooth.io.records import smooth_record
from robsmooth.io import formats
from tests.helpers.strategies import random_system
from tests.io.test_records import discrete
rows, number = formats.Array.rows, 0
def killed(self, columns, chunk):
    global number
    for values in rows(self, columns, chunk):
        number += 1
        if number > int(sys.argv[1]):
            os.kill(os.getpid(), signal.SIGKILL)
        yield values
formats.Array.rows = killed
smooth_record(discrete(), "y.npy", "w.csv", chunk=7, resume=True)
"""


def test_a_process_that_was_killed_is_gone_on_with(tmp_path):
    np.save(tmp_path / "y.npy", SOURCES["y.npy"])
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    for chunks in (100, 200, 290):
        command = [sys.executable, "-c", KILLED, str(chunks)]
        run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True)
        assert run.returncode == (0 if chunks == 290 else -signal.SIGKILL), run.stderr
    smooth_record(discrete(), tmp_path / "y.npy", tmp_path / "whole.csv")
    assert (tmp_path / "w.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["w.csv", "whole.csv", "y.npy"]


# --- what does not belong together ----------------------------------------------------------------


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    """The folder of an interrupted run, and what its files hold."""
    np.save(tmp_path / "y.npy", SOURCES["y.npy"])
    interrupted_at(monkeypatch, 1000, discrete(), tmp_path / "y.npy", tmp_path / "w.csv", **CALL)
    assert sorted(os.listdir(tmp_path)) == ["w.csv.part", "w.csv.resume", "y.npy"]
    return tmp_path


def other(y, row):
    y = y.copy()
    y[row] += 1.0
    return y


OTHERS = {
    "another smoother": (lambda: made("copies"), {}, None, "first estimates is"),
    "another state": (begun, {}, None, "smoother is"),
    "another step": (lambda: made(dt=0.2), {}, None, "smoother is"),
    "another output": (discrete, {"output": "filtered"}, None, "first estimates is"),
    "another chunk": (discrete, {"chunk": 8}, None, "chunk is 7 there and 8 here"),
    "other columns": (discrete, {"columns": [1, 0]}, None, "columns is"),
    "another delimiter": (discrete, {"delimiter": ";"}, None, "delimiter is"),
    "another begin": (discrete, {}, other(SOURCES["y.npy"], 0), "first estimates is"),
    "another record later": (discrete, {}, other(SOURCES["y.npy"], 500), "of another record"),
    "a shorter record": (discrete, {}, SOURCES["y.npy"][:300], "of another record"),
}


@pytest.mark.parametrize(("smoother", "options", "y", "message"), OTHERS.values(), ids=OTHERS)
def test_another_computation_is_refused(stopped, smoother, options, y, message):
    if y is not None:
        np.save(stopped / "y.npy", y)
    before = (stopped / "w.csv.part").read_bytes()
    smoother = smoother()
    samples = smoother.samples
    with pytest.raises(CheckpointError, match=message) as raised:
        smooth_record(smoother, stopped / "y.npy", stopped / "w.csv", **CALL | options)
    assert "delete the file to start anew" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert smoother.samples == samples
    assert (stopped / "w.csv.part").read_bytes() == before


def cut(path):
    path.write_bytes(path.read_bytes()[:-1])


STATE = b'"state": "'


def flipped(path):
    first, *rest = path.read_bytes().split(STATE)
    path.write_bytes(first + b"".join(STATE + bytes([part[0] ^ 1]) + part[1:] for part in rest))


DAMAGES = {
    "no estimates": ("w.csv.part", os.unlink, "of another record, or of another file"),
    "fewer estimates": ("w.csv.part", lambda path: os.truncate(path, 99), "of another file"),
    "no notes": ("w.csv.resume", lambda path: path.write_text("notes"), "is not a checkpoint"),
    "an empty file": ("w.csv.resume", lambda path: path.write_text("n"), "is not a checkpoint"),
}


@pytest.mark.parametrize(("name", "damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_checkpoint_is_refused(stopped, name, damage, message):
    damage(stopped / name)
    with pytest.raises(CheckpointError, match=message) as raised:
        smooth_record(discrete(), stopped / "y.npy", stopped / "w.csv", **CALL)
    assert "\n" not in str(raised.value)
    assert not (stopped / "w.csv").exists()


@pytest.mark.parametrize("damage", [cut, flipped])
def test_a_checkpoint_without_a_whole_record_is_set_aside(stopped, damage):
    damage(stopped / "w.csv.resume")
    with pytest.warns(UserWarning, match=r"w.csv.resume was damaged, and is now .*damaged-1"):
        assert smooth_record(discrete(), stopped / "y.npy", stopped / "w.csv", **CALL) == ROWS
    assert (stopped / "w.csv.resume.damaged-1").exists()


def test_two_runs_at_a_time_are_refused(stopped, monkeypatch):
    writer = targets.writer

    def twice(*arguments):
        with pytest.raises(CheckpointError, match="is in use by another run"):
            smooth_record(discrete(), stopped / "y.npy", stopped / "w.csv", **CALL)
        return writer(*arguments)

    monkeypatch.setattr(targets, "writer", twice)
    assert smooth_record(discrete(), stopped / "y.npy", stopped / "w.csv", **CALL) == ROWS


def test_gzip_is_not_resumed(tmp_path):
    np.save(tmp_path / "y.npy", SOURCES["y.npy"])
    with pytest.raises(ValueError, match="target must be no file in gzip where resume=True"):
        smooth_record(discrete(), tmp_path / "y.npy", tmp_path / "w.csv.gz", resume=True)
    with pytest.raises(TypeError, match="resume must be True or False"):
        smooth_record(discrete(), tmp_path / "y.npy", tmp_path / "w.csv", resume=1)


def test_a_record_without_rows_is_resumed(tmp_path):
    np.save(tmp_path / "y.npy", np.empty((0, 2)))
    assert smooth_record(discrete(), tmp_path / "y.npy", tmp_path / "w.csv", **CALL) == 0
    assert sorted(os.listdir(tmp_path)) == ["w.csv", "y.npy"]


def test_another_smoother_is_refused_also_where_the_record_begins_with_a_gap(tmp_path, monkeypatch):
    y = record(ROWS)
    y[:10] = np.nan
    np.save(tmp_path / "y.npy", y)
    interrupted_at(monkeypatch, 1000, made(), tmp_path / "y.npy", tmp_path / "w.npy", **CALL)
    system = random_system(np.random.default_rng(3), m=2, measurements=2)
    noisy = replace(system, D21=3.0 * system.D21)
    other = baselines.fixed_lag_smoother(noisy, 0.5, 2).discretize(DT)
    with pytest.raises(CheckpointError, match="first estimates is"):
        smooth_record(other, tmp_path / "y.npy", tmp_path / "w.npy", **CALL)


def test_the_same_samples_of_another_day_are_another_record(tmp_path, monkeypatch):
    call = {**CALL, "time": "t"}
    for day in ("2024-03-30", "2024-03-31"):
        times = np.datetime64(day) + np.arange(ROWS) * np.timedelta64(100, "ms")
        rows = zip(times, record(ROWS), strict=True)
        lines = [f"{t},{i},{q}" for t, (i, q) in rows]
        (tmp_path / "y.csv").write_text("\n".join(["t,I,Q", *lines, ""]))
        if day == "2024-03-30":
            arguments = tmp_path / "y.csv", tmp_path / "w.csv"
            interrupted_at(monkeypatch, 1000, made(), *arguments, **call)
    with pytest.raises(CheckpointError, match="first date is"):
        smooth_record(made(), tmp_path / "y.csv", tmp_path / "w.csv", **call)
