"""The least errors with the sine: by Bayes' rule on a grid, and the file that keeps them."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks import nonlinear_floor
from benchmarks.nonlinear_floor import SampledLoop
from robsmooth.estimators import baselines
from robsmooth.estimators.minimax import minimax_smoother
from robsmooth.homodyne import PAPER
from robsmooth.homodyne.moments import stationary_errors
from robsmooth.homodyne.montecarlo import MeanSquare
from robsmooth.paper import published
from robsmooth.systems.augmented import augment


def read(folder):
    """The least mean squares of a folder's file, by the estimate."""
    found = json.loads((folder / published.NONLINEAR_FLOOR).read_text(encoding="utf-8"))
    return {output: MeanSquare(**found[output]) for output in nonlinear_floor.OUTPUTS}


@pytest.fixture(scope="module")
def floor():
    return read(published.data_folder())


def test_without_the_sine_the_estimates_are_those_of_the_kalman_smoother_and_filter():
    loop = SampledLoop(PAPER, published.DELAY, lag=16, linear=True)
    smoothed, filtered, kalman_smoothed, kalman_filtered = loop.errors(2, 30, seed=(1,))
    assert_allclose(smoothed, kalman_smoothed, atol=1e-6)
    assert_allclose(filtered, kalman_filtered, atol=1e-6)
    assert abs(smoothed - filtered).max() > 0.1  # they are estimates of different phases


def test_the_linear_errors_are_those_of_the_simulated_noise():
    loop = SampledLoop(PAPER, published.DELAY, lag=16)
    squares = np.square(loop.errors(48, 60, seed=(2,))[2:]).mean(axis=2)
    deviations = squares.std(axis=1, ddof=1) / np.sqrt(squares.shape[1])
    # A correct program fails one of two once in 150 000 seeds.
    assert (abs(squares.mean(axis=1) - loop.linear_errors) < 4.5 * deviations).all()


def test_the_linear_errors_go_to_those_without_a_step():
    system = PAPER.uncertain_system()
    exact = [baselines.optimal_fixed_lag_error(system, lag)[0, 0] for lag in (published.DELAY, 0.0)]
    coarse, fine = (SampledLoop(PAPER, published.DELAY, lag).linear_errors for lag in (500, 1000))
    assert_allclose(2.0 * fine - coarse, exact, rtol=1e-5)


def test_a_control_takes_off_what_chance_has_in_common():
    random = np.random.default_rng(3)
    common, own = random.standard_normal((2, 400)), 1e-3 * random.standard_normal((2, 400))
    means, deviations = nonlinear_floor.with_control(
        np.vstack([7.0 + 2.0 * common + own, common + 1.0]), np.ones(2)
    )
    assert_allclose(deviations, 1e-3 / 20.0, rtol=0.2)
    assert (abs(means - 7.0) < 4.5 * deviations).all()


def test_a_step_that_adds_in_proportion_is_extrapolated_away():
    loops = [SampledLoop(PAPER, published.DELAY, lag) for lag in (8, 16)]
    chance = np.random.default_rng(4).standard_normal((4, 64))
    squares = [loop.linear_errors[[0, 1, 0, 1], None] + 1e-9 * chance for loop in loops]
    for loop, values in zip(loops, squares, strict=True):
        values[:2] += 1e-3 + 50.0 * loop.step
    found = nonlinear_floor.summary(loops, squares, np.array([0.05, 0.09]))
    assert found["smoothed"]["mean_square"] == pytest.approx(0.051, rel=1e-6)
    assert found["filtered"]["mean_square"] == pytest.approx(0.091, rel=1e-6)
    assert found["steps"][1]["samples"] == 64 * nonlinear_floor._SAMPLES


def test_the_command_writes_what_it_measures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(nonlinear_floor, "data_folder", lambda: tmp_path)
    for name, value in {"LAGS": (4, 8), "_RUNS": 4, "_SAMPLES": 5}.items():
        monkeypatch.setattr(nonlinear_floor, name, value)
    assert nonlinear_floor.main(["--seconds", "0.01"]) == 0
    printed = capsys.readouterr().out
    for name, error in read(tmp_path).items():
        assert f"{name}: {error.mean_square:.6f} ± {error.standard_error:.6f} rad²" in printed
    (path,) = tmp_path.iterdir()
    about = json.loads(path.read_text(encoding="utf-8"))["about"]
    assert about["command"] == "python -m benchmarks.nonlinear_floor --seconds 0.01"


@pytest.mark.parametrize("text", ["0", "-1", "inf", "nan"])
def test_a_time_that_is_none_is_refused(text, capsys):
    with pytest.raises(SystemExit, match="2"):
        nonlinear_floor.main(["--seconds", text])
    assert "--seconds must be a number above zero" in capsys.readouterr().err


def test_the_floor_is_above_the_optimum_without_the_sine(floor):
    system = PAPER.uncertain_system()
    for output, lag in (("smoothed", published.DELAY), ("filtered", 0.0)):
        least = baselines.optimal_fixed_lag_error(system, lag)[0, 0]
        assert floor[output].mean_square - 4.5 * floor[output].standard_error > least


def test_no_estimator_is_below_the_floor(floor):
    system = PAPER.uncertain_system()
    plant = augment(system, published.DELAY, published.ORDER)
    estimators = dict(published.designs()) | {"minimax": minimax_smoother(plant)}
    for order in (2, 8):
        name = f"classical, order {order}"
        estimators[name] = baselines.fixed_lag_smoother(system, published.DELAY, order, copies=True)
    for name, estimator in estimators.items():
        errors = stationary_errors(PAPER, estimator)
        for output in ("smoothed", "filtered") if estimator.plant.delay else ("filtered",):
            least = floor[output].mean_square - 4.5 * floor[output].standard_error
            assert getattr(errors, output) > least, (name, output)
