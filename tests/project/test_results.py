"""Results as data frames, and drawn: what they hold is what was found."""

from dataclasses import replace

import numpy as np
import pytest

import robsmooth as rs
from tests.project.test_display import example

SYSTEM = rs.homodyne.PAPER.uncertain_system()
KALMAN = rs.baselines.kalman_bucy(SYSTEM)


@pytest.fixture(autouse=True)
def figures():
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    yield plt
    plt.close("all")


def lines(axes):
    return {line.get_label(): line for line in axes.lines}


def test_a_delta_sweep_is_its_array_and_its_frame():
    pytest.importorskip("pandas")
    sweep = rs.delta_sweep(KALMAN, [-1.0, 0.5], "filtered")
    singly = [rs.delta_sweep(KALMAN, [slope], "filtered")[0, 0, 0] for slope in (-1.0, 0.5)]
    np.testing.assert_allclose(np.asarray(sweep)[:, 0, 0], singly, rtol=1e-12)
    np.testing.assert_array_equal(sweep / 2 + 2 * sweep, 2.5 * sweep[:])
    assert sweep.shape == (2, 1, 1) and sweep.max() == max(sweep[:, 0, 0])
    assert repr(sweep) == repr(sweep.covariances)
    frame = sweep.to_frame()
    assert frame.columns.tolist() == ["slope", "mean_square"]
    np.testing.assert_array_equal(frame.slope, [-1.0, 0.5])
    np.testing.assert_array_equal(frame.mean_square, sweep[:, 0, 0])
    with pytest.raises(AttributeError):
        getattr(sweep, "nonsense")  # noqa: B009


def test_the_mean_square_of_several_outputs_is_their_sum():
    two = replace(SYSTEM, C0=[[1.0], [2.0]])
    sweep = rs.delta_sweep(rs.baselines.kalman_bucy(two), [0.0], "filtered")
    one = rs.delta_sweep(KALMAN, [0.0], "filtered")[0, 0, 0]
    assert sweep.mean_square[0] == pytest.approx(5.0 * one)


def test_a_lag_sweep_has_a_row_for_each_order_and_lag():
    pytest.importorskip("pandas")
    sweep = rs.lag_sweep(SYSTEM, [1e-6, 2e-6, 3e-6], [1, 2])
    frame = sweep.to_frame()
    assert len(frame) == 6
    for o, order in enumerate(sweep.orders):
        for i, lag in enumerate(sweep.lags):
            row = frame[(frame.order == order) & (frame.lag == lag)].iloc[0]
            assert row.nominal == sweep.nominal[o, i] and row.worst == sweep.worst[o, i]
            assert row.optimal == sweep.optimal[i]
    for error in ("nominal", "worst"):
        drawn = lines(sweep.plot(error=error))
        np.testing.assert_array_equal(drawn["order 2"].get_ydata(), getattr(sweep, error)[1])
        np.testing.assert_array_equal(drawn["exact optimum"].get_ydata(), sweep.optimal)
        np.testing.assert_array_equal(drawn["order 1"].get_xdata(), sweep.lags)
    with pytest.raises(
        ValueError, match="error must be one of 'nominal', 'worst', got 'certified'"
    ):
        sweep.plot(error="certified")


def test_paths_have_a_row_for_each_path_and_time():
    pytest.importorskip("pandas")
    paths = rs.sample_paths(example("Estimator"), runs=2, duration=1e-5)
    frame = paths.to_frame()
    assert len(frame) == paths.y.shape[0] * paths.y.shape[1]
    second = frame[frame.path == 1]
    np.testing.assert_array_equal(second.time, paths.time)
    for name in ("y", "reference", "w", "filtered", "delayed", "smoothed"):
        np.testing.assert_array_equal(second[f"{name}[0]"], getattr(paths, name)[1, :, 0])
    drawn = lines(paths.plot(path=1))
    np.testing.assert_array_equal(drawn["true"].get_ydata(), paths.w[1, :, 0])
    shifted = drawn["smoothed"].get_xdata()
    np.testing.assert_allclose(shifted, paths.time - paths.delay, rtol=0, atol=1e-18)
    np.testing.assert_array_equal(drawn["smoothed"].get_ydata(), paths.smoothed[1, :, 0])
    np.testing.assert_array_equal(drawn["filtered"].get_xdata(), paths.time)


def test_a_study_has_a_row_for_each_point_of_its_grid():
    pytest.importorskip("pandas")
    shape = (2, 2, 1, 3)
    values = np.arange(12.0).reshape(shape)
    quantities = {name: values + i for i, name in enumerate(("bound", "smoothed", "filtered"))}
    quantities |= {"optimal": values, "optimal_filtered": 1.0 + values}
    study = rs.Study((0.3, 0.4), (1.0, 2.0), (2,), (1e-6, 2e-6, 3e-6), quantities, {})
    frame = study.to_frame()
    row = frame[(frame.gamma == 0.4) & (frame.noise == 1.0) & (frame.lag == 3e-6)].iloc[0]
    assert row.bound == values[1, 0, 0, 2] and row.order == 2 and len(frame) == 12
    drawn = lines(study.plot(gamma=0.3, noise=2.0))["order 2"]
    np.testing.assert_array_equal(drawn.get_ydata(), study.ratio[0, 1, 0])
    with pytest.raises(ValueError, match=r"gamma must be one of 0\.3, 0\.4, got 0\.7"):
        study.plot(gamma=0.7)


def test_a_choice_has_a_row_for_each_candidate():
    pytest.importorskip("pandas")
    choice = example("Choice")
    frame = choice.to_frame().set_index("smoother")
    assert frame.index.tolist() == list(choice.candidates)
    for name, each in choice.candidates.items():
        assert frame.loc[name, "certified"] == each.judgement.certified
        assert frame.loc[name, "refused"] == each.refused


def test_a_sweep_is_drawn_into_the_axes_that_are_given(figures):
    _, axes = figures.subplots()
    before = len(axes.lines)
    assert rs.delta_sweep(KALMAN, [0.0, 1.0]).plot(axes, "mine") is axes
    assert axes.lines[before].get_label() == "mine"


def test_curves_are_told_apart_in_a_style_without_dashes(figures):
    with figures.style.context("default"):
        drawn = rs.lag_sweep(SYSTEM, [1e-6, 2e-6], [1, 2, 3, 4]).plot().lines
        assert len({line.get_linestyle() for line in drawn[1:]}) > 2
        assert len({line.get_color() for line in drawn}) == 5
