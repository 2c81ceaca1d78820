"""The estimator with the least certified error: known optima, limits, invariances, other routes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import robsmooth as rs
from robsmooth._numerics.lyapunov import covariances
from robsmooth.estimators import minimax
from robsmooth.estimators.certificate import certify
from robsmooth.estimators.loop import matrices
from robsmooth.estimators.units import Natural
from tests.helpers.attacks import all_pass_error
from tests.helpers.certificates import certified
from tests.helpers.systems import (
    DRIVE,
    EXAMPLE,
    GAIN,
    cancelling,
    classical,
    driven,
    in_other_units,
    of_gain,
)

# Optima of an independent prototype of the programme, with other scaling.
OPTIMA = [
    (EXAMPLE, 3.1e-6, 2, "smoothed", 0.0886686),
    (EXAMPLE, 0.0, 0, "filtered", 0.1388071),
    (cancelling(DRIVE), 1.0, 4, "smoothed", 2.227633),
    (cancelling(DRIVE, GAIN), 1.0, 4, "smoothed", 2.736142),
    (cancelling(DRIVE), 0.0, 0, "smoothed", 3.127394),
    (of_gain(0.2), 0.2, 4, "smoothed", 0.0918279),
    (of_gain(0.05, 0.1), 0.2, 4, "smoothed", 0.0593954),
]

# Its measurement is so uncertain that the optimum is next to estimators without a certificate.
AT_THE_EDGE = rs.UncertainSystem(
    A=[[-1]],
    B1=[[1, 0]],
    C0=[[1]],
    C2=[[1]],
    D21=[[0, 0.1]],
    uncertainties=[rs.Uncertainty(B=[[0.5]], C=[[1]], D=[[3]])],
)


@pytest.mark.parametrize(("system", "delay", "order", "output", "optimum"), OPTIMA)
def test_known_optima_are_reached_with_a_certificate(system, delay, order, output, optimum):
    smoother = rs.minimax_smoother(rs.augment(system, delay, order), output)
    assert smoother.route == "semidefinite programme"
    assert_allclose(smoother.certified, optimum, rtol=1e-6)
    bound = rs.analysis_bound(smoother, loop="real")
    assert_allclose(bound.mean_square, smoother.certified, rtol=1e-6)


@pytest.mark.parametrize(("system", "delay", "order", "output", "optimum"), OPTIMA[:2])
def test_its_multipliers_are_those_of_the_certificate(system, delay, order, output, optimum):
    smoother = rs.minimax_smoother(rs.augment(system, delay, order), output)
    found = rs.analysis_bound(smoother, loop="real").multipliers
    difference = system.k  # the only constraint that counts
    assert_allclose(smoother.multipliers[difference], found[difference], rtol=1e-3)
    assert not np.delete(smoother.multipliers, difference).any()


@pytest.mark.parametrize(
    ("system", "delay", "order"), [(EXAMPLE, 3.1e-6, 2), (of_gain(0.2), 0.2, 4)]
)
def test_descent_from_the_classical_smoother_ends_at_the_same_error(
    system, delay, order, monkeypatch
):
    plant = rs.augment(system, delay, order)
    optimum = rs.minimax_smoother(plant).certified
    monkeypatch.setattr(minimax, "LARGEST", 0)
    by_descent = rs.minimax_smoother(plant)
    assert by_descent.route == "descent"
    assert_allclose(by_descent.certified, optimum, rtol=1e-5)


def test_descent_to_the_edge_of_what_has_a_certificate_is_no_worse_than_its_start(monkeypatch):
    plant, starts = rs.augment(AT_THE_EDGE, 0.1, 1), []
    optimum = rs.minimax_smoother(plant).certified
    monkeypatch.setattr(minimax, "LARGEST", 0)
    monkeypatch.setattr(minimax, "certify", lambda *of: starts.append(certify(*of)) or starts[-1])
    natural = Natural.of(plant, "smoothed")
    *_, found = minimax._by_descent(natural)
    assert found < min(value for value, *_ in starts)
    assert_allclose(natural.units.w**2 * found, optimum, rtol=1e-4)


@pytest.mark.parametrize("time", [1e-9, 1e9])
def test_it_does_not_depend_on_units(time):
    system = cancelling(DRIVE, GAIN)
    here = rs.minimax_smoother(rs.augment(system, 1.0, 4))
    other = in_other_units(system, time, [1e6, 1e-5], [1e4])
    there = rs.minimax_smoother(rs.augment(other, 1.0 / time, 4))
    assert_allclose(there.certified, here.certified, rtol=1e-6)
    assert_allclose(np.sort(there.poles.real), np.sort(here.poles.real) * time, rtol=1e-3)


@pytest.mark.parametrize("size", [0.2, 0.7])  # the second without a small gain
def test_what_a_copy_does_to_the_state_is_taken_off(size):
    plant = rs.augment(driven(size), 0.5, 2)
    smoother = rs.minimax_smoother(plant)
    assert smoother.route == "semidefinite programme"
    assert smoother.A_c.shape == (2 * plant.n, 2 * plant.n)
    assert_allclose(rs.analysis_bound(smoother, loop="real").mean_square, smoother.certified)
    # below the classical smoother with its copy, which knows of no difference
    assert smoother.certified <= certified(classical(plant, copies=True))


def test_a_copy_whose_states_an_uncertainty_sees_is_treated_by_descent():
    plant = rs.augment(driven(0.2, seen=True), 0.5, 2)
    smoother = rs.minimax_smoother(plant)
    assert smoother.route == "descent"
    for copies in (False, True):
        assert smoother.certified <= certified(classical(plant, copies))


@pytest.mark.parametrize(
    ("system", "delay"), [(of_gain(0.2), 0.2), (cancelling(DRIVE), 1.0), (EXAMPLE, 3.1e-6)]
)
def test_uncertainty_that_depends_on_the_frequency_stays_below_what_is_certified(system, delay):
    plant = rs.augment(system, delay, 3)
    smoother = rs.minimax_smoother(plant)
    modes = np.abs(np.linalg.eigvals(system.A)).max()
    Delta = rs.worst_case(smoother, "guaranteed", "real").Delta
    found = [
        all_pass_error(smoother, sign * Delta, rate)
        for rate in modes * np.geomspace(1e-3, 1e3, 31)
        for sign in (1.0, -1.0)
    ]
    assert max(found) <= smoother.certified * (1.0 + 1e-9)
    # where every rate of passing is slow, the uncertainty is constant
    constant = rs.error_covariance(smoother, Delta, "guaranteed", loop="real").trace()
    assert_allclose(all_pass_error(smoother, Delta, 1e9 * modes), constant, rtol=1e-5)


def test_the_filter_of_a_plant_with_a_delay_is_that_without_and_still_smooths():
    system = of_gain(0.2)
    filtered = rs.minimax_smoother(rs.augment(system, 0.2, 4), "filtered")
    alone = rs.minimax_smoother(rs.augment(system, 0.0, 0), "filtered")
    assert_allclose(filtered.certified, alone.certified, rtol=1e-7)
    nominal = np.zeros_like(filtered.plant.structured_delta())
    smoothed = rs.error_covariance(filtered, nominal, "smoothed").trace()
    assert smoothed < rs.error_covariance(filtered, nominal, "filtered").trace()


def test_an_uncertainty_that_could_destabilise_the_plant_is_refused_with_the_part_that_could_not():
    spring = rs.Uncertainty(B=[[0], [1]], C=[[1.0, 0]], D=[[0]])
    system = replace(driven(0.2), nonlinearities=(), uncertainties=[spring])
    with pytest.raises(rs.InfeasibleDesignError, match="could destabilise the plant") as caught:
        rs.minimax_smoother(rs.augment(system, 0.5, 2))
    fraction = float(str(caught.value).split("; ")[1].split()[0])
    # the small gain of the spring's loop, from its frequency response
    omega = np.linspace(0.0, 2.0, 20001)
    response = 1.0 / np.abs(0.8 - omega**2 + 0.5j * omega)
    assert_allclose(fraction, 1.0 / response.max(), atol=2e-3)


def test_noise_may_enter_where_no_uncertainty_does():
    plant = rs.augment(cancelling(DRIVE), 1.0, 2)
    with pytest.raises(rs.InfeasibleDesignError, match="Assumption 1"):
        rs.minimize_bound(plant)
    assert np.isfinite(rs.minimax_smoother(plant).certified)


def test_bad_arguments_are_refused():
    plant = rs.augment(of_gain(0.2), 0.2, 2)
    with pytest.raises(TypeError, match="plant must be an AugmentedSystem, got UncertainSystem"):
        rs.minimax_smoother(plant.system)
    with pytest.raises(ValueError, match="output must be one of 'filtered', 'smoothed'"):
        rs.minimax_smoother(plant, "both")
    silent = replace(plant.system, D21=[[0.0, 0.0]])
    with pytest.raises(rs.InfeasibleDesignError, match="measurement 0 has no noise"):
        rs.minimax_smoother(rs.augment(silent, 0.2, 2))


@pytest.mark.parametrize(("system", "delay"), [(cancelling(DRIVE, GAIN), 1.0), (driven(0.2), 0.5)])
def test_measurement_and_output_of_its_first_states_are_nominal_estimates(system, delay):
    """So a discrete smoother knows what to expect of a measurement that is missing."""
    smoother = rs.minimax_smoother(rs.augment(system, delay, 3))
    n, plant = smoother.plant.n, smoother.plant
    A, B, _, _ = matrices(smoother, "real")
    covariance, own = covariances(A, B).stationary, slice(n, 2 * n)
    for rows in (plant.C2_tilde[: system.l], plant.C_p0):
        error = rows @ (covariance[:n, own] - covariance[own, own])
        size = np.sqrt(np.diag(rows @ covariance[:n, :n] @ rows.T))[:, None]
        deviations = np.sqrt(np.diag(covariance[own, own]))
        assert np.abs(error / size / deviations).max() < 1e-6


def test_an_estimate_goes_on_where_samples_are_missing():
    smoother = rs.minimax_smoother(rs.augment(of_gain(0.2), 0.2, 2))
    record = np.random.default_rng(1).standard_normal((400, 1)).cumsum(axis=0) * 0.05
    record[200:260] = np.nan
    estimates = smoother.discretize(0.01).run(record)
    assert np.isfinite(estimates).all()
    # it decays as the signal does, one lag later
    later = estimates[230:258, 0]
    assert_allclose(np.diff(np.log(np.abs(later))) / 0.01, -1.0, atol=0.05)
