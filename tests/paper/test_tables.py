"""The tables of what lies beyond the paper: what is in their cells."""

from dataclasses import replace

import numpy as np
import pytest

from robsmooth import (
    InfeasibleDesignError,
    Uncertainty,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
    limiting_smoother,
    simulate,
    stationary_errors,
)
from robsmooth.analysis.choice import Candidate, Choice, Judgement, judge
from robsmooth.estimators import baselines
from robsmooth.homodyne.study import QUANTITIES, Study
from robsmooth.paper import tables

SYSTEM = homodyne.PAPER.uncertain_system()
PLANT = augment(SYSTEM, 3.1e-6, 1)


def test_candidates_have_the_errors_that_they_were_judged_by():
    classical = baselines.fixed_lag_smoother(SYSTEM, 3.1e-6, 1, copies=True)
    found = {
        "classical": Candidate(classical, judge(classical)),
        "refused": Candidate(None, Judgement(np.inf, np.inf, np.inf), "Assumption 9 fails: a test"),
    }
    choice = Choice(classical, "classical", found, "admissible", "smoothed")
    more = {"with the sine": {"classical": stationary_errors(homodyne.PAPER, classical).smoothed}}
    table = tables.candidates(choice, more)
    assert table.columns[:5] == (
        "smoother",
        "nominal",
        "worst constant",
        "certified",
        "with the sine",
    )
    first, second = table.rows
    assert first[1:4] == tuple(vars(judge(classical)).values())
    assert first[4] == more["with the sine"]["classical"]
    assert second[0] == "refused" and set(second[1:]) == {None}


def test_a_lag_is_judged_by_the_orders_that_stay_in_lock_there():
    quantities = {name: np.full((1, 4, 2, 2), 0.08) for name in QUANTITIES}
    # at each noise, the errors of two orders at two lags; of the last two noises there are none
    smoothed = [[[0.04, np.nan], [0.06, 0.072]], [[0.04, np.nan], [0.06, np.nan]]]
    none = np.full((2, 2), np.nan)
    quantities["smoothed"] = np.array([[*smoothed, none, none]])
    failures = {(0.4, 4.0): "Assumption 3 fails"}
    found = Study((0.4,), (1.0, 2.0, 3.0, 4.0), (1, 2), (1e-6, 3e-6), quantities, failures)
    table = tables.study(found, 3e-6)
    columns = [table.columns.index(name) for name in ("order", "saved", "saved at 3 µs")]
    rows = [[row[column] for column in columns] for row in table.rows]
    assert rows == [["1", "50%", "10%"], ["1", "50%", "none"], [None] * 3, [None] * 3]
    assert [row[-1] for row in table.rows[2:]] == ["no lock", "no design"]


def test_the_example_is_the_same_in_every_unit():
    seconds, years = tables.in_units({"s": 1.0, "years": 3.2e7}).rows
    assert seconds[1:] == pytest.approx(years[1:], rel=1e-9)


def test_refusals_quote_the_library_and_nothing_else():
    def refuse(plant):
        raise InfeasibleDesignError("Assumption 9", f"for a test of {plant.n} states")

    plant = augment(SYSTEM, 3.1e-6, 2)
    silent = augment(replace(SYSTEM, D21=[[0.0, 0.0]]), 3.1e-6, 2)
    table = tables.refusals({"bad": (plant, refuse), "good": (silent, lambda plant: None)})
    said = ["Assumption 9 fails: for a test of 3 states", "not refused"]
    assert [row[1] for row in table.rows] == said
    assert [row[2] for row in table.rows] == ["not refused", "A measurement's noise fails"]
    with pytest.raises(ZeroDivisionError):
        tables.refusals({"broken": (plant, lambda plant: 1 / 0)})


def test_judged_systems_have_their_three_errors():
    table = tables.judged({("mine", "classical"): Judgement(1.0, 2.0, 3.0)})
    assert table.columns[2:] == ("nominal", "worst constant", "certified")
    assert table.rows == [("mine", "classical", 1.0, 2.0, 3.0)]


def test_own_systems_are_predicted_by_their_equivalent_slopes():
    # without its literal nonlinearity the example is linear, and the prediction exact
    linear = replace(SYSTEM, nonlinearities=())
    design = design_smoother(augment(_with_noise_channel(linear), 3.1e-6, 1), 1e-6, [0.9, 0.9])
    found = simulate(design, runs=64, duration=1e-4)
    (row,) = tables.own_systems({"linear": (design, found)}).rows
    exact = error_covariance(design, design.plant.structured_delta(), loop="real")[0, 0]
    assert row[2] == pytest.approx(exact, rel=1e-12)
    assert row[5] == design.mean_square_bound


def test_own_system_with_a_detector_is_predicted_with_its_reference():
    design = limiting_smoother(augment(SYSTEM, 3.1e-6, 2), 1.1e-6, [1.0, 0.5, 0.0, 0.0])
    found = simulate(design, runs=64, duration=1e-3)
    (row,) = tables.own_systems({"the paper's": (design, found)}).rows
    assert row[2] == pytest.approx(found.smoothed.mean_square, rel=0.02)


def _with_noise_channel(system):
    channel = Uncertainty([[0.0]], [[0.0]], system.D21[:, 1:])
    return replace(system, uncertainties=(*system.uncertainties, channel))
