"""What the search sees: the bound by other routes."""

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import sqrtm

from robsmooth import InfeasibleDesignError, augment, design_smoother, homodyne
from robsmooth.estimators.bound import log_bound
from robsmooth.estimators.equations import DesignProblem
from robsmooth.estimators.smoother import limiting_smoother
from robsmooth.estimators.units import Units
from tests.helpers.limits import CASES, limit_of
from tests.helpers.strategies import feasible_design, random_system

COSTS = ("filtered", "smoothed")


@pytest.fixture(scope="module")
def example():
    return augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)


def general_design(seed, cost):
    rng = np.random.default_rng(seed)
    for _ in range(50):
        plant = augment(
            random_system(rng, n=2, m=2, measurements=2, g=1 + seed % 2, size=0.05), 0.5, 1
        )
        if design := feasible_design(rng, plant, cost):
            return design
    raise AssertionError("no feasible design found")


def value(plant, cost, tau, multipliers):
    """V as the search finds it, in natural units."""
    units = Units.of(plant.system)
    natural = tau / (units.time * units.w**2)
    problem = DesignProblem.of(units.plant(plant), cost)
    v = np.exp(log_bound(problem, natural * np.asarray(multipliers)))
    return natural * v * units.w**2


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("seed", range(4))
def test_value_is_that_of_the_design(seed, cost):
    design = general_design(seed, cost)
    found = value(design.plant, cost, design.tau, design.multipliers)
    assert found == pytest.approx(design.bound, rel=1e-11)


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("case", CASES)
def test_the_same_in_the_limit(case, cost):
    plant, zero = CASES[case]
    limit = limit_of(plant, zero, cost)
    found = value(plant, cost, limit.tau, limit.multipliers)
    assert found == pytest.approx(limit.bound, rel=1e-11)


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("small", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("J_21", [1.0, 0.01])
def test_small_multipliers_of_a_pair_do_no_harm(J_21, small, cost):
    # The copy and the nonlinearity are nearly one channel: formed plainly, the bound loses as many
    # digits as M has decades.
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2, J_21=J_21)
    tau = 1.1e-6
    limit = limiting_smoother(plant, tau, [1.0, 0.5, 0.0, 0.0], cost)

    def excess(small):  # relative to the limit, for one of `small`
        found = value(plant, cost, tau, [1.0, 0.5 - small, small, small])
        return (found - limit.bound) / (small * limit.bound)

    slope = (10.0 * excess(1e-6) - excess(1e-5)) / 9.0
    assert excess(small) == pytest.approx(slope, rel=1e-4 + 2e3 * small + 1e-13 / small)


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("seed", range(3))
def test_bound_is_half_the_entropy_of_the_closed_loop(seed, cost):
    # With tau = 1 and the channels weighted by M(theta) and N(theta), the closed loop T satisfies
    # |T| < 1, and V/tau is -1/(4 pi) times the integral of log det(I - T*T) over all frequencies.
    design = general_design(seed, cost)
    plant, m = design.plant, design.plant.system.m
    theta = design.tau * design.multipliers
    M, N = plant.M(theta), np.tensordot(theta, np.array(plant.N_i), axes=1)
    into, out = np.linalg.inv(sqrtm(M).real), sqrtm(N).real
    C = plant.C_p0 if cost == "filtered" else plant.C_a
    A = np.block(
        [
            [plant.A_p, np.zeros((plant.n, plant.n))],
            [design.B_c @ plant.C2_tilde, design.A_c],
        ]
    )
    B = np.vstack([plant.B1_tilde, design.B_c @ plant.D21_tilde]) @ into
    outputs = np.vstack(
        [
            np.hstack([C, -design.C_c[:m]]),
            out @ np.hstack([plant.C1_tilde, plant.D12_tilde @ design.C_c]),
        ]
    )
    identity = np.eye(B.shape[1])

    def integrand(angle):
        omega = np.tan(angle)
        T = outputs @ np.linalg.solve(1j * omega * np.eye(len(A)) - A, B)
        sign, logarithm = np.linalg.slogdet(identity - T.conj().T @ T)
        assert sign.real > 0.0
        return logarithm * (1.0 + omega**2)

    integral = quad_vec(integrand, 0.0, np.pi / 2 - 1e-9, epsrel=1e-9)[0]
    assert -design.tau * integral / (2 * np.pi) == pytest.approx(design.bound, rel=1e-6)


def test_where_there_is_no_design_the_value_is_infinite(example):
    for tau, multipliers in ((1.1e-6, [1, 0.45, 1e-2, 1e-2]), (1e-8, [1, 0.49, 1e-4, 1e-4])):
        assert value(example, "filtered", tau, multipliers) == np.inf
        with pytest.raises(InfeasibleDesignError):
            design_smoother(example, tau, multipliers)
