"""The parameter study: each entry against the design that it is of, and what a long run needs."""

import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import robsmooth as rs
from robsmooth._support.checkpoint import CheckpointError
from robsmooth.homodyne import study as study_module
from robsmooth.homodyne.study import QUANTITIES, parameter_study
from tests.helpers.clusters import cluster_of_threads

PAPER = rs.homodyne.PAPER
GRID = {"lags": (1e-6, 3.1e-6), "orders": (1, 2), "gammas": (0.4,), "noises": (0.5, 1.0)}
RUNS = 128


@pytest.fixture(scope="module")
def found():
    return parameter_study(PAPER, **GRID, runs=RUNS)


def same(one, other):
    for name in QUANTITIES:
        assert_array_equal(one.quantities[name], other.quantities[name])
    assert one.failures == other.failures


def test_entries_are_those_of_the_designs(found):
    loop = rs.homodyne.HomodyneParameters(9.14e3, 4e4, 1162.0 / math.sqrt(0.5), 1.0, 0.4)
    system = loop.uncertain_system()
    best = rs.minimize_bound(rs.augment(system, 0.0, 0))
    design = rs.design_smoother(rs.augment(system, 3.1e-6, 2), best.tau, best.multipliers)
    simulated = rs.monte_carlo(loop, design, runs=RUNS)
    at = {name: values[0, 0, 1, 1] for name, values in found.quantities.items()}
    assert at["bound"] == pytest.approx(best.mean_square_bound, rel=1e-9)
    for name, slope in (("nominal", 0.0), ("edge", -1.0)):
        Delta = design.plant.structured_delta((), [slope])
        linear = rs.error_covariance(design, Delta, loop="real")[0, 0]
        assert at[name] == pytest.approx(linear, rel=1e-9)
    assert at["smoothed"] == simulated.smoothed.mean_square
    assert at["smoothed_error"] == simulated.smoothed.standard_error
    assert at["filtered"] == simulated.filtered.mean_square
    assert at["slip_rate"] == 0.0
    assert at["optimal"] == rs.baselines.optimal_fixed_lag_error(system, 3.1e-6)[0, 0]
    kalman = rs.baselines.kalman_bucy(system)
    linear = rs.error_covariance(kalman, kalman.plant.structured_delta(), "filtered", "real")[0, 0]
    assert at["optimal_filtered"] == pytest.approx(linear, rel=1e-9)


def test_optimal_ratio_begins_at_one_and_falls_as_the_measurement_tells(monkeypatch):
    # the optimum falls at first as dP/d(lag) = -P R^-1 P, with 1/R = (2 alpha beta)^2
    monkeypatch.setattr(study_module, "_measure", lambda *_: {})
    lags = np.array([1e-12, 1e-10, 1e-6])
    study = parameter_study(PAPER, lags, orders=[1, 2], gammas=[0.3, 0.4], noises=[1.0])
    ratio, P = study.optimal_ratio, study.quantities["optimal_filtered"][0, 0, 0, 0]
    assert ratio.shape == (2, 1, 2, 3)
    assert_array_equal(ratio, np.broadcast_to(ratio[:1, :, :1], ratio.shape))
    fall = 1.0 - ratio[0, 0, 0]
    assert fall[0] < 1e-6
    assert fall[1] == pytest.approx(P * (2 * PAPER.alpha) ** 2 * lags[1], rel=1e-3)
    assert 0.2 < fall[2] < 0.5


def test_search_of_a_column_serves_every_lag_and_order(found):
    # The bound that a search over the whole design finds is the one of the column.
    bounds = found.quantities["bound"]
    np.testing.assert_allclose(
        bounds, np.broadcast_to(bounds[:, :, :1, :1], bounds.shape), rtol=1e-6
    )
    whole = rs.minimize_bound(rs.augment(PAPER.uncertain_system(), 3.1e-6, 2), "filtered")
    assert bounds[0, 1, 0, 0] == pytest.approx(whole.mean_square_bound, rel=1e-4)


def test_smoothing_pays_and_less_noise_is_better(found):
    quantities = found.quantities
    assert (quantities["smoothed"] < quantities["filtered"]).all()
    assert (quantities["optimal"] < quantities["nominal"]).all()
    assert (quantities["nominal"] < quantities["edge"]).all()
    assert (quantities["filtered"][:, 0] < quantities["filtered"][:, 1]).all()
    assert "1 gammas x 2 noises x 2 orders x 2 lags: 8 designs" in repr(found)


def test_interrupted_study_resumes_to_the_same_bits(found, tmp_path, monkeypatch):
    path = tmp_path / "study.txt"
    column, calls = study_module._column, []

    def interrupted(number, loop, **arguments):
        calls.append(loop)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return column(number, loop, **arguments)

    monkeypatch.setattr(study_module, "_column", interrupted)
    with pytest.raises(KeyboardInterrupt):
        parameter_study(PAPER, **GRID, runs=RUNS, checkpoint=path)
    same(parameter_study(PAPER, **GRID, runs=RUNS, checkpoint=path), found)
    assert len(calls) == 3  # the first column was not computed again
    same(parameter_study(PAPER, **GRID, runs=RUNS, checkpoint=path), found)
    assert len(calls) == 3
    with pytest.raises(CheckpointError, match="seed"):
        parameter_study(PAPER, **GRID, runs=RUNS, checkpoint=path, seed=1)


def test_a_cluster_gives_the_same_bits(found):
    with cluster_of_threads() as (_, client):
        same(parameter_study(PAPER, **GRID, runs=RUNS, client=client), found)


def test_column_without_a_design_says_why(monkeypatch):
    def infeasible(plant):
        raise rs.InfeasibleDesignError("Assumption 3.1", "it is too wide")

    monkeypatch.setattr(study_module, "minimize_bound", infeasible)
    found = parameter_study(PAPER, **GRID, runs=RUNS)
    assert set(found.failures) == {(0.4, 0.5), (0.4, 1.0)}
    assert "Assumption 3.1" in found.failures[0.4, 1.0]
    for name in ("bound", "smoothed"):
        assert np.isnan(found.quantities[name]).all()


def test_loss_of_lock_is_a_result():
    noisy = rs.homodyne.HomodyneParameters(9.14e3, 1e6, 1162.0, 1.0, 0.4)
    one = {"lags": [3.1e-6], "orders": [1], "gammas": [0.4], "noises": [1.0]}
    found = parameter_study(noisy, **one, runs=RUNS)
    assert found.quantities["slip_rate"].item() > 0


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"lags": []}, ValueError, "lags must be one or more different values"),
        ({"lags": [-1e-6]}, ValueError, "lags must be finite and in"),
        ({"lags": [1e-6, 1e-6]}, ValueError, "lags must be one or more different values"),
        ({"orders": [0]}, ValueError, "orders must be an integer of at least 1"),
        ({"orders": [1.5]}, TypeError, "orders must be an integer"),
        ({"gammas": [1.0]}, ValueError, "gamma must be"),
        ({"noises": [0.0]}, ValueError, "noises must be"),
        ({"runs": 1}, ValueError, "runs must be"),
        ({"seed": -1}, ValueError, "seed must be"),
        ({"progress": "yes"}, TypeError, "progress must be"),
        ({"client": "tcp://somewhere:8786"}, TypeError, "client must be"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        parameter_study(PAPER, **{**GRID, **change})
    with pytest.raises(TypeError, match="parameters must be a HomodyneParameters"):
        parameter_study(vars(PAPER), **GRID)
