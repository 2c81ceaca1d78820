"""Records in files: the rows that memory would give, in any format and chunks."""

import os
import pickle
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from pyarrow import parquet

from robsmooth.estimators import baselines
from robsmooth.io import formats
from robsmooth.io.records import smooth_record
from tests.helpers.strategies import random_system

DT = 0.1


def discrete(copies=False, **how):
    """A smoother of two measurements and two outputs, with a nonlinearity."""
    system = random_system(np.random.default_rng(3), m=2, measurements=2)
    channels = [replace(c, function=np.sin) for c in system.nonlinearities]
    system = replace(system, nonlinearities=channels)
    return baselines.fixed_lag_smoother(system, 0.5, 2, copies=copies).discretize(DT, **how)


def record(rows=50, columns=2, seed=0):
    y = np.random.default_rng(seed).standard_normal((rows, columns))
    y[np.random.default_rng(seed + 1).random(y.shape) < 0.1] = np.nan
    return y


def csv_text(values, header=None, delimiter=",", gap="nan"):
    lines = [] if header is None else [delimiter.join(header)]
    for row in values:
        lines.append(delimiter.join(gap if np.isnan(v) else repr(float(v)) for v in row))
    return "\n".join(lines) + "\n"


def read_csv(path):
    return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


def smoothed(folder, name, content, smoother=None, target="out.npy", **options):
    """The rows that are written for a source of this content."""
    source = folder / name
    if isinstance(content, np.ndarray):
        np.save(source, content)
    else:
        source.write_bytes(content.encode() if isinstance(content, str) else content)
    smooth_record(smoother or discrete(), source, folder / target, **options)
    return np.load(folder / target) if target.endswith(".npy") else read_csv(folder / target)


# --- the same as in memory -----------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [1, 7, 50, 1000])
@pytest.mark.parametrize("gap", ["nan", "", "NaN"])
def test_a_csv_file_is_the_record(tmp_path, chunk, gap):
    y = record()
    found = smoothed(tmp_path, "y.csv", csv_text(y, gap=gap), chunk=chunk)
    assert_array_equal(found, discrete().run(y))


@pytest.mark.parametrize("chunk", [7, 1000])
@pytest.mark.parametrize("kind", [np.float64, np.float32, ">f8", np.int16])
@pytest.mark.parametrize("order", ["C", "F"])
def test_an_npy_file_is_the_record(tmp_path, chunk, kind, order):
    y = np.asarray(10 * np.nan_to_num(record()), dtype=kind, order=order)
    found = smoothed(tmp_path, "y.npy", y, chunk=chunk)
    assert_array_equal(found, discrete().run(y))


def test_one_column_may_be_a_vector_in_a_file(tmp_path):
    system = random_system(np.random.default_rng(0))
    y = record(30, 1)
    found = smoothed(tmp_path, "y.npy", y[:, 0], baselines.kalman_bucy(system).discretize(DT))
    assert_array_equal(found, baselines.kalman_bucy(system).discretize(DT).run(y))


@given(
    st.lists(st.tuples(*[st.floats(-1e300, 1e300) | st.just(np.nan)] * 2), min_size=1, max_size=30),
    st.integers(1, 31),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from([",", ";", "\t"]),
    st.booleans(),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_numbers_are_read_to_the_last_bit(tmp_path, rows, chunk, end, delimiter, header):
    text = csv_text(rows, ["a", "b"] if header else None, delimiter, gap="")
    path = tmp_path / "y.csv"
    path.write_bytes(text.replace("\n", end).encode())
    reader = formats.opened(path, delimiter, ".", header, 0, formats.MISSING)
    assert_array_equal(np.concatenate(list(reader.rows([0, 1], chunk))), rows)
    assert reader.read == reader.size


def test_estimates_are_written_to_the_last_bit_with_their_times(tmp_path):
    y, smoother = record(), discrete()
    found = smoothed(tmp_path, "y.csv", csv_text(y), smoother, "deep/er/out.csv", chunk=8)
    expected = discrete().run(y)
    assert_array_equal(found[:, 1:], expected)
    np.testing.assert_allclose(found[:, 0], smoother.times(len(y)), rtol=1e-14, atol=1e-14)
    assert (tmp_path / "deep/er/out.csv").read_text().startswith("time,w[0],w[1]\n-0.4,")


def test_the_filtered_estimates_have_their_own_times(tmp_path):
    y, smoother = record(), discrete()
    found = smoothed(tmp_path, "y.csv", csv_text(y), smoother, "out.csv", output="filtered")
    assert_array_equal(found[:, 1:], discrete().run(y, output="filtered"))
    np.testing.assert_allclose(found[:, 0], DT * np.arange(1, 51))


def test_a_record_goes_on_in_the_next_file(tmp_path):
    y, smoother = record(), discrete()
    parts = [smoothed(tmp_path, "y.npy", part, smoother, "out.csv") for part in (y[:20], y[20:])]
    found = np.concatenate(parts)
    assert_array_equal(found[:, 1:], discrete().run(y))
    np.testing.assert_allclose(np.diff(found[:, 0]), DT)


def test_rows_are_counted(tmp_path):
    np.save(tmp_path / "y.npy", record())
    assert smooth_record(discrete(), tmp_path / "y.npy", tmp_path / "out.npy", chunk=7) == 50


@pytest.mark.parametrize("name", ["y.csv", "y.npy"])
def test_a_record_without_rows(tmp_path, name):
    content = "I,Q\n" if name == "y.csv" else np.empty((0, 2))
    assert smoothed(tmp_path, name, content).shape == (0, 2)


# --- columns -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "choice", [{"columns": ["Q", "I"]}, {"columns": (3, 1)}, {"columns": ["Q", np.int64(1)]}]
)
def test_columns_are_chosen_by_name_or_index(tmp_path, choice):
    y = record(columns=4)
    text = csv_text(y, ["t", "I", "note", "Q"]).replace("nan", "")
    lines = text.split("\n")
    lines[1:-1] = [
        ",".join(c if i != 2 else "a word" for i, c in enumerate(line.split(",")))
        for line in lines[1:-1]
    ]
    found = smoothed(tmp_path, "y.csv", "\n".join(lines), **choice)
    assert_array_equal(found, discrete().run(y[:, [3, 1]]))


def test_the_rest_is_measurements(tmp_path):
    values = np.column_stack([DT * np.arange(50), np.full(50, 0.3), record()])
    text = csv_text(values, ["t", "phase", "I", "Q"])
    found = smoothed(tmp_path, "y.csv", text, discrete(True), time="t", reference="phase", chunk=9)
    assert_array_equal(found, discrete(True).run(values[:, 2:], reference=values[:, [1]]))
    assert not np.array_equal(found, discrete(True).run(values[:, 2:]))
    found = smoothed(tmp_path, "y.npy", values, discrete(True), time=0, reference=[1])
    assert_array_equal(found, discrete(True).run(values[:, 2:], reference=values[:, [1]]))


# --- time ----------------------------------------------------------------------------------------


def with_times(times):
    return np.column_stack([times, np.ones((len(times), 2))])


@pytest.mark.parametrize(
    "times",
    [
        1e9 + DT * np.arange(200),
        np.round(DT * np.arange(200), 1) + 0.024 * (-1.0) ** np.arange(200),
        (1 + 5e-4) * DT * np.arange(200),
    ],
    ids=["any begin", "jitter", "another clock"],
)
def test_good_times_are_let_through(tmp_path, times):
    assert len(smoothed(tmp_path, "y.npy", with_times(times), time=0, chunk=30)) == 200


@pytest.mark.parametrize(
    ("times", "row", "message"),
    [
        (
            np.delete(DT * np.arange(200), 150),
            150,
            "is 2 samples after the row before .*: put a row of nan for each missing row",
        ),
        (np.insert(DT * np.arange(200), 60, 60 * DT), 61, "is 0 samples after"),
        (1.01 * DT * np.arange(200), 56, r"\+0.56 off regular times"),
        (2 * DT * np.arange(5), 1, "is 2 samples after"),
        (np.delete(DT * np.arange(2000), 1900), 1900, "is 2 samples after"),
    ],
    ids=["a row is missing", "a row twice", "another dt", "twice the dt", "missing late"],
)
def test_rows_out_of_time_are_refused(tmp_path, times, row, message):
    with pytest.raises(ValueError, match=rf"y.npy, row {row}, column 0: .*{message}"):
        smoothed(tmp_path, "y.npy", with_times(times), time=0, chunk=30)


START = np.datetime64("2026-11-22T10:00:00.000000000")
CLOCKS = {
    "s": 3.0 + DT * np.arange(30),
    "Unix s": 1_790_000_000.5 + DT * np.arange(30),
    "dates": START + np.arange(30) * np.timedelta64(100, "ms"),
}


@pytest.mark.parametrize("output", ["smoothed", "filtered"])
@pytest.mark.parametrize("name", ["y.csv", "y.parquet"])
@pytest.mark.parametrize("zone", ["", "Z"])
@pytest.mark.parametrize("clock", CLOCKS)
def test_the_estimates_have_the_times_of_the_records_clock(tmp_path, clock, name, output, zone):
    times, y, smoother = CLOCKS[clock], record(30), discrete()
    if name == "y.csv":
        cells = zip([f"{t}{zone if clock == 'dates' else ''}" for t in times], y, strict=True)
        (tmp_path / name).write_text("t,I,Q\n" + "".join(f"{t},{a},{b}\n" for t, (a, b) in cells))
    else:
        dated = clock == "dates" and zone
        column = pa.array(times, pa.timestamp("ns", "UTC")) if dated else pa.array(times)
        parquet.write_table(pa.table({"t": column, "I": y[:, 0], "Q": y[:, 1]}), tmp_path / name)
    smooth_record(smoother, tmp_path / name, tmp_path / "w.csv", time="t", output=output, chunk=7)
    _header, *lines = (tmp_path / "w.csv").read_text().splitlines()
    found = np.array([line.split(",") for line in lines])
    assert_array_equal(found[:, 1:].astype(float), discrete().run(y, output=output))
    shift = DT - (smoother.delay if output == "smoothed" else 0.0)
    if clock == "dates":
        assert all(t.endswith("Z") for t in found[:, 0]) == bool(zone)
        found, shift = np.char.rstrip(found[:, 0], "Z").astype("M8[ns]"), round(1e9 * shift)
        assert_array_equal(found, times + np.timedelta64(shift, "ns"))
    else:
        np.testing.assert_allclose(found[:, 0].astype(float), times + shift, rtol=1e-15, atol=1e-9)


@pytest.mark.parametrize("clock", CLOCKS)
def test_times_are_pointed_out_and_checked_unsaid(tmp_path, clock):
    def text(rows):
        lines = zip(CLOCKS[clock][rows], record(30)[rows], strict=True)
        return "t,I,Q\n" + "".join(f"{t},{a},{b}\n" for t, (a, b) in lines)

    whole, gap, chosen = np.arange(30), np.delete(np.arange(30), 9), {"columns": ["I", "Q"]}
    for rows in (whole, gap):
        with pytest.raises(
            ValueError, match=r"column 0 \('t'\) looks like times: say time='t', or"
        ):
            smoothed(tmp_path, "y.csv", text(rows), chunk=1)
    for say in ({"time": "t"}, chosen):
        found = smoothed(tmp_path, "y.csv", text(whole), **say)
        assert_array_equal(found, discrete().run(record(30)))
        with pytest.raises(ValueError, match=r"line 11, column 0 \('t'\): .* is 2 samples after"):
            smoothed(tmp_path, "y.csv", text(gap), **say)
    found = smoothed(tmp_path, "y.csv", text(gap), time=False, **chosen)
    assert_array_equal(found, discrete().run(record(30)[gap]))


@pytest.mark.parametrize("scale", [1e6, 60.0, 1 / 60.0])
def test_a_column_of_times_in_another_unit_is_told(tmp_path, scale):
    values = with_times(scale * DT * np.arange(30))
    with pytest.raises(ValueError, match=r"row 1, .* is dt .* Or divide them by") as raised:
        smoothed(tmp_path, "y.npy", values, time=0)
    scale_told = float(re.search(r"divide them by (\S+),", str(raised.value))[1])
    assert scale_told == pytest.approx(scale, rel=1e-5)
    values[:, 0] /= scale_told
    assert len(smoothed(tmp_path, "y.npy", values, time=0)) == 30


def test_times_are_written_with_the_digits_of_dt(tmp_path):
    (tmp_path / "y.csv").write_text(csv_text(with_times(DT * np.arange(20)), ["t", "I", "Q"]))
    for say in ({"time": "t"}, {"time": False, "columns": ["I", "Q"]}):
        smooth_record(discrete(), tmp_path / "y.csv", tmp_path / "w.csv", **say)
        lines = (tmp_path / "w.csv").read_text().splitlines()[1:]
        shown = [line.partition(",")[0] for line in lines]
        assert all(len(time) <= 4 for time in shown), shown


def test_a_measurement_that_rises_steadily_is_one_where_the_user_says_so(tmp_path):
    y = np.column_stack([np.arange(30.0), np.ones(30)])
    with pytest.raises(ValueError, match="column 0 looks like times"):
        smoothed(tmp_path, "y.npy", y)
    for say in ({"columns": [0, 1]}, {"time": False}):
        assert_array_equal(smoothed(tmp_path, "y.npy", y, **say), discrete().run(y))


# --- Parquet -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["float64", "float32", "int16", "decimal128(38, 2)"])
@pytest.mark.parametrize("chunk", [7, 1000])
def test_a_parquet_file_is_the_record(tmp_path, kind, chunk):
    y = np.round(10 * np.nan_to_num(record()))
    kind = pa.decimal128(38, 2) if kind.startswith("decimal") else kind
    columns = [pa.array(column.astype(int)).cast(kind) for column in y.T]
    gaps = pa.array([None, *columns[1].to_pylist()[1:]], columns[1].type)
    y[0, 1] = np.nan
    table = pa.table({"note": 50 * ["a word"], "Q": gaps, "I": columns[0]})
    parquet.write_table(table, tmp_path / "y.parquet", row_group_size=20)
    options = {"columns": ["I", "Q"], "chunk": chunk}
    smooth_record(discrete(), tmp_path / "y.parquet", tmp_path / "out.npy", **options)
    assert_array_equal(np.load(tmp_path / "out.npy"), discrete().run(y))


def test_what_is_wrong_in_a_parquet_file_is_named(tmp_path):
    for column, error, message in (
        ([True, False], TypeError, "y.parquet, column 1 .* real numbers or dates, got bool"),
        (["a", "b"], ValueError, "y.parquet: .*'[ab]'"),
        ([1.0, np.inf], ValueError, r"y.parquet, row 1, column 1 \('Q'\): inf where"),
    ):
        parquet.write_table(pa.table({"I": [1.0, 0.0], "Q": column}), tmp_path / "y.parquet")
        with pytest.raises(error, match=message):
            smooth_record(discrete(), tmp_path / "y.parquet", tmp_path / "out.npy")
    with pytest.raises(ValueError, match=r"y.parquet: Parquet magic bytes"):
        smoothed(tmp_path, "y.parquet", 100 * "no Parquet ")


# --- refusals ------------------------------------------------------------------------------------

NPY_ERRORS = {
    "objects": (np.array([[1.0, None]], dtype=object), ValueError, "are never unpickled"),
    "words": (
        np.array([["a", "b"]]),
        TypeError,
        "must be an array of numbers, got entries of type <U1",
    ),
    "complex": (np.ones((2, 2), complex), ValueError, "must be real, got complex entries"),
    "booleans": (np.ones((2, 2), bool), TypeError, "got entries of type bool"),
    "scalar": (np.array(1.0), ValueError, r"an array \(N, columns\), got shape \(\)"),
    "cube": (np.ones((2, 2, 2)), ValueError, r"got shape \(2, 2, 2\)"),
    "not one": ("1,2\n", ValueError, "must be an NPY file of plain numbers"),
    "three columns": (np.ones((2, 3)), ValueError, r"got 3: column 0, column 1, column 2"),
    "infinity": (np.array([[1, 2], [3, np.inf]]), ValueError, r"y.npy, row 1, column 1: inf"),
}


@pytest.mark.parametrize(("content", "error", "message"), NPY_ERRORS.values(), ids=NPY_ERRORS)
def test_what_is_wrong_in_an_npy_file_is_named(tmp_path, content, error, message):
    with pytest.raises(error, match=message):
        smoothed(tmp_path, "y.npy", content)
    assert os.listdir(tmp_path) == ["y.npy"]


DAMAGES = {
    "cut off": lambda content: content[:-8],
    "no array": lambda content: content[:40],
    "open bracket": lambda content: content.replace(b"}", b"(", 1),
    "unknown type": lambda content: content.replace(b"<f8", b",f8", 1),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_npy_file_is_refused(tmp_path, damage):
    np.save(tmp_path / "whole.npy", record())
    content = damage((tmp_path / "whole.npy").read_bytes())
    with pytest.raises(ValueError, match=re.escape("y.npy must be an NPY file")):
        smoothed(tmp_path, "y.npy", content)


def test_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    with pytest.raises(ValueError, match="never unpickled"):
        smoothed(tmp_path, "y.npy", pickle.dumps(Trap()))
    np.save(tmp_path / "trap.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="never unpickled"):
        smooth_record(discrete(), tmp_path / "trap.npy", tmp_path / "out.npy")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"columns": ["I", "J"]}, ValueError, "columns: 'J' is not in .*, which has 'I', 'Q', 'Q'"),
        ({"columns": ["I", "Q"]}, ValueError, "columns: 'Q' is twice in"),
        ({"columns": [0, 3]}, ValueError, "has 3 columns, there is no 3"),
        ({"columns": [0, -1]}, ValueError, "columns must be an integer of at least 0"),
        ({"columns": [0, 1.0]}, TypeError, "columns must be an integer"),
        ({"columns": "I"}, ValueError, r"columns must name 2 .* got 1: column 0 \('I'\)"),
        ({"columns": [0, 1], "reference": [0, 1]}, ValueError, "reference must name 1"),
        ({"columns": [0, 1], "time": [0, 1]}, ValueError, "time must name 1"),
        ({"columns": [0, 1], "reference": 2}, ValueError, "column 2 .*nan where there must"),
        ({"delimiter": ""}, ValueError, "delimiter must be one character"),
        ({"delimiter": '"'}, ValueError, "delimiter must be one character of ASCII, not a quote"),
        *[
            ({"delimiter": mark}, ValueError, "delimiter must be one character of ASCII, not a quo")
            for mark in (",,", "é", "\n", "\0", "1", "e", ".", "-", "_", "'", 7)
        ],
        ({"columns": [0, 0]}, ValueError, r"must be distinct, and no dates: \[0, 0\]"),
        ({"columns": [0, 1], "reference": 1}, ValueError, "must be distinct"),
        ({"columns": [True, 1]}, TypeError, "columns must be an integer"),
        ({"header": "yes"}, TypeError, "header must be True or False"),
        ({"skip_rows": -1}, ValueError, "skip_rows must be an integer of at least 0"),
        ({"decimal": ";"}, ValueError, "decimal must be one of"),
        ({"missing": -999}, TypeError, "missing must be"),
        ({"missing": [-999]}, TypeError, "missing must be"),
        ({"missing": "\udcff"}, TypeError, "missing must be"),
        ({"chunk": 0}, ValueError, "chunk must be an integer of at least 1"),
        ({"progress": 1}, TypeError, "progress must be True or False"),
        ({"columns": [0, 1], "output": "both"}, ValueError, "output must be one of"),
        ({"target": "out.txt"}, ValueError, "target must be a file, .* got .*out.txt"),
        ({"target": "w.parquet"}, ValueError, "target must be a file, .* ends in .csv, .tsv,"),
        ({"target": "w.npy.gz"}, ValueError, "target must be a file, .* ends in .csv, .tsv,"),
        ({"target": "y.csv"}, ValueError, "target must be another file than source"),
    ],
)
def test_wrong_calls_are_refused(tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        smoothed(tmp_path, "y.csv", "I,Q,Q\n1,2,\n", **options)
    assert os.listdir(tmp_path) == ["y.csv"]


def test_names_want_a_header(tmp_path):
    with pytest.raises(ValueError, match=r"'I' is not in .*, which has no header"):
        smoothed(tmp_path, "y.npy", record(), columns=["I", "Q"])


def test_wrong_sources_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"source must be a file, .* ends in .*, got .*y.npz"):
        smooth_record(discrete(), tmp_path / "y.npz", tmp_path / "out.npy")
    with pytest.raises(
        FileNotFoundError, match=r"^source must be a file that exists, got .*y\.csv"
    ):
        smooth_record(discrete(), tmp_path / "y.csv", tmp_path / "out.npy")
    with pytest.raises(TypeError, match="smoother must be a DiscreteSmoother, got int"):
        smooth_record(1, tmp_path / "y.csv", tmp_path / "out.npy")


@pytest.mark.parametrize("option", [{"header": True}, {"skip_rows": 1}, {"missing": "-"}])
def test_how_to_read_a_csv_file_says_nothing_of_another_one(tmp_path, option):
    with pytest.raises(ValueError, match=r"missing are for CSV files, not .*y\.npy"):
        smoothed(tmp_path, "y.npy", record(), **option)


def test_pipes_devices_and_folders_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "folder.npy").mkdir()
    (tmp_path / "null.csv").symlink_to("/dev/null")
    np.save(tmp_path / "y.npy", record())
    for name in ("pipe.csv", "folder.npy", "null.csv"):
        for source, target, argument in ((name, "w.npy", "source"), ("y.npy", name, "target")):
            with pytest.raises(ValueError, match=f"{argument} must be a file, .*{name}"):
                smooth_record(discrete(), tmp_path / source, tmp_path / target)


def test_the_home_is_known_and_links_and_permissions_are_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    np.save(tmp_path / "y.npy", record())
    (tmp_path / "there.csv").touch(0o600)
    (tmp_path / "w.csv").symlink_to("there.csv")
    smooth_record(discrete(), "~/y.npy", "~/w.csv")
    assert (tmp_path / "w.csv").is_symlink()
    assert (tmp_path / "there.csv").stat().st_mode & 0o777 == 0o600
    assert_array_equal(read_csv(tmp_path / "there.csv")[:, 1:], discrete().run(record()))
    (tmp_path / "x.npy").symlink_to("y.npy")
    with pytest.raises(ValueError, match="target must be another file than source"):
        smooth_record(discrete(), "~/y.npy", "~/x.npy")


def test_a_row_of_one_column_is_no_blank(tmp_path):
    system = random_system(np.random.default_rng(0))
    smoother = baselines.kalman_bucy(system).discretize(DT)
    for text, message in (
        ("0.5\n\n1.5\n", "line 2: blank"),
        ("0.5\n1.5\n \n", "line 3: .*value ''"),
    ):
        with pytest.raises(ValueError, match=message):
            smoothed(tmp_path, "y.csv", text, smoother)
    found = smoothed(tmp_path, "y.csv", '0.5\n""\nnan\n', smoother)
    expected = baselines.kalman_bucy(system).discretize(DT).run([[0.5], [np.nan], [np.nan]])
    assert_array_equal(found, expected)


@pytest.mark.parametrize("name", ["w.csv.gz", "w.tsv", "w.tsv.gz"])
def test_estimates_are_written_by_the_name_of_the_target(tmp_path, name):
    np.save(tmp_path / "y.npy", record())
    smooth_record(discrete(), tmp_path / "y.npy", tmp_path / name)
    mark = "\t" if "tsv" in name else ","
    found = np.loadtxt(tmp_path / name, delimiter=mark, skiprows=1)
    assert_array_equal(found[:, 1:], discrete().run(record()))


# --- interruption, memory, progress --------------------------------------------------------------


@pytest.mark.parametrize("target", ["out.npy", "out.csv"])
def test_an_interruption_leaves_all_as_it_was(tmp_path, monkeypatch, target):
    smoother = discrete()
    smoother.run(record(5))
    state = smoother.state
    (tmp_path / target).write_text("old")
    run = type(smoother).run

    def interrupted(self, y, **options):
        if self.samples > 20:
            raise KeyboardInterrupt
        return run(self, y, **options)

    monkeypatch.setattr(type(smoother), "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        smoothed(tmp_path, "y.npy", record(), smoother, target, chunk=10)
    assert sorted(os.listdir(tmp_path)) == [target, "y.npy"]
    assert (tmp_path / target).read_text() == "old"
    assert smoother.samples == 5
    assert_array_equal(smoother.state, state)


@pytest.mark.parametrize("name", ["y.csv", "y.npy"])
def test_memory_is_that_of_a_chunk(tmp_path, name):
    """24 MB of numbers in memory would show, as would 18 MB of text."""
    rows = 1_500_000
    source = tmp_path / name
    if name == "y.npy":
        np.lib.format.open_memmap(source, "w+", np.float64, (rows, 2)).flush()
    else:
        source.write_text("0.25,-0.125\n" * rows)
    smoother = discrete()
    smoother.run(record(5))  # compiles
    tracemalloc.start()
    try:
        smooth_record(smoother, source, tmp_path / "out.npy", chunk=10_000)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 12e6
    assert np.load(tmp_path / "out.npy", mmap_mode="r").shape == (rows, 2)


def test_progress_is_shown_where_asked_for(tmp_path, terminal):
    smoothed(tmp_path, "y.csv", csv_text(record()))
    assert terminal.readouterr().err == ""
    smoothed(tmp_path, "y.csv", csv_text(record()), progress=True)
    assert "100%" in terminal.readouterr().err


@pytest.mark.parametrize("samples", ["means", "instants"])
@pytest.mark.parametrize("output", ["smoothed", "filtered"])
@pytest.mark.parametrize("chunk", [1, 7, 10**6])
def test_rows_at_any_times_have_intervals_of_their_own(tmp_path, samples, output, chunk):
    lengths = DT * np.random.default_rng(3).uniform(0.3, 2.5, 60)
    y = record(60)
    expected, smoother = (discrete(samples=samples) for _ in range(2))
    if samples == "means":  # a row's interval begins at its time, and the last is of dt
        lengths[-1] = DT
        times, ends = 5.0 + np.cumsum([0.0, *lengths[:-1]]), 5.0 + np.cumsum(lengths)
    else:  # a row's interval ends at its time, and the first is of dt
        lengths[0] = DT
        times = ends = 5.0 + np.cumsum(lengths)
    (tmp_path / "y.csv").write_text(csv_text(np.column_stack([times, y]), ["t", "a", "b"]))
    how = {"time": "t", "regular": False, "output": output, "chunk": chunk}
    assert smooth_record(smoother, tmp_path / "y.csv", tmp_path / "w.csv", **how) == 60
    found = read_csv(tmp_path / "w.csv")
    delay = expected.delay if output == "smoothed" else 0.0
    assert_allclose(found[:, 0], ends - delay, rtol=1e-12)
    w = expected.run(y, intervals=lengths, output=output)
    assert_allclose(found[:, 1:], w, rtol=1e-9, atol=1e-12)


def test_instants_are_at_the_times_of_their_rows():
    times = DT * np.arange(9)
    frame = pytest.importorskip("pandas").DataFrame({"t": times, "a": 0.0, "b": 0.0})
    found = smooth_record(discrete(samples="instants"), frame, time="t")
    assert_allclose(found.index, times - 0.5, atol=1e-12)


def test_rows_out_of_order_are_refused_whatever_their_intervals(tmp_path):
    times = [0.0, 0.1, 0.05, 0.2]
    (tmp_path / "y.csv").write_text(csv_text(np.column_stack([times, record(4)]), ["t", "a", "b"]))
    with pytest.raises(ValueError, match=r"line 4, column 0 \('t'\): 0.05 s is -0.5 samples after"):
        smooth_record(discrete(), tmp_path / "y.csv", tmp_path / "w.csv", time="t", regular=False)
    with pytest.raises(ValueError, match="time must be given where regular=False"):
        smooth_record(discrete(), record(4), regular=False)


def test_a_mean_over_a_gap_is_pointed_out(tmp_path):
    times = np.delete(DT * np.arange(200), slice(60, 100))
    frame = pytest.importorskip("pandas").DataFrame({"t": times, "a": 0.0, "b": 0.0})
    with pytest.warns(UserWarning, match=r"row at 5\.9 s counts as a mean over 4\.1 s: .* nan"):
        smooth_record(discrete(), frame, time="t", regular=False)
    smooth_record(discrete(samples="instants"), frame, time="t", regular=False)  # no mean
    irregular = frame.assign(t=DT * np.cumsum(1.0 + 9.0 * np.random.default_rng(0).random(160)))
    smooth_record(discrete(), irregular, time="t", regular=False)


# --- error bars ----------------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [7, 1000])
@pytest.mark.parametrize("output", ["smoothed", "filtered"])
def test_files_have_the_error_bars_of_memory(tmp_path, chunk, output):
    y, how = record(), {"output": output, "return_std": True}
    w, deviations = discrete().run(y, **how)
    for target in ("out.csv", "out.npy"):
        found = smoothed(tmp_path, "y.csv", csv_text(y), target=target, chunk=chunk, **how)
        assert_array_equal(found[:, -4:], np.hstack([w, deviations]))
    header = (tmp_path / "out.csv").read_text().partition("\n")[0]
    assert header == "time,w[0],w[1],std[0],std[1]"
    frame = pytest.importorskip("pandas").DataFrame(y, columns=["I", "Q"])
    found = smooth_record(discrete(), frame, chunk=chunk, **how)
    assert list(found.columns) == header.split(",")[1:]
    assert_array_equal(found, np.hstack([w, deviations]))
    assert_array_equal(smooth_record(discrete(), y, chunk=chunk, **how), [w, deviations])
    parts = smooth_record(discrete(), iter([y[:20], y[20:]]), chunk=chunk, **how)
    assert_array_equal(np.concatenate([*map(np.array, parts)], axis=1), [w, deviations])


def test_a_filter_of_the_delays_model_has_no_error_bars(tmp_path):
    smoother = discrete().estimator.discretize(DT, delay="model")
    with pytest.raises(ValueError, match="return_std is for an exact smoother"):
        smoothed(tmp_path, "y.npy", record(), smoother, return_std=True)
    with pytest.raises(TypeError, match="return_std must be True or False"):
        smooth_record(discrete(), record(), return_std=1)
    assert os.listdir(tmp_path) == ["y.npy"]


def test_a_file_may_begin_with_a_row_of_gaps(tmp_path):
    """Tabs alone are the delimiters of gaps, and no blank line."""
    (tmp_path / "y.tsv").write_text("\t\n1.0\t2.0\n")
    reader = formats.opened(tmp_path / "y.tsv", None, ".", False, 0, formats.MISSING)
    assert_array_equal(next(reader.rows([0, 1], 9)), [[np.nan, np.nan], [1.0, 2.0]])
    (tmp_path / "y.csv").write_text("\t\n1.0\n")
    with pytest.raises(ValueError, match="must begin with names or numbers"):
        formats.opened(tmp_path / "y.csv", None, ".", False, 0, formats.MISSING)
