"""Plants that drift, grow or oscillate for ever: their errors, and designs for them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, expm, solve_discrete_are

import robsmooth as rs
from robsmooth._numerics.lyapunov import noise_root
from robsmooth._numerics.modes import is_stable
from robsmooth.estimators.drift import Drift
from robsmooth.estimators.units import Units
from tests.helpers.systems import in_other_units

WALK = rs.UncertainSystem([[0]], [[1, 0]], [[1]], [[1]], [[0, 1]])
NOTHING = np.zeros((0, 0))
PAPER = rs.homodyne.PAPER


def loop_of(lam):
    return replace(PAPER, lam=lam).uncertain_system()


def exact_fixed_lag(system, delay, samples=400):
    """The error of the optimal fixed-lag smoother, in fine discrete time: an independent route.

    The state holds the system's, as it was in the samples of a delay.
    """
    n, l, dt = system.n, system.l, delay / samples  # noqa: E741
    whole = np.block([[system.A, np.zeros((n, l))], [system.C2, np.zeros((l, l))]])
    root = noise_root(whole, np.vstack([system.B1, system.D21]), dt)
    step, noise = expm(dt * whole), root @ root.T
    Phi, H = step[:n, :n], step[n:, :n]
    Q, S, R = noise[:n, :n], noise[:n, n:], noise[n:, n:]
    P = solve_discrete_are(Phi.T, H.T, Q, R, s=S)
    innovation = H @ P @ H.T + R
    closed = Phi - (Phi @ P @ H.T + S) @ np.linalg.solve(innovation, H)
    known, moved = np.zeros((n, n)), np.eye(n)
    for _ in range(samples):
        known += moved.T @ H.T @ np.linalg.solve(innovation, H) @ moved
        moved = closed @ moved
    return system.C0 @ (P - P @ known @ P) @ system.C0.T


def detectable(seed, unstable):
    """A random system with eigenvalues left of, on and right of the axis, in random coordinates."""
    rng = np.random.default_rng(seed)
    integrators = [[0.0]], [[0.0, 1.0], [0.0, 0.0]]
    blocks = [integrators[rng.integers(2)], [[0.0, 2.0], [-2.0, 0.0]], [[0.4]], [[-0.7]]]
    chosen = [blocks[i] for i in rng.permutation(4)[:2] if unstable or i != 2]
    A = block_diag([[-1.5]], *chosen)
    n = len(A)
    T = np.linalg.qr(rng.standard_normal((n, n)))[0]
    T = T * 10.0 ** rng.uniform(-2, 2, n)[:, None]
    back, noise = np.linalg.inv(T), rng.standard_normal((n, n))
    B1 = np.hstack([T @ noise, np.zeros((n, 1))])
    rows = rng.standard_normal((2, n)) @ back
    D21 = np.pad([[0.3]], ((0, 0), (n, 0)))
    return rs.UncertainSystem(T @ A @ back, B1, rows[:1], rows[1:], D21)


def test_errors_of_a_random_walk():
    kalman = rs.baselines.kalman_bucy(WALK)
    assert_allclose(rs.error_covariance(kalman, NOTHING, "filtered"), 1.0, rtol=1e-12)
    for order, error in ((1, 0.9093810), (2, 0.9093680)):
        smoother = rs.baselines.fixed_lag_smoother(WALK, 0.1, order)
        assert_allclose(rs.error_covariance(smoother, NOTHING), error, atol=5e-8)
        assert_allclose(list(vars(rs.judge(smoother)).values()), error, atol=5e-8)
        sweep = rs.lag_sweep(WALK, [0.1], [order])
        assert_allclose([sweep.nominal[0, 0], sweep.worst[0, 0]], error, atol=5e-8)
    assert rs.best_lag(WALK, 2)[1] == pytest.approx(0.52746, rel=1e-4)
    assert rs.choose_lag(WALK, fraction=0.8).error == pytest.approx(0.6)


@given(seed=st.integers(0, 10_000), unstable=st.booleans(), delay=st.sampled_from([0.1, 0.5]))
def test_classical_smoothers_come_close_to_the_optimum_in_discrete_time(seed, unstable, delay):
    system = detectable(seed, unstable)
    optimum = exact_fixed_lag(system, delay)
    assert_allclose(rs.baselines.optimal_fixed_lag_error(system, delay), optimum, rtol=2e-2)
    smoother = rs.baselines.fixed_lag_smoother(system, delay, order=6)
    found = rs.error_covariance(smoother, NOTHING)
    least = rs.baselines.optimal_fixed_lag_error(system, delay)
    assert (1.0 - 1e-6) * least <= found <= 1.2 * least
    judged = rs.judge(smoother)
    assert_allclose([judged.worst_constant, judged.certified], found[0, 0], rtol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_simulated_errors_are_those_computed(seed):
    smoother = rs.baselines.fixed_lag_smoother(detectable(seed, True), 0.3, order=3)
    found = rs.simulate(smoother, runs=512, duration=15.0)
    for output in ("smoothed", "filtered"):
        error, exact = getattr(found, output), rs.error_covariance(smoother, NOTHING, output)
        # 12 comparisons at 4 standard errors: a false alarm in 1300 changes of the seed
        assert abs(error.mean_square - exact[0, 0]) < 4.0 * error.standard_error


@pytest.mark.parametrize(("output", "certified"), [("smoothed", 0.08977), ("filtered", 0.14343)])
def test_a_phase_that_diffuses_has_all_designs_but_the_papers(output, certified):
    plant = rs.augment(loop_of(0.0), 3.1e-6, 2)
    robust = rs.minimax_smoother(plant, output)
    assert robust.certified == pytest.approx(certified, abs=5e-6)
    judged = rs.judge(robust, output)
    classical = rs.baselines.fixed_lag_smoother(plant.system, 3.1e-6, 2, copies=True)
    assert judged.certified < (1.0 + 1e-6) * rs.judge(classical, output).certified
    assert judged.certified == pytest.approx(robust.certified, rel=0.005)  # of the true delay
    tuned = rs.judge(rs.baselines.tuned_fixed_lag_smoother(plant, output=output), output)
    constant = rs.constant_minimax_smoother(plant, output)
    assert constant.worst_constant <= (1.0 + 1e-3) * tuned.worst_constant
    with pytest.raises(rs.InfeasibleDesignError, match="need no stability"):
        rs.minimize_bound(plant, output)


def test_everything_is_continuous_as_the_decay_vanishes():
    def figures(lam):
        system = loop_of(lam)
        plant = rs.augment(system, 3.1e-6, 2)
        classical = rs.baselines.fixed_lag_smoother(system, 3.1e-6, 2, copies=True)
        Delta = plant.structured_delta((), [-0.5])
        return [
            *vars(rs.judge(classical)).values(),
            rs.minimax_smoother(plant).certified,
            rs.error_covariance(classical, Delta)[0, 0],
            rs.error_covariance(classical, Delta, "filtered")[0, 0],
            rs.baselines.optimal_fixed_lag_error(system, 3.1e-6)[0, 0],
            rs.baselines.optimal_two_sided_error(system)[0, 0],
        ]

    limit = figures(0.0)
    for smaller in (1e-4, 1e-6, 1e-9):
        assert_allclose(figures(smaller * PAPER.lam), limit, rtol=0.1 * smaller + 2e-6)


def test_a_design_with_all_of_the_uncertainty_is_found_for_a_slow_decay():
    plant = rs.augment(loop_of(0.9), 3.1e-6, 2)
    assert rs.minimize_bound(plant).mean_square_bound < 0.15


@pytest.mark.parametrize("more", [1.0, 3.0, 9.0])
def test_the_least_certified_error_does_not_depend_on_the_observer(monkeypatch, more):
    monkeypatch.setattr("robsmooth.estimators.drift._MORE", more + 0.5)
    plant = rs.augment(loop_of(0.0), 3.1e-6, 2)
    assert rs.minimax_smoother(plant).certified == pytest.approx(0.08977329, rel=1e-6)


def drifting_pair(size):
    """A random walk, measured with a decaying signal that an uncertainty drives and sees."""
    rate = rs.Uncertainty(B=[[0], [1]], C=[[0, size]], D=[[0]])
    return rs.UncertainSystem(
        [[0, 0], [0, -1]], [[1, 0, 0], [0, 1, 0]], [[1, 0]], [[1, 1]], [[0, 0, 0.2]], [rate]
    )


def test_an_uncertainty_beside_a_drift_has_a_certificate_in_all_units():
    plant = rs.augment(drifting_pair(0.4), 0.5, 2)
    found, judged = rs.minimax_smoother(plant), {}
    for name, each in rs.best_smoother(plant).candidates.items():
        judged[name] = each.judgement.certified
    assert min(judged, key=judged.get) == "minimax"
    other = in_other_units(plant.system, 1e-9, [1e-12, 1e12], [1e3])
    again = rs.minimax_smoother(rs.augment(other, 0.5e9, 2))
    assert again.certified == pytest.approx(found.certified, rel=1e-6)
    Delta = plant.structured_delta([0.7])
    assert rs.error_covariance(found, Delta)[0, 0] < found.certified * 1.01


def test_what_an_observer_leaves_is_stable_and_its_estimator_is_one_of_the_plant():
    system = drifting_pair(0.4)
    plant = rs.augment(system, 0.5, 2)
    drift = Drift.of(plant)
    assert is_stable(np.linalg.eigvals(drift.plant.A_p))
    assert Units.of(drift.plant.system).x.shape == (2,)
    smoother = rs.minimax_smoother(plant)
    # the first states estimate the plant's: what a discrete smoother expects of a missing sample
    discrete = smoother.discretize(0.1)
    discrete.run([[1.0]] * 50)
    x = discrete.state[: plant.n]
    discrete.step([np.nan])
    assert abs(discrete.state[0] - x[0]) < 0.2 * abs(x[0])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [2, 3, 4])
def test_integrators_may_be_mixed_although_rounding_puts_their_poles_apart(count, seed):
    T = np.linalg.qr(np.random.default_rng(seed).standard_normal((count, count)))[0]
    errors = []
    for to in (np.eye(count), T):
        drive = np.hstack([0.3 * to, np.zeros((count, 1))])
        C = np.eye(1, count) @ to.T
        system = rs.UncertainSystem(
            to @ np.eye(count, k=1) @ to.T, drive, C, C, np.eye(1, count + 1, k=count)
        )
        classical = rs.baselines.fixed_lag_smoother(system, 0.1, 2)
        errors.append([*vars(rs.judge(classical)).values()])
    assert_allclose(errors, errors[0][0], rtol=1e-5)


def test_an_uncertainty_that_sees_a_drift_is_named():
    gain = rs.Uncertainty([[0]], [[0.1]], [[1]])
    plant = rs.augment(replace(WALK, uncertainties=(gain,)), 0.1, 2)
    classical = rs.baselines.fixed_lag_smoother(plant.system, 0.1, 2)
    judged = rs.judge(classical)
    assert judged.nominal == pytest.approx(0.909368, rel=1e-6)
    assert np.isinf([judged.worst_constant, judged.certified]).all()
    what = r"output C x of uncertainties\[0\] grows without bound"
    with pytest.raises(rs.UnstableLoopError, match=what):
        rs.analysis_bound(classical, "smoothed")
    for design in (rs.minimax_smoother, rs.constant_minimax_smoother, rs.best_smoother):
        with pytest.raises(rs.InfeasibleDesignError, match=what):
            design(plant)


@pytest.mark.parametrize(
    ("A", "B1", "C2", "message"),
    [
        ([[0]], [[0, 0]], [[1]], r"eigenvalue 0 1/s and the direction \[1\] neither decays nor is"),
        (
            [[0]],
            [[1, 0]],
            [[0]],
            r"eigenvalue 0 1/s and the direction \[1\] does not decay, and no",
        ),
        ([[1, 0], [0, -1]], [[1, 0], [1, 0]], [[0, 1]], r"eigenvalue 1 1/s and the direction \[1,"),
        ([[0, 1], [-4, 0]], [[0, 0], [0, 0]], [[1, 0]], r"eigenvalue [+-]?0[+-]2j 1/s"),
    ],
)
def test_a_mode_without_a_stable_filter_is_named(A, B1, C2, message):
    D21 = [[0, 1]]
    system = rs.UncertainSystem(A, B1, np.eye(1, len(A)), C2, D21)
    with pytest.raises(rs.InfeasibleDesignError, match=message):
        rs.baselines.kalman_bucy(system)


@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_a_system_without_process_noise_is_named(delay):
    plant = rs.augment(replace(WALK, A=[[-1]], B1=[[0, 0]]), delay, 2)
    for design in (
        rs.minimax_smoother,
        rs.constant_minimax_smoother,
        rs.best_smoother,
        rs.baselines.tuned_fixed_lag_smoother,
    ):
        with pytest.raises(rs.InfeasibleDesignError, match=r"no noise in B1 drives C0 x"):
            design(plant)


def judged(system, delay, order=2):
    return vars(rs.judge(rs.baselines.fixed_lag_smoother(system, delay, order))).values()


@pytest.mark.parametrize("mixing", [1e-5, 1e-8, 0.0])
def test_a_phase_with_a_coloured_frequency_has_all_designs(mixing):
    # the noise of the integrated mode is that of its spectral projection
    D21 = [[0, 0.1, 0]]
    system = rs.UncertainSystem(
        [[0, 1], [0, -1]], [[0, 0, mixing], [1, 0, 0]], [[1, 0]], [[1, 0]], D21
    )
    least = rs.baselines.optimal_fixed_lag_error(system, 0.5)[0, 0]
    assert_allclose(list(judged(system, 0.5)), least, rtol=1e-3)
    robust = rs.minimax_smoother(rs.augment(system, 0.5, 2))
    assert robust.certified == pytest.approx(least, rel=5e-3)  # of the delay's model
    assert rs.judge(robust).nominal == pytest.approx(least, rel=1e-3)


def test_integrators_behind_an_ordinary_sensor():
    A = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, -10, 1], [0, 0, 0, -1e3]]
    B1 = [[0, 0], [0, 0], [0, 0], [1, 0]]
    system = rs.UncertainSystem(A, B1, np.eye(1, 4), np.eye(1, 4), [[0, 0.1]])
    least = rs.baselines.optimal_fixed_lag_error(system, 0.5)[0, 0]
    for order in (2, 4):
        assert_allclose(list(judged(system, 0.5, order)), least, rtol=1e-4)


@pytest.mark.parametrize("decay", [1e-7, 1e-8, 1e-9, 3e-10])
def test_a_stable_plant_with_a_slow_mode_has_its_error(decay):
    B1 = [[1, 0, 0, 0], [0, (2 * decay) ** 0.5, 0, 0]]
    D21 = np.hstack([np.zeros((2, 2)), np.eye(2)])
    system = rs.UncertainSystem([[-1, 0], [0, -decay]], B1, [[1, 1]], np.eye(2), D21)
    smoother = rs.baselines.fixed_lag_smoother(system, 0.1, 2)
    expected = rs.error_covariance(smoother, NOTHING)[0, 0]
    assert_allclose(list(judged(system, 0.1)), expected, rtol=1e-6)


@pytest.mark.parametrize("delay", [1e-6, 1e-9, 1e-11])
def test_a_delay_that_is_next_to_nothing_changes_next_to_nothing(delay):
    assert_allclose(list(judged(WALK, delay)), 1.0, rtol=2 * delay + 1e-9)


@pytest.mark.parametrize("rate", [1e4, 1e6, 1e7])
def test_the_minimax_smoother_is_no_worse_than_the_classical_beside_a_fast_mode(rate):
    B1 = [[1, 0, 0], [0, (2 * rate) ** 0.5, 0]]
    system = rs.UncertainSystem([[0, 0], [0, -rate]], B1, [[1, 0]], [[1, 1]], [[0, 0, 1]])
    robust = rs.judge(rs.minimax_smoother(rs.augment(system, 0.1, 2)))
    classical, *_ = judged(system, 0.1)
    assert robust.nominal <= 1.001 * classical


def test_a_drift_that_noise_reaches_through_rounding_only_has_its_error():
    A = np.diag([0.0, 0.0, -0.3])
    A[0, 1], A[1, 0] = 1.0, -1.0
    rate = rs.Uncertainty([[0.5], [0], [1]], [[0, 0, 0.2]], [[0.1], [0]])
    force = rs.Nonlinearity([[0], [0.3], [0]], [[0, 0, 1]], [[0], [0.2]], 0.4)
    B1 = np.hstack([np.eye(3), np.zeros((3, 2))])
    C, D21 = [[1, 0, 0], [0, 1, 1]], [[0, 0, 0, 0.3, 0], [0, 0, 0, 0.1, 0.3]]
    system = rs.UncertainSystem(A, B1, [[1, 0, 0], [0, 0, 1]], C, D21, [rate], [force])
    for order in (1, 3, 5):
        found = rs.judge(rs.minimax_smoother(rs.augment(system, 0.6, order)))
        assert found.nominal < found.worst_constant < found.certified < 1.3


def test_sample_paths_do_not_wait_for_a_mode_that_hardly_decays():
    smoother = rs.baselines.fixed_lag_smoother(loop_of(0.01), 3.1e-6, 2, copies=True)
    assert len(rs.sample_paths(smoother, runs=1).time) < 1000


def test_a_delayed_mode_that_grows_is_read_out_exactly():
    grows = replace(WALK, A=[[0.5]])
    for delay in (0.3, 4.0):
        least = rs.baselines.optimal_fixed_lag_error(grows, delay)[0, 0]
        errors = [
            rs.error_covariance(rs.baselines.fixed_lag_smoother(grows, delay, order), NOTHING)[0, 0]
            for order in (2, 4, 8)
        ]
        assert errors == sorted(errors, reverse=True)
        assert least <= errors[-1] < 1.01 * least
    stable = rs.augment(replace(WALK, A=[[-0.5]]), 0.3, 2)
    assert not stable.growth.any()


def test_a_simulation_of_what_grows_is_not_too_long():
    smoother = rs.baselines.kalman_bucy(replace(WALK, A=[[0.5]]))
    with pytest.raises(ValueError, match="duration must be shorter, got 1000 s"):
        rs.simulate(smoother, duration=1000.0)
