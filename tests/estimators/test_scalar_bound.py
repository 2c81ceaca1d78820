"""The example's bound in closed form, and the proof of its infimum."""

import math
from dataclasses import replace

import numpy as np
import pytest

from robsmooth import InfeasibleDesignError, augment, design_smoother, minimize_bound
from robsmooth.estimators.smoother import limiting_smoother
from robsmooth.homodyne import PAPER
from tests.helpers.proof import least_tau, lower_bound, prove_infimum
from tests.helpers.scalar_bound import scalar_bound

INFIMUM = 0.12167363533


def test_closed_form_is_the_bound_of_the_design():
    plant = augment(PAPER.uncertain_system(), 3.1e-6, 2)
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(60):
        p, tau = rng.uniform(0.4, 0.5025), 1e-6 * rng.uniform(0.8, 2.0)
        q = p if p <= 0.5 else (np.sqrt((1 - p) * (5 - p)) - (1 - p)) / 2
        d = p if p <= 0.5 else np.sqrt((1 - p) * (1 - q))
        try:
            multipliers = [1.0, d, max(p - d, 0.0), max(q - d, 0.0)]
            bound = limiting_smoother(plant, tau, multipliers).bound
        except InfeasibleDesignError:
            assert np.isinf(scalar_bound(PAPER, p, tau))
            continue
        compared += 1
        assert bound == pytest.approx(float(scalar_bound(PAPER, p, tau)), rel=1e-6)
    assert compared > 20


def test_no_other_multipliers_with_the_same_p_are_better():
    plant = augment(PAPER.uncertain_system(), 0.0, 0)
    rng = np.random.default_rng(1)
    compared = 0
    for _ in range(300):
        p = rng.uniform(0.4, 0.501)
        q = p * rng.uniform(0.999, 1.001)
        d = rng.uniform(0.999, 1.0) * min(p, q, np.sqrt((1 - p) * (1 - q)))
        tau = 1e-6 * rng.uniform(0.8, 2.0)
        try:
            bound = design_smoother(plant, tau, [1.0, d, p - d, q - d]).bound
        except InfeasibleDesignError:
            continue
        compared += 1
        assert bound >= float(scalar_bound(PAPER, p, tau)) * (1 - 1e-9)
    assert compared > 20


def test_lambda_1_of_one_is_the_best():
    plant = augment(PAPER.uncertain_system(), 0.0, 0)
    rng = np.random.default_rng(2)
    compared = 0
    for _ in range(100):
        p, tau = rng.uniform(0.4, 0.5), 1e-6 * rng.uniform(0.8, 2.0)
        inner = [p * 0.999, p * 0.001, p * 0.001]
        try:
            bounds = [
                design_smoother(plant, tau, [lambda_1, *inner]).bound
                for lambda_1 in (*np.sort(rng.uniform(0.3, 1.0, 3)), 1.0)
            ]
        except InfeasibleDesignError:
            continue
        compared += 1
        assert (np.diff(bounds) < 0.0).all()
    with pytest.raises(InfeasibleDesignError, match=r"is 1\.001, above 1"):
        design_smoother(plant, 1.3e-6, [1.001, 0.4, 0.01, 0.01])
    assert compared > 20


@pytest.mark.parametrize("J_21", [1.0, 0.1, 2.0])
def test_no_multipliers_that_are_allowed_have_a_smaller_h(J_21):
    """h is p - d^2/q, with d at most p and q, and d^2 at most (1 - p)(1/J_21^2 - q)."""
    for p in np.linspace(0.01, 0.99, 99):
        q = np.linspace(1e-3, 1.0 / J_21**2, 4000)
        d = np.minimum(np.minimum(p, q), np.sqrt((1.0 - p) * (1.0 / J_21**2 - q)))
        least = (p - d**2 / q).min()
        r = 1.0 - p
        ours = p - (np.sqrt(r**2 + 4.0 * r / J_21**2) - r) / 2.0 if p > 1 / (1 + J_21**2) else 0.0
        assert ours - 1e-12 <= least <= ours + 2e-3 / J_21**2


def test_interval_of_a_point_is_just_below_its_bound():
    rng = np.random.default_rng(3)
    points = np.array([rng.uniform(0.0, 1.0, 50_000), 10 ** rng.uniform(-7.0, -3.0, 50_000)])
    exact, lower = scalar_bound(PAPER, *points), lower_bound(PAPER, points, points)
    finite = np.isfinite(exact)
    assert finite.sum() > 1000
    assert (lower[finite] < exact[finite]).all()
    assert (lower[finite] > exact[finite] * (1 - 1e-10)).all()


def test_interval_of_a_cell_is_below_the_bounds_in_it():
    rng = np.random.default_rng(4)
    low = np.array([rng.uniform(0.0, 0.9, 500), 10 ** rng.uniform(-6.2, -5.0, 500)])
    high = low * 1.0
    high[0] += 0.1 * rng.uniform(size=500)
    high[1] *= 1.0 + rng.uniform(size=500)
    lower = lower_bound(PAPER, low, high)
    for share in rng.uniform(size=(50, 2, 1)):
        assert (lower <= scalar_bound(PAPER, *(low + share * (high - low)))).all()


def test_a_target_next_to_the_infimum_ends_with_a_message():
    with pytest.raises(ValueError, match=r"cells are left .* of 500000 at most: the target is too"):
        prove_infimum(PAPER, INFIMUM * (1 - 1e-12))


@pytest.mark.parametrize("J_21", [1.0, 0.1, 2.0])
def test_nothing_is_below_the_infimum_of_the_example(J_21):
    best = minimize_bound(augment(PAPER.uncertain_system(), 0.0, 0, J_21=J_21))
    if J_21 == 1.0:
        assert best.bound_infimum == pytest.approx(INFIMUM, rel=1e-9)
    assert prove_infimum(PAPER, best.bound_infimum * (1 - 1e-6), J_21) > 1000
    with pytest.raises(ValueError, match="V is"):
        prove_infimum(PAPER, best.bound_infimum * (1 + 1e-4), J_21)


@pytest.mark.parametrize("p", [0.1, 0.5])
def test_designs_begin_at_the_least_tau(p):
    edge = least_tau(PAPER, p)
    assert np.isinf(scalar_bound(PAPER, p, edge * (1 - 1e-9)))
    assert np.isfinite(scalar_bound(PAPER, p, edge * (1 + 1e-9)))


def test_a_target_that_designs_are_below_is_not_proven():
    with pytest.raises(ValueError, match=r"V is 0\.1216\d+ rad\^2 at p = 0\.4\d+, tau = 1\."):
        prove_infimum(PAPER, INFIMUM * (1 + 1e-4))


def test_proof_does_not_depend_on_the_unit_of_time():
    unit = 2.0**20
    faster = replace(
        PAPER, lam=PAPER.lam / unit, kappa=PAPER.kappa / unit, alpha=PAPER.alpha / 2.0**10
    )
    target = INFIMUM * (1 - 1e-5)
    assert prove_infimum(faster, target) == prove_infimum(PAPER, target)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_not_proved(value):
    with pytest.raises(ValueError, match="must be finite"):
        prove_infimum(PAPER, value)
    with pytest.raises(ValueError, match="must be finite"):
        prove_infimum(PAPER, 0.0, value)


def test_a_sector_wider_than_its_slope_is_refused():
    with pytest.raises(ValueError, match=r"gamma of at most beta for this proof, got gamma=0\.4"):
        prove_infimum(replace(PAPER, beta=0.3), 0.1)
