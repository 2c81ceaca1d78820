"""The tables of what lies beyond the paper: what is in their cells."""

from dataclasses import replace

import pytest

from robsmooth import (
    Uncertainty,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
    limiting_smoother,
    simulate,
)
from robsmooth.paper import tables

SYSTEM = homodyne.PAPER.uncertain_system()
PLANT = augment(SYSTEM, 3.1e-6, 1)


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
