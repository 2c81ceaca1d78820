"""The error covariance: by a frequency integral, against the bound, and its special cases."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag, solve_continuous_lyapunov

import robsmooth as rs
from robsmooth import (
    UnstableLoopError,
    analysis_bound,
    augment,
    delta_sweep,
    design_smoother,
    error_covariance,
    homodyne,
)
from robsmooth.analysis import covariance
from robsmooth.analysis.covariance import closed_loop
from robsmooth.estimators import baselines
from robsmooth.estimators.loop import LOOPS
from tests.helpers.strategies import (
    admissible_delta,
    designs,
    feasible_design,
    random_system,
    seeds,
)

NEAR_INFIMUM = (1.0987e-6, [1.0, 0.4999, 1e-4, 1e-4])


@pytest.fixture(scope="module")
def example():
    return design_smoother(augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2), *NEAR_INFIMUM)


@pytest.fixture(scope="module")
def general():
    """A design with two uncertainties, two nonlinearities, two outputs and two measurements."""
    rng = np.random.default_rng(1)
    while True:
        plant = augment(random_system(rng, n=2, m=2, measurements=2, g=2, size=0.1), 0.7, 2)
        design = feasible_design(rng, plant)
        if design is not None:
            return design


def spectral_covariance(design, Delta, output, loop):
    """The integral of |e^{-s delay} w - estimate|^2 over frequency, from the paper's blocks.

    Plant, estimator and uncertainty are kept apart, as in the block diagram: at each frequency the
    loop of signals is solved, with the exact delay in the smoothed error.
    """
    plant = design.plant
    noise = plant.D21_bar.copy()
    if loop == "real":
        noise[plant.system.l :] = 0.0
    read_out, lag = {
        "smoothed": (plant.C_a, plant.delay),
        "filtered": (design.C_f, 0.0),
    }[output]

    def density(omega):
        s = 1j * omega[:, None, None]
        to_state = np.linalg.inv(s * np.eye(plant.n) - plant.A_p)
        estimator = np.linalg.inv(s * np.eye(len(design.A_c)) - design.A_c) @ design.B_c
        # Responses to the uncertainty inputs xi and to the noise W, of x, y, zeta; then the loop
        # xi = Delta zeta is closed.
        y_xi = plant.C2_tilde @ to_state @ plant.B1_tilde + plant.D21_tilde
        y_W = plant.C2_tilde @ to_state @ plant.B_p1 + noise
        zeta_y = plant.D12_tilde @ design.C_c @ estimator
        zeta_xi = plant.C1_tilde @ to_state @ plant.B1_tilde + zeta_y @ y_xi
        zeta_W = plant.C1_tilde @ to_state @ plant.B_p1 + zeta_y @ y_W
        xi = np.linalg.solve(np.eye(len(Delta)) - Delta @ zeta_xi, Delta @ zeta_W)
        w = plant.C_p0 @ to_state @ (plant.B1_tilde @ xi + plant.B_p1)
        error = np.exp(-s * lag) * w - read_out @ estimator @ (y_xi @ xi + y_W)
        return (error @ error.conj().swapaxes(1, 2)).real

    # Gauss-Legendre on panels that are short against the frequency and the delay's oscillation.
    # Beyond the last the density falls as its -2nd power, but for terms smaller by its inverse.
    fastest = max(np.abs(np.linalg.eigvals(m)).max() for m in (plant.A_p, design.A_c))
    edges = [0.0, 1e-3 * fastest / 1e3]
    while edges[-1] < 300 * fastest:
        edges.append(edges[-1] + min(0.3 * edges[-1], 2.0 / max(lag, 1e-12)))
    nodes, weights = np.polynomial.legendre.leggauss(6)
    centre, half = np.add(edges[1:], edges[:-1]) / 2, np.diff(edges) / 2
    omega = (centre[:, None] + half[:, None] * nodes).ravel()
    values = density(omega)
    integral = np.tensordot((half[:, None] * weights).ravel(), values, axes=1)
    last = omega > 0.9 * edges[-1]
    tail = (values[last] * omega[last, None, None] ** 2).mean(axis=0) / edges[-1]
    return (integral + tail) / math.pi


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("output", ["smoothed", "filtered"])
@pytest.mark.parametrize("seed", [None, 0, "full"])
def test_covariance_is_the_integral_of_the_errors_spectrum(general, seed, output, loop):
    plant = general.plant
    if seed is None:
        Delta = np.zeros((len(plant.B1_tilde.T), len(plant.C1_tilde)))
    elif seed == "full":  # not admissible, but the formula is for any
        Delta = np.random.default_rng(0).standard_normal(general.plant.C1_tilde.shape[:1] * 2)
        Delta /= 3 * np.linalg.norm(Delta, 2)
    else:
        Delta = admissible_delta(np.random.default_rng(seed), plant)
    expected = spectral_covariance(general, Delta, output, loop)
    assert_allclose(
        error_covariance(general, Delta, output, loop),
        expected,
        rtol=0,
        atol=2e-5 * np.abs(expected).max(),
    )


@pytest.mark.parametrize("slope", [0.0, -0.6])
@pytest.mark.parametrize("output", ["smoothed", "filtered"])
def test_covariance_of_the_example_is_the_integral_of_the_errors_spectrum(example, output, slope):
    Delta = example.plant.structured_delta((), [slope])
    expected = spectral_covariance(example, Delta, output, "theory")
    assert_allclose(error_covariance(example, Delta, output), expected, rtol=2e-5)


@given(designs(), seeds)
@settings(max_examples=60)
def test_bound_holds_for_every_admissible_delta(design, seed):
    rng = np.random.default_rng(seed)
    for _ in range(5):
        Delta = admissible_delta(rng, design.plant)
        P = error_covariance(design, Delta, "filtered")
        assert np.trace(P) <= design.mean_square_bound * (1 + 1e-9)


@given(designs(cost="smoothed"), seeds)
@settings(max_examples=60)
def test_bound_of_the_smoothed_cost_holds_for_the_output_of_the_delay_model(design, seed):
    rng = np.random.default_rng(seed)
    for _ in range(5):
        P = error_covariance(design, admissible_delta(rng, design.plant), "guaranteed")
        assert np.trace(P) <= design.mean_square_bound * (1 + 1e-9)


@pytest.mark.parametrize("slope", [-1.0, -0.5, 0.0, 0.5, 1.0])
def test_bound_of_the_smoothed_cost_holds_for_the_examples_smoothed_error(slope):
    # Not a theorem: the delay model is not the delay. For the example it is close enough.
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    design = design_smoother(plant, 7.023e-7, [1.0, 0.4999, 1e-4, 1e-4], cost="smoothed")
    P = error_covariance(design, plant.structured_delta((), [slope]))
    assert P[0, 0] <= design.mean_square_bound


def test_bound_is_not_for_a_delta_that_breaks_the_difference_constraint(example):
    # Norm one, but the copy has another slope than the nonlinearity: not admissible.
    P = error_covariance(example, np.diag([0.0, -1.0, 0.0]), "filtered")
    assert P[0, 0] > 1.5 * example.mean_square_bound


def test_leaving_out_the_fictitious_noise_lowers_the_error(general, example):
    for design in (general, example):
        g = design.plant.system.g
        Delta = design.plant.structured_delta((), [-0.5] * g)
        for output in ("smoothed", "filtered"):
            with_noise = error_covariance(design, Delta, output)
            without = error_covariance(design, Delta, output, loop="real")
            assert np.linalg.eigvalsh(with_noise - without).min() > -1e-12 * np.trace(with_noise)
            assert np.trace(without) < np.trace(with_noise)


@given(designs(max_g=1), seeds)
def test_covariance_is_symmetric_and_positive(design, seed):
    Delta = admissible_delta(np.random.default_rng(seed), design.plant)
    for output in ("smoothed", "filtered"):
        P = error_covariance(design, Delta, output)
        assert P.shape == (design.plant.system.m,) * 2
        assert_allclose(P, P.T, rtol=0, atol=1e-12 * np.abs(P).max())
        assert np.linalg.eigvalsh(P).min() > -1e-9 * np.trace(P)


@pytest.mark.parametrize("order", [0, 1, 3])
def test_smoothed_error_tends_to_the_filtered_one_as_the_delay_vanishes(order):
    system = random_system(np.random.default_rng(3), n=2, m=2, measurements=1, g=0)
    filtered = baselines.kalman_bucy(system)
    Delta = np.zeros((3, 4))
    target = error_covariance(filtered, Delta, "filtered")
    assert_allclose(error_covariance(filtered, Delta, "smoothed"), target, rtol=1e-12)
    gaps = []
    for delay in (1e-3, 1e-5):
        smoother = baselines.fixed_lag_smoother(system, delay, order)
        gaps.append(np.abs(error_covariance(smoother, Delta, "smoothed") - target).max())
    assert gaps[1] < 0.02 * gaps[0]  # proportional to the delay
    assert gaps[0] < 1e-2 * np.trace(target)


def test_sweep_is_the_covariance_point_by_point(example, general):
    slopes = np.linspace(-1, 0, 5)
    for design, options in ((example, {}), (general, {"output": "filtered", "loop": "real"})):
        swept = delta_sweep(design, slopes * 0.5, **options)
        m, g = design.plant.system.m, design.plant.system.g
        assert swept.shape == (5, m, m)
        for slope, P in zip(slopes * 0.5, swept, strict=True):
            Delta = design.plant.structured_delta((), [slope] * g)
            expected = error_covariance(design, Delta, **options)
            assert_allclose(P, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert delta_sweep(example, []).shape == (0, 1, 1)


def test_a_sweep_in_pieces_is_the_sweep(general, monkeypatch):
    slopes = np.linspace(-0.5, 0.5, 7)
    whole = delta_sweep(general, slopes)
    monkeypatch.setattr(covariance, "_BATCH", 3 * (2 * general.plant.n) ** 2)
    assert_allclose(delta_sweep(general, slopes), whole, rtol=0, atol=1e-12 * np.abs(whole).max())


@pytest.mark.parametrize("slopes, error", [([0.0, -1.01], "norm at most 1"), ([np.nan], "finite")])
def test_a_sweep_refuses_what_a_point_of_it_would(example, slopes, error):
    with pytest.raises(ValueError, match=error):
        delta_sweep(example, slopes)
    with pytest.raises(ValueError, match=r"^output must be one of"):
        delta_sweep(example, [0.0], "delayed")


def test_a_sweep_through_an_unstable_loop_is_an_error(example):
    unstable = replace(example, A_c=example.A_c + 1e9 * np.eye(3))
    with pytest.raises(UnstableLoopError, match="real part"):
        delta_sweep(unstable, [0.0, -0.5])


def wider(estimator):
    """The same estimator with a state more, which nothing reads."""
    read_outs = ("C_c", "C_a", "C_f")
    return replace(
        estimator,
        A_c=block_diag(estimator.A_c, -1.0),
        B_c=np.pad(estimator.B_c, ((0, 1), (0, 0))),
        **{name: np.pad(getattr(estimator, name), ((0, 0), (0, 1))) for name in read_outs},
    )


def test_a_sweep_wants_nonlinearities():
    system = random_system(np.random.default_rng(0), g=0)
    with pytest.raises(ValueError, match="smoother must be of a system with nonlinearities"):
        delta_sweep(baselines.kalman_bucy(system), [0.0, 1.0])


def test_an_estimator_of_another_order_has_the_covariance_of_its_loop(example):
    Delta = example.plant.structured_delta((), [-0.4])
    for output in ("smoothed", "filtered"):
        expected = error_covariance(example, Delta, output)
        assert_allclose(error_covariance(wider(example), Delta, output), expected, rtol=1e-9)


def test_an_error_is_found_where_state_and_estimate_have_twelve_digits_in_common():
    kappa, r = 1e12, 1e-12
    filtered = baselines.kalman_bucy(
        rs.UncertainSystem([[-1.0]], [[kappa**0.5, 0.0]], [[1.0]], [[1.0]], [[0.0, r**0.5]])
    )
    nothing = np.zeros((0, 0))
    P = kappa / (1.0 + np.sqrt(1.0 + kappa / r))
    for estimator in (filtered, wider(filtered)):
        found = error_covariance(estimator, nothing, "filtered")[0, 0]
        assert found == pytest.approx(P, rel=1e-11)


def test_an_unstable_loop_is_an_error_that_says_how_unstable(example):
    Delta = np.zeros((3, 3))
    Delta[0, 1] = 1.0  # the phase drives itself, as 929.6 * 200 - 9140 > 0
    with pytest.raises(UnstableLoopError, match=r"real part 1\.768e\+05"):
        error_covariance(example, Delta)


def test_a_delta_above_one_is_refused_unless_asked_for(example):
    Delta = example.plant.structured_delta((), [-1.01])
    with pytest.raises(ValueError, match="norm at most 1"):
        error_covariance(example, Delta)
    P = error_covariance(example, Delta, allow_inadmissible=True)
    assert error_covariance(example, Delta / 1.01) < P
    error_covariance(example, Delta / 1.01 * (1 + 1e-14))  # rounding is forgiven


@pytest.mark.parametrize("lipschitz", [0.5, 2.0])
def test_a_slope_is_admissible_up_to_the_lipschitz_constant(lipschitz):
    system = homodyne.PAPER.uncertain_system()
    (channel,) = system.nonlinearities
    # sin e with the same sector: psi is `lipschitz` times as steep, its argument as much smaller
    steeper = replace(channel, lipschitz=lipschitz, C=channel.C / lipschitz, function=None)
    plant = augment(replace(system, nonlinearities=(steeper,)), 3.1e-6, 2)
    design = design_smoother(plant, *NEAR_INFIMUM)
    P = error_covariance(design, plant.structured_delta((), [-lipschitz]), "filtered")
    assert P[0, 0] <= design.mean_square_bound
    with pytest.raises(ValueError, match="norm at most 1"):
        error_covariance(design, plant.structured_delta((), [-1.01 * lipschitz]), "filtered")


@pytest.mark.parametrize("Delta", [0.5, np.zeros(3), np.zeros((2, 3)), np.zeros((4, 4))])
def test_a_delta_of_the_wrong_shape_is_an_error(example, Delta):
    with pytest.raises(ValueError, match=r"^Delta must have"):
        error_covariance(example, Delta)


@pytest.mark.parametrize("bad, error", [(np.nan, ValueError), (1j, ValueError), ("a", TypeError)])
def test_a_delta_that_is_not_finite_and_real_is_an_error(example, bad, error):
    with pytest.raises(error, match=r"^Delta must be"):
        error_covariance(example, [[bad] * 3] * 3)


def test_wrong_arguments_are_errors(example):
    zero = np.zeros((3, 3))
    with pytest.raises(ValueError, match=r"^output must be one of 'smoothed', 'filtered'"):
        error_covariance(example, zero, "delayed")
    for call in (
        lambda: error_covariance(example.plant, zero),
        lambda: delta_sweep(example.plant, [0.0]),
    ):
        with pytest.raises(TypeError, match="smoother must be an Estimator"):
            call()
    with pytest.raises(ValueError, match="nonlinearities must have 1 dimension"):
        delta_sweep(example, 0.5)
    for call in (
        lambda: error_covariance(example, zero, loop="ideal"),
        lambda: delta_sweep(example, [0.0], loop="ideal"),
        lambda: closed_loop(example, zero, loop="ideal"),
    ):
        with pytest.raises(ValueError, match=r"^loop must be one of 'theory', 'real', got 'ideal'"):
            call()
    with pytest.raises(TypeError, match=r"^copy_noise must be True or False, got 1"):
        error_covariance(example, zero, copy_noise=1)


@pytest.mark.parametrize(("copy_noise", "loop"), [(True, "theory"), (False, "real")])
def test_copy_noise_is_another_way_to_say_the_loop(example, copy_noise, loop):
    Delta = example.plant.structured_delta((), [-0.5])
    expected = error_covariance(example, Delta, loop=loop)
    assert_array_equal(error_covariance(example, Delta, "smoothed", copy_noise), expected)
    assert_array_equal(error_covariance(example, Delta, copy_noise=copy_noise), expected)
    expected = analysis_bound(example, "filtered", loop).mean_square
    assert analysis_bound(example, "filtered", copy_noise).mean_square == expected
    assert analysis_bound(example, "filtered", copy_noise=copy_noise).mean_square == expected


def test_the_copies_have_fictitious_noise_unless_the_loop_is_real(example):
    Delta = example.plant.structured_delta((), [-0.5])
    theory, real = (error_covariance(example, Delta, loop=loop)[0, 0] for loop in LOOPS)
    assert error_covariance(example, Delta)[0, 0] == theory > real


def test_error_of_the_guarantee_is_the_filtered_one_or_that_against_the_delay_model(example):
    Delta = example.plant.structured_delta((), [-0.5])
    found = error_covariance(example, Delta, "guaranteed")
    assert_allclose(found, error_covariance(example, Delta, "filtered"), rtol=1e-12)
    tau, multipliers = NEAR_INFIMUM
    design = design_smoother(example.plant, 2 * tau, multipliers, "smoothed")
    error = np.hstack([design.plant.C_a, -design.C_c[: design.plant.system.m]])
    A, B = closed_loop(design, Delta)
    expected = error @ solve_continuous_lyapunov(A, -B @ B.T) @ error.T
    assert_allclose(error_covariance(design, Delta, "guaranteed"), expected, rtol=1e-9)
    assert found[0, 0] <= example.mean_square_bound


@given(st.floats(-1.0, 1.0))
def test_errors_are_invariant_to_the_unit_of_time(slope):
    plain = design_smoother(augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2), *NEAR_INFIMUM)
    unit = 1e-6
    parameters = homodyne.HomodyneParameters(
        lam=9.14e3 * unit, kappa=4e4 * unit, alpha=1162.0 * math.sqrt(unit), beta=1.0, gamma=0.4
    )
    plant = augment(parameters.uncertain_system(), 3.1e-6 / unit, 2)
    tau, multipliers = NEAR_INFIMUM
    other = design_smoother(plant, tau / unit, multipliers)
    assert other.bound == pytest.approx(plain.bound, rel=1e-9)
    for output in ("smoothed", "filtered"):
        pair = [
            error_covariance(d, d.plant.structured_delta((), [slope]), output)
            for d in (plain, other)
        ]
        assert_allclose(*pair, rtol=1e-9)
