"""Records in memory: what goes in as a frame comes out as one, with the times of the estimates."""

from functools import cache

import numpy as np
import pandas as pd
import pint
import polars as pl
import pyarrow as pa
import pytest
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal

from robsmooth.estimators import baselines
from robsmooth.io.records import smooth_record
from tests.helpers.strategies import random_system
from tests.io.test_records import CLOCKS, DT, csv_text, discrete, record

Y = record(30)
INDICES = {
    "seconds": pd.Index(CLOCKS["Unix s"], name="t"),
    "dates": pd.DatetimeIndex(CLOCKS["dates"]),
    "dates of a zone": pd.DatetimeIndex(CLOCKS["dates"], name="when").tz_localize("Europe/Paris"),
    "lengths of time": pd.to_timedelta(DT * np.arange(30), unit="s"),
}


@cache
def estimates(output="smoothed"):
    """The estimates that each way must give."""
    return discrete().run(Y, output=output)


def single(order=2):
    """A smoother of one measurement."""
    system = random_system(np.random.default_rng(0))
    return baselines.fixed_lag_smoother(system, 0.3, order).discretize(DT)


def shifted(index, smoother, output):
    shift = DT - (smoother.delay if output == "smoothed" else 0.0)
    return index + (shift if index.dtype == float else pd.Timedelta(shift, unit="s"))


# --- with a clock --------------------------------------------------------------------------------


@pytest.mark.parametrize("output", ["smoothed", "filtered"])
@pytest.mark.parametrize("index", INDICES)
@pytest.mark.parametrize("chunk", [7, 1000])
def test_the_index_of_pandas_is_the_clock(index, output, chunk):
    index, smoother = INDICES[index], discrete()
    frame = pd.DataFrame(Y, index=index, columns=["I", "Q"])
    found = smooth_record(smoother, frame, output=output, chunk=chunk)
    assert isinstance(found, pd.DataFrame)
    assert list(found.columns) == ["w[0]", "w[1]"]
    assert_array_equal(found.to_numpy(), estimates(output))
    expected = shifted(index, smoother, output)
    assert found.index.name == (index.name or "time")
    if index.dtype == float:
        assert_allclose(found.index, expected, rtol=1e-15)
    else:
        assert found.index.equals(expected.as_unit("ns"))


@pytest.mark.parametrize("index", INDICES)
def test_an_index_is_checked(index):
    frame = pd.DataFrame(Y, index=INDICES[index], columns=["I", "Q"]).drop(INDICES[index][9])
    with pytest.raises(ValueError, match=r"source, row 9, column 2 .* is 2 samples after"):
        smooth_record(discrete(), frame)
    found = smooth_record(discrete(), frame, time=False)
    assert_array_equal(found, discrete().run(np.delete(Y, 9, axis=0)))
    assert_allclose(found.index, DT * np.arange(1, 30) - discrete().delay, atol=1e-12)


def test_nanoseconds_are_kept_in_dates():
    smoother = single().__class__(  # of the same design, in steps of 100 ns
        baselines.fixed_lag_smoother(random_system(np.random.default_rng(0)), 3e-7, 2), 1e-7
    )
    index = pd.date_range("2026-11-22 10:00", periods=1000, freq="100ns")
    found = smooth_record(smoother, pd.DataFrame({"y": np.ones(1000)}, index=index))
    assert found.index.equals(index - pd.Timedelta("200ns"))


def test_an_index_that_only_counts_is_no_clock():
    frame = pd.DataFrame(Y, columns=["I", "Q"])
    found = smooth_record(discrete(), frame)
    assert_array_equal(found, estimates())
    assert_allclose(found.index, DT * np.arange(1, 31) - discrete().delay, atol=1e-12)
    with pytest.raises(ValueError, match="2 s is 20 samples after"):  # rows with gaps are left out
        smooth_record(discrete(), frame.drop(index=[1, 4]))


def test_a_column_may_be_the_clock():
    times = CLOCKS["dates"]
    columns = {"when": times, "phase": np.full(30, 0.3), "I": Y[:, 0], "Q": Y[:, 1]}
    expected = discrete(True).run(Y, reference=np.full((30, 1), 0.3))
    for frame in (pd.DataFrame(columns), pl.DataFrame(columns), pa.table(columns)):
        found = smooth_record(discrete(True), frame, time="when", reference="phase")
        assert type(found) is type(frame)
        table = pa.table(found.reset_index() if hasattr(found, "reset_index") else found)
        assert table.column_names == ["when", "w[0]", "w[1]"]
        shift = np.timedelta64(round(1e9 * (DT - discrete().delay)), "ns")
        assert_array_equal(table["when"].to_numpy(), times + shift)
        assert_array_equal(np.column_stack([table["w[0]"], table["w[1]"]]), expected)
        with pytest.raises(
            ValueError, match=r"column 0 \('when'\) looks like times: say time='when'"
        ):
            smooth_record(discrete(True), frame, reference="phase")


@pytest.mark.parametrize("kind", ["DataArray", "Dataset"])
@pytest.mark.parametrize("index", ["seconds", "dates", "lengths of time"])
def test_the_coordinate_of_xarray_is_the_clock(kind, index):
    index = INDICES[index].rename("t")
    frame = pd.DataFrame(Y, index=index, columns=["I", "Q"])
    source = xr.DataArray(frame) if kind == "DataArray" else xr.Dataset(frame)
    found = smooth_record(discrete(), source)
    assert type(found) is type(source)
    assert found.sizes["t"] == 30
    assert_array_equal(found.to_pandas(), estimates())
    expected = smooth_record(discrete(), frame).index
    assert_array_equal(found["t"], expected)
    with pytest.raises(ValueError, match="is 2 samples after"):
        smooth_record(discrete(), source.isel(t=[0, 1, 3]))


# --- without ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "source",
    {
        "list": Y.tolist(),
        "Fortran": np.asfortranarray(Y),
        "float32": Y.astype(np.float32),
        "masked": np.ma.masked_array(np.nan_to_num(Y, nan=7.0), np.isnan(Y)),
    }.values(),
    ids=["list", "Fortran", "float32", "masked"],
)
def test_an_array_gives_an_array(source):
    found = smooth_record(discrete(), source, chunk=7)
    assert type(found) is np.ndarray
    y = Y.astype(np.float32) if getattr(source, "dtype", None) == np.float32 else Y
    assert_array_equal(found, discrete().run(y))


def test_one_measurement_may_be_a_vector_or_a_series():
    y = record(30, 1)[:, 0]
    expected = single().run(y)
    frame = pd.Series(y, index=INDICES["dates"], name="signal")
    series = [frame, frame.reset_index(drop=True), pl.Series("signal", y), xr.DataArray(frame)]
    for source in (y, y.tolist(), *series):
        found = smooth_record(single(), source)
        if isinstance(found, pl.DataFrame):
            assert found.columns == ["time", "w[0]"]
            found = found.select("w[0]")
        assert_array_equal(found, expected)


MISSING = {
    "nan": pd.DataFrame(Y, columns=["I", "Q"]),
    "NA": pd.DataFrame(Y, columns=["I", "Q"]).convert_dtypes(),
    "None": pd.DataFrame(Y.astype(object), columns=["I", "Q"]).replace({np.nan: None}),
    "null": pl.DataFrame(Y, schema=["I", "Q"], nan_to_null=True),
    "of arrow": pa.table({"I": pa.array(Y[:, 0], from_pandas=True), "Q": Y[:, 1]}),
}


@pytest.mark.parametrize("frame", MISSING.values(), ids=MISSING)
def test_what_is_missing_is_a_gap(frame):
    found = pa.table(smooth_record(discrete(), frame))
    assert_array_equal(np.column_stack([found["w[0]"], found["w[1]"]]), estimates())


# --- an iterator --------------------------------------------------------------------------------


def test_an_iterator_is_smoothed_as_it_comes():
    taken, smoother = [], discrete()

    def live():
        for i in range(0, 30, 10):
            taken.append(i)
            yield Y[i : i + 10]

    found = smooth_record(smoother, live())
    for i in range(0, 30, 10):
        assert_array_equal(next(found), estimates()[i : i + 10])
        assert taken[-1] == i
        assert smoother.samples == i + 10
    assert next(found, None) is None


@pytest.mark.parametrize("kind", ["pandas", "polars", "arrow"])
def test_the_clock_goes_on_from_chunk_to_chunk(tmp_path, kind):
    columns = {"when": CLOCKS["dates"], "I": Y[:, 0], "Q": Y[:, 1]}
    frame = pl.DataFrame(columns) if kind == "polars" else pd.DataFrame(columns)
    if kind == "arrow":
        chunks = pa.table(frame).to_batches(max_chunksize=11)
    else:
        chunks = [frame[:11], frame[11:11], frame[11:22], frame[22:]]
    found = np.concatenate([*smooth_record(discrete(), iter(chunks), time="when")])
    assert_array_equal(found, estimates())
    lost = [chunks[0], chunks[-1]]
    with pytest.raises(ValueError, match=r"row 11, column 0 .* is 12 samples after"):
        list(smooth_record(discrete(), iter(lost), time="when"))
    assert smooth_record(discrete(), iter(chunks), tmp_path / "w.csv", time="when") == 30
    smooth_record(discrete(), frame, tmp_path / "v.csv", time="when")
    assert (tmp_path / "w.csv").read_bytes() == (tmp_path / "v.csv").read_bytes()


def test_a_frame_is_written_to_a_file(tmp_path):
    for name, index in INDICES.items():
        frame = pd.DataFrame(Y, index=index, columns=["I", "Q"])
        assert smooth_record(discrete(), frame, tmp_path / "w.csv") == 30
        line = (tmp_path / "w.csv").read_text().splitlines()[1]
        first = {"seconds": "1790000000.1", "lengths of time": "-0.4"}.get(name, "2026-")
        assert line.startswith(first), name


# --- refusals -----------------------------------------------------------------------------------

UNITS = pint.UnitRegistry()
REFUSED = {
    "too few columns": (Y[:, :1], ValueError, "must name 2 columns of source, got 1: column 0$"),
    "transposed": (Y.T, ValueError, r"2 columns of source, got 30: .*column 9; its .T has a row"),
    "cube": (np.ones((3, 2, 2)), ValueError, r"source must be an array \(N, columns\), got"),
    "number": (1.0, ValueError, "source must be an array"),
    "iterator of numbers": (np.ones(3).flat, ValueError, "source must be an array"),
    "nothing": (None, TypeError, "source must be an array of numbers, got entries of type object"),
    "words": ([["a", "b"]], TypeError, "source must be an array of numbers"),
    "infinity": (np.full((3, 2), np.inf), ValueError, "source, row 0, column 0: inf where there"),
    "quantity": (Y * UNITS.V, TypeError, "source must be numbers without a unit, got a Quantity"),
    "objects": (pd.DataFrame({"I": [object()], "Q": [0]}), ValueError, "source: .*type object"),
    "booleans": (pd.DataFrame({"I": [True], "Q": [False]}), TypeError, "source, column 0 .*bool"),
    "text": (pl.DataFrame({"I": ["a"], "Q": [1.0]}), ValueError, "source: .*(string|'a')"),
    "long integers": (pd.DataFrame({"I": [10**30], "Q": [1]}), ValueError, "source: .*too large"),
    "two levels": (
        pd.DataFrame(Y, index=pd.MultiIndex.from_product([range(5), range(6)])),
        ValueError,
        "source must have .* an index of one level",
    ),
    "names of an index": (pd.DataFrame(Y, index=30 * ["a"]), ValueError, "source: .*'a'"),
    "an iterator of numbers": (iter([1.0]), ValueError, "source must be an array"),
    "an empty iterator": (iter([]), ValueError, "2 columns of source, got 0"),
    "other columns later": (
        iter([pl.DataFrame(Y[:3], schema=["I", "Q"]), pl.DataFrame(Y[3:], schema=["Q", "I"])]),
        ValueError,
        "source must have the same columns, of one kind, in each chunk",
    ),
}


@pytest.mark.parametrize(("source", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_record_is_refused(source, error, message):
    smoother = discrete()
    with pytest.raises(error, match=message) as raised:
        list(smooth_record(smoother, source))
    assert len(str(raised.value)) < 400
    if "later" not in message and "each chunk" not in message:
        assert smoother.samples == 0


def test_an_index_that_is_the_name_of_another_column_is_refused():
    frame = pd.DataFrame(Y)  # called 0 and 1
    assert_array_equal(smooth_record(discrete(), frame, columns=[0, 1]), estimates())
    for columns in ([1, 0], [0, 1]):
        with pytest.raises(ValueError, match=r"source has another column named [01]: say"):
            smooth_record(discrete(), frame[[1, 0]], columns=columns)
    found = smooth_record(discrete(), frame[[1, 0]], columns=["0", "1"])
    assert_array_equal(found, estimates())


def test_a_file_wants_a_target(tmp_path):
    (tmp_path / "y.csv").write_text(csv_text(Y))
    for options in ({}, {"resume": True}):
        with pytest.raises(TypeError, match="target must be given where source is a file"):
            smooth_record(discrete(), tmp_path / "y.csv", **options)
    with pytest.raises(ValueError, match="missing are for CSV files, not ndarray"):
        smooth_record(discrete(), Y, header=True)


# --- times that are not what they seem -----------------------------------------------------------


def test_periods_are_refused_as_they_are_no_instants():
    index = pd.period_range("2024-01-01", periods=6, freq="s")
    with pytest.raises(
        TypeError, match=r"column 2 \('time'\), must hold real numbers or dates, got"
    ):
        smooth_record(discrete(), pd.DataFrame(Y[:6], columns=["I", "Q"], index=index))


@pytest.mark.parametrize("turned", [slice(None, None, -1), slice(None, None, 2)])
def test_a_counting_index_with_rows_left_out_or_turned_round_is_refused(turned):
    frame = pd.DataFrame(Y, columns=["I", "Q"]).iloc[turned]
    with pytest.raises(ValueError, match="source must have all its rows in order, got steps of"):
        smooth_record(discrete(), frame)


def test_an_iterator_keeps_the_kind_of_its_times():
    zoned = pd.date_range("2024-01-01", periods=6, freq="100ms", tz="Asia/Tokyo")
    parts = (
        pd.DataFrame(Y[:6], columns=["I", "Q"], index=i) for i in (zoned, zoned.tz_localize(None))
    )
    with pytest.raises(ValueError, match="the same columns, of one kind, in each chunk"):
        list(smooth_record(discrete(), parts))


def test_floats_that_cannot_tell_samples_apart_are_refused():
    times = 1.7e9 + 1e-7 * np.arange(6)
    frame = pd.DataFrame(np.column_stack([times, Y[:6]]), columns=["t", "I", "Q"])
    system = discrete().estimator.plant.system  # with a short delay: the ring of samples is small
    smoother = baselines.fixed_lag_smoother(system, 1e-6, 2).discretize(1e-7)
    with pytest.raises(ValueError, match="do not tell samples of 1e-07 s apart: give dates"):
        smooth_record(smoother, frame, time="t", regular=False)


@pytest.mark.parametrize("columns", [0.0, False, slice(0, 2)])
def test_columns_are_indices_or_names(columns):
    with pytest.raises(TypeError, match="columns must be an integer, got"):
        smooth_record(discrete(), Y, columns=columns)


def test_without_a_clock_arrays_follow_an_irregular_record():
    smoother = discrete()
    smoother.run(Y[:3], intervals=[0.1, 0.2, 0.3])
    assert smooth_record(smoother, Y[3:]).shape == (len(Y) - 3, smoother.m)
