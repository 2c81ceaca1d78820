"""Records against their model: how often the check is wrong, and what it finds."""

import re

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import stats

import robsmooth as rs
from robsmooth._numerics.lyapunov import covariances
from tests.helpers.records import simulated

DT, ROWS = 0.1, 400
SENSORS = rs.UncertainSystem(
    A=[[-1.0, 0.5], [0.0, -2.0]],
    B1=[[1.0, 0.0, 0.2, 0.0], [0.3, 1.0, 0.0, 0.0]],
    C0=[[1.0, 0.0]],
    C2=[[1.0, 1.0], [0.0, 1.0]],
    D21=[[0.1, 0.0, 0.4, 0.0], [0.1, 0.0, 0.0, 0.3]],
)


def record(system, rng, rows=ROWS, gaps=0.1):
    start = np.linalg.cholesky(covariances(system.A, system.B1).stationary)
    y, _ = simulated(system, DT, rows, rng, start @ rng.standard_normal(system.n))
    y[rng.random(y.shape) < gaps] = np.nan
    return y


def smoother(system=SENSORS):
    return rs.baselines.fixed_lag_smoother(system, 0.25, 2).discretize(DT)


def test_each_test_is_wrong_as_often_as_it_says():
    rng, discrete, runs = np.random.default_rng(0), smoother(), 300
    found = [rs.check_record(discrete, record(SENSORS, rng)) for _ in range(runs)]
    for name in ("p_mean", "p_mean_square", "p_white"):
        values = [getattr(each, name) for each in found]
        # a correct program fails once in 10 000 times at each, were the seed free
        assert stats.kstest(values, "uniform").pvalue > 1e-4, name
    assert discrete.samples == 0


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"D21": 1.5 * SENSORS.D21},
            r"innovations are 1\.\d+ times as large as the model says",
        ),
        (
            {"D21": 0.6 * SENSORS.D21},
            r"innovations are 0\.\d+ times as large as the model says",
        ),
        ({"A": [[-0.1, 0.5], [0.0, -0.1]]}, "are correlated in time"),
    ],
)
def test_another_system_is_found_out(changed, words):
    parts = {name: getattr(SENSORS, name) for name in ("A", "B1", "C0", "C2", "D21")}
    other = rs.UncertainSystem(**parts | changed)
    y = record(other, np.random.default_rng(1), rows=5000)
    assert re.search(words, rs.check_record(smoother(), y).sentence)
    assert rs.check_record(smoother(other), y).sentence == "The record agrees with the model."


def test_an_offset_is_found_out_and_taken_off():
    y = record(SENSORS, np.random.default_rng(2), rows=5000) + np.array([0.5, 0.0])
    assert "have a mean that is not zero" in rs.check_record(smoother(), y).sentence
    estimator = rs.baselines.kalman_bucy(SENSORS)
    right = estimator.discretize(DT, offset=[0.5, 0.0])
    assert rs.check_record(right, y).sentence == "The record agrees with the model."


def test_what_is_drawn_is_what_was_found():
    plt = pytest.importorskip("matplotlib.pyplot")
    y = record(SENSORS, np.random.default_rng(3))
    y[200:220] = np.nan
    found = rs.check_record(smoother(), y)
    along, between = found.plot()
    drawn = [line.get_ydata()[0] for line in between.lines]
    assert_array_equal(drawn, found.correlations[0].ravel())
    legend = [text.get_text() for text in along.figure.legends[0].get_texts()]
    assert legend[2] == "y[0] with y[1] before" and len({*legend}) == 5
    assert len({line.get_marker() for line in between.lines}) == 4  # told apart in grey, too
    assert len(along.lines[0].get_xdata()) == 50
    drawn = np.array(along.lines[0].get_ydata())
    assert np.isnan(drawn[25:27]).all() and np.isfinite(np.delete(drawn, [25, 26, 27])).all()
    assert np.nanmean(drawn) == pytest.approx(found.mean_square, rel=0.02)
    assert along.get_xlabel() == "time (s)"
    assert plt.gcf() is along.figure  # pyplot shows it, in a notebook, too
    plt.close(along.figure)
    figure, given = plt.subplots(2)
    assert found.plot(given) == tuple(given)
    assert given[1].lines and not figure.legends  # these are the giver's
    plt.close(figure)


def test_what_is_too_short_to_tell_is_not_told():
    found = rs.check_record(smoother(), record(SENSORS, np.random.default_rng(4), rows=60))
    assert np.isnan(found.p_white) and np.isnan(found.correlations).all()
    assert found.sentence == "The record agrees with the model."
    one = rs.UncertainSystem([[-1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.3]])
    systems = (SENSORS, 110, 10), (one, 70, 14)  # too few pairs, and too large a part of it
    for system, rows, told in systems:
        longer = record(system, np.random.default_rng(4), rows=rows, gaps=0.0)
        found = rs.check_record(smoother(system), longer).correlations
        assert np.isfinite(found[:told]).all() and np.isnan(found[told:]).all()


def test_the_start_of_a_drift_is_no_disagreement():
    walk = rs.examples.random_walk()
    rng, discrete = np.random.default_rng(5), rs.baselines.kalman_bucy(walk).discretize(DT)
    for start in (0.0, 1e8):
        y, _ = simulated(walk, DT, 1000, rng, np.array([start]))
        found = rs.check_record(discrete, y)
        assert found.sentence == "The record agrees with the model."
        assert np.isnan(found.innovations[0]) and np.isfinite(found.innovations[1:]).all()


def test_a_file_is_no_record_in_memory():
    with pytest.raises(TypeError, match=r"y must be .* no file: pandas\.read_csv reads 'y\.csv'"):
        rs.check_record(smoother(), "y.csv")


@pytest.mark.parametrize(
    ("y", "message"),
    [
        (np.zeros((20, 2)), "y must have more than 20 rows"),
        (np.full((50, 2), np.nan), r"with \[0, 0\] samples"),
        (np.zeros((50, 3)), r"y must have shape \(N, 2\)"),
    ],
)
def test_what_is_no_record_is_refused(y, message):
    with pytest.raises(ValueError, match=message):
        rs.check_record(smoother(), y)
