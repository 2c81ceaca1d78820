"""The compact system: the printed matrices of the example, and the general quadratic forms."""

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

import robsmooth as rs
from robsmooth import (
    InfeasibleDesignError,
    Nonlinearity,
    UncertainSystem,
    Uncertainty,
    augment,
    homodyne,
)
from robsmooth.systems.augmented import check_noise
from tests.helpers.strategies import plants, random_system, seeds

DELAY = 3.1e-6  # of the example


@pytest.fixture(scope="module")
def example():
    return augment(homodyne.PAPER.uncertain_system(), DELAY, 2)


@pytest.fixture(scope="module")
def general():
    """k = 2 and g = 2, with channels of different sizes and constants."""
    return augment(random_system(np.random.default_rng(5), n=3, m=2, measurements=2, g=2), 0.5, 2)


def test_compact_matrices_of_the_example_are_the_printed_ones(example):
    half = 1 / (2 * 1162.0)  # printed as 4e-4
    three, zero = np.zeros((3, 1)), [0, 0, 0]
    assert_array_equal(example.B_p1, [[200, 0, 0], zero, zero])
    assert_array_equal(example.C_p0, [[1, 0, 0]])
    assert_array_equal(example.B1_tilde, [[200, 0, 0], zero, zero])
    assert_allclose(example.C1_tilde, [zero, [929.6, 0, 0], zero], rtol=1e-15)
    assert_array_equal(example.D12_tilde, [[0, 0], [0, 0], [0, 1]])
    assert_array_equal(example.C2_tilde, [[1, 0, 0], zero])
    assert_array_equal(example.D21_tilde, [[0, half, 0], [0, 0, 1]])
    assert_array_equal(example.D21_bar, example.D21_tilde)
    assert round(half, 4) == 4e-4
    assert_allclose(example.J, np.eye(3), rtol=0, atol=1e-14)
    assert_array_equal(example.A_p[0], [-9140, 0, 0])
    assert (example.n, example.order, example.delay) == (3, 2, DELAY)
    assert_array_equal(example.B_p1[1:], np.hstack([three, three, three])[1:])


def test_drift_of_the_example_is_the_printed_one_up_to_the_delay_states_coordinates(example):
    # Invariant to coordinates: the polynomial of the delay block, and its coupling to the phase.
    printed = np.array([[-9.14e3, 0, 0], [2048, -1.94e6, -1.19e6], [0, 1.048e6, 0]])
    poles = np.poly(example.A_p[1:, 1:])
    assert_allclose(poles, np.poly(printed[1:, 1:]), rtol=5e-3)  # three digits are printed
    assert_allclose(poles, [1, 6 / DELAY, 12 / DELAY**2], rtol=1e-12)


def test_multiplier_matrix_of_the_example_is_the_printed_one(example):
    l1, l2, l3, l4 = 0.9727, 0.4831, 0.0015, 0.0014
    M = example.M([l1, l2, l3, l4])
    assert_allclose(M, [[l1, 0, 0], [0, l2 + l3, -l2], [0, -l2, l2 + l4]], rtol=1e-15)
    determinant = l3 * l4 + l2 * (l3 + l4)
    block = np.array([[l2 + l4, l2], [l2, l2 + l3]]) / determinant
    assert_allclose(np.linalg.inv(M)[1:, 1:], block, rtol=1e-9)
    for M_i, N_i in zip(example.M_i, example.N_i, strict=True):
        assert_array_equal(N_i, M_i)  # all Lipschitz constants are 1


def quadratic_forms(parts, weights):
    """The forms of (eqIQC1) to (eqIQC4), in the paper's order, written out by their channels."""
    *uncertain, first, second, copy1, copy2 = parts
    b1, b2 = weights
    forms = [part @ part for part in uncertain]
    forms += [(b1 * (first - copy1)) ** 2, (b2 * (second - copy2)) ** 2]
    forms += [(b1 * first) ** 2, (b2 * second) ** 2, (b1 * copy1) ** 2, (b2 * copy2) ** 2]
    return np.array([float(np.squeeze(form)) for form in forms])


def split(vector, sizes):
    return np.split(vector, np.cumsum(sizes)[:-1])


def test_constraint_matrices_evaluate_the_integrands_of_the_constraints(general):
    rng = np.random.default_rng(0)
    assert general.input_sizes == (2, 2, 1, 1, 1, 1)
    assert general.output_sizes == (3, 1, 1, 1, 1, 1)
    constants = [c.lipschitz for c in general.system.nonlinearities]
    multipliers = rng.uniform(0.1, 2.0, 8)
    for _ in range(20):
        xi, zeta = rng.standard_normal(8), rng.standard_normal(8)
        inputs = quadratic_forms(split(xi, general.input_sizes), (1.0, 1.0))
        outputs = quadratic_forms(split(zeta, general.output_sizes), constants)
        assert_allclose([xi @ M @ xi for M in general.M_i], inputs, rtol=1e-12, atol=1e-14)
        assert_allclose([zeta @ N @ zeta for N in general.N_i], outputs, rtol=1e-12, atol=1e-14)
        assert xi @ general.M(multipliers) @ xi == pytest.approx(multipliers @ inputs)


def test_multipliers_are_taken_in_the_papers_order(general):
    # uncertainty 1, uncertainty 2, differences 1 and 2, mu 1 and 2, mu-tilde 1 and 2
    diagonals = [np.flatnonzero(np.diag(M)).tolist() for M in general.M_i]
    assert diagonals == [[0, 1], [2, 3], [4, 6], [5, 7], [4], [5], [6], [7]]


def test_channels_are_stacked_in_the_order_of_the_compact_system(general):
    system, n = general.system, general.n
    assert n == 3 + 2 * 2
    u1, u2 = system.uncertainties
    f1, f2 = system.nonlinearities
    assert_array_equal(general.B1_tilde[:3], np.hstack([u1.B, u2.B, f1.B, f2.B, np.zeros((3, 2))]))
    assert_array_equal(general.B1_tilde[3:], 0)
    assert_array_equal(
        general.C1_tilde[:, :3], np.vstack([u1.C, u2.C, f1.C, f2.C, np.zeros((2, 3))])
    )
    assert_array_equal(general.C1_tilde[:, 3:], 0)
    expected = np.zeros((4, 8))
    expected[:2, :6] = np.hstack([u1.D, u2.D, f1.D, f2.D])
    expected[2:, 6:] = np.eye(2)
    assert_array_equal(general.D21_tilde, expected)
    outputs = np.zeros((8, 4))
    outputs[6, 2] = outputs[7, 3] = 1.0
    assert_array_equal(general.D12_tilde, outputs)


@given(plants())
def test_J_solves_assumption_1(plant):
    noise = np.vstack([plant.B_p1, plant.D21_bar])
    channels = np.vstack([plant.B1_tilde, plant.D21_tilde])
    assert plant.J.shape == (channels.shape[1], noise.shape[1])
    assert_allclose(channels @ plant.J, noise, rtol=0, atol=1e-10)


@given(plants())
def test_delayed_output_follows_the_delay_model(plant):
    # C_a (s - A_p)^{-1} B_p1 is the delay model times the transfer function of w.
    s = 0.7j
    states = np.linalg.solve(s * np.eye(plant.n) - plant.A_p, plant.B_p1)
    now, delayed = plant.C_p0 @ states, plant.C_a @ states
    model = plant.delay_model
    states = np.linalg.solve(s * np.eye(len(model.F)) - model.F, model.G + 0j)
    expected = (model.H @ states + model.J) @ now
    assert_allclose(delayed, expected, rtol=0, atol=1e-10 * np.abs(now).max())


def noisy(B1, D21, **channels):
    return UncertainSystem(
        A=-np.eye(2), B1=B1, C0=[[1.0, 0.0]], C2=[[1.0, 0.0]], D21=D21, **channels
    )


MEASURED = Uncertainty(B=[[0.0], [0.0]], C=[[0.1, 0.0]], D=[[1e-3]])


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("bypass", [1e-6, 1.0])
def test_noise_that_bypasses_the_channels_is_refused_and_named(bypass, unit):
    drive = Uncertainty(B=[[unit], [0.0]], C=[[0.0, 0.0]], D=[[0.0]])
    B1 = np.array([[unit, 0, 0], [0, 0, bypass * unit]])
    system = noisy(B1, [[0.0, 1e-3, 0.0]], uncertainties=[drive, MEASURED])
    with pytest.raises(InfeasibleDesignError, match="Assumption 1 fails: noise 2 of 3") as caught:
        rs.minimize_bound(augment(system, 1.0, 2))
    assert caught.value.condition == "Assumption 1"


def test_declaring_a_channel_for_the_noise_makes_the_system_acceptable():
    system = noisy([[1.0, 0.0], [0.0, 0.0]], [[0.0, 1e-3]], uncertainties=[MEASURED])
    with pytest.raises(InfeasibleDesignError, match="noise 0 of 2"):
        rs.minimize_bound(augment(system, 1.0, 2))
    drive = Uncertainty(B=[[1.0], [0.0]], C=np.zeros((1, 2)), D=[[0.0]])
    declared = noisy(system.B1, system.D21, uncertainties=[MEASURED, drive])
    assert_allclose(augment(declared, 1.0, 2).J, [[0, 1], [1, 0]], atol=1e-15)


def test_a_system_without_channels_is_refused_and_one_without_noise_is_not():
    with pytest.raises(InfeasibleDesignError, match="Assumption 1"):
        rs.minimize_bound(augment(noisy([[1.0], [0.0]], [[1.0]]), 0.0, 0))
    plant = augment(noisy(np.zeros((2, 0)), np.zeros((1, 0)), uncertainties=[MEASURED]), 0.0, 0)
    assert plant.J.shape == (1, 0)


def test_J_21_is_the_noise_of_the_copies(general):
    system = general.system
    intensity = np.array([[2.0, 0.5], [0.5, 1.0]])
    plant = augment(system, 0.5, 2, J_21=intensity)
    assert_array_equal(plant.D21_bar[2:, -2:], intensity)
    assert_array_equal(plant.D21_bar[2:, :-2], 0)
    assert_allclose(plant.J[-2:, -2:], intensity, atol=1e-12)
    assert_array_equal(augment(system, 0.5, 2, J_21=3.0).J_21, 3.0 * np.eye(2))


@pytest.mark.parametrize(
    "J_21, error",
    [
        (0.0, ValueError),
        (-1.0, ValueError),
        (np.nan, ValueError),
        (np.eye(3), ValueError),
        (np.ones(2), ValueError),
        (-np.eye(2), ValueError),
        ([[1.0, 2.0], [2.0, 1.0]], ValueError),
        ("one", TypeError),
    ],
)
def test_a_bad_J_21_is_an_error(general, J_21, error):
    with pytest.raises(error, match=r"^J_21 must"):
        augment(general.system, 0.5, 2, J_21=J_21)


def test_structured_delta_has_the_form_of_the_simulations(example):
    assert_array_equal(example.structured_delta([0.3], [-0.5]), np.diag([0.3, -0.5, -0.5]))
    assert_array_equal(example.structured_delta(), np.zeros((3, 3)))
    assert_array_equal(example.structured_delta((), [-1.0]), np.diag([0.0, -1.0, -1.0]))


def test_structured_delta_places_blocks_of_any_shape(general):
    block = np.arange(6.0).reshape(2, 3)
    Delta = general.structured_delta([block, 0.5], [0.1, -0.2])
    expected = np.zeros((8, 8))
    expected[:2, :3] = block
    expected[2, 3] = 0.5
    np.fill_diagonal(expected[4:, 4:], [0.1, -0.2, 0.1, -0.2])
    assert_array_equal(Delta, expected)


@pytest.mark.parametrize(
    "arguments, error, words",
    [
        (([1.0],), ValueError, "uncertainties must have 2 entries, got 1"),
        (((), [1.0, 2.0, 3.0]), ValueError, "nonlinearities must have 2 entries, got 3"),
        ((0.3,), TypeError, "uncertainties must be a sequence of length 2, got 0.3"),
        (((), -1), TypeError, "nonlinearities must be a sequence of length 2, got -1"),
        ((None,), TypeError, "uncertainties must be a sequence of length 2, got None"),
        (([np.eye(2), 0.0],), ValueError, r"uncertainties\[0\] must have shape \(2, 3\)"),
        (([[1.0, 2.0], 0.0],), ValueError, r"uncertainties\[0\] must have 2 dimension"),
        (([0.0, [[1.0, 2.0], [3.0]]],), ValueError, r"uncertainties\[1\] must be a rectangular"),
        (([np.nan, 0.0],), ValueError, r"uncertainties\[0\] must be finite"),
        (((), [0.0, np.inf]), ValueError, r"nonlinearities\[1\] must be finite"),
        (((), [1j, 0.0]), TypeError, r"nonlinearities\[0\] must be a real number"),
        ((["a", 0.0],), TypeError, r"uncertainties\[0\] must be a real number"),
        (([None, 0.0],), TypeError, r"uncertainties\[0\] must be a real number"),
    ],
)
def test_a_bad_delta_is_an_error(general, arguments, error, words):
    with pytest.raises(error, match=f"^{words}"):
        general.structured_delta(*arguments)


@pytest.mark.parametrize(
    "D, words",
    [
        (np.zeros((1, 0)), "measurement 0 has no noise"),
        ([[1e-9, 0.0], [0.0, 0.0]], "measurement 1 has no noise"),
        ([[1e9, 0.0], [1e-9, 0.0]], "the smallest eigenvalue of the noise's correlation matrix is"),
    ],
)
def test_noise_of_a_measurement_is_checked_in_its_own_unit(D, words):
    check_noise("It", np.diag([1e-30, 1e30]))
    with pytest.raises(InfeasibleDesignError, match=f"^It fails: .*{words}"):
        check_noise("It", np.array(D))


@pytest.mark.parametrize("count", [0, 7, 9])
def test_multiplier_matrix_wants_the_right_number_of_multipliers(general, count):
    with pytest.raises(ValueError, match=r"multipliers must have shape \(8\)"):
        general.M(np.ones(count))


@pytest.mark.parametrize("system", [None, 3, "system"])
def test_only_an_uncertain_system_is_augmented(system):
    with pytest.raises(TypeError, match="system must be an UncertainSystem"):
        augment(system, 1.0, 2)


@given(seeds)
def test_lipschitz_constant_and_output_only_matter_by_their_product(seed):
    # (beta, C) and (1, beta C) are the same constraint where no copy is concerned; the copy's
    # argument is then scaled, so N differs but the blocks that meet the state do not.
    rng = np.random.default_rng(seed)
    system = random_system(rng, g=1)
    (channel,) = system.nonlinearities
    scaled = Nonlinearity(channel.B, channel.lipschitz * channel.C, channel.D, lipschitz=1.0)
    other = UncertainSystem(
        system.A, system.B1, system.C0, system.C2, system.D21, system.uncertainties, (scaled,)
    )
    multipliers = rng.uniform(0.1, 1.0, 5)
    weighted = []
    for plant in (augment(system, 1.0, 1), augment(other, 1.0, 1)):
        weighted.append(plant.C1_tilde.T @ np.tensordot(multipliers, plant.N_i, 1) @ plant.C1_tilde)
    assert_allclose(*weighted, rtol=0, atol=1e-13)


def test_what_is_derived_is_read_only():
    plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    design = rs.baselines.kalman_bucy(plant.system)
    for derived in (plant.A_p, plant.J, plant.M_i[0], plant.delay_model.F, design.A_c, design.C_a):
        with pytest.raises(ValueError, match="read-only"):
            derived[0, 0] = 1.0
