"""The exact worst case under the constraints: against V, closed forms, and the input it names."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import solve_continuous_lyapunov

from robsmooth import (
    UncertainSystem,
    Uncertainty,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
    minimax_smoother,
    worst_case,
)
from robsmooth._numerics.riccati import solve_riccati
from robsmooth.analysis.constraints import analysis_bound
from robsmooth.analysis.covariance import closed_loop
from robsmooth.estimators import baselines
from robsmooth.estimators.certificate import ConstraintProblem, certify, model_loop
from robsmooth.estimators.loop import LOOPS, OUTPUTS, open_loop, scaled
from tests.helpers.loops import looking_at_nothing
from tests.helpers.strategies import admissible_delta, designs, seeds
from tests.helpers.systems import DRIVE, GAIN, cancelling, in_other_units

NEAR_INFIMUM = {
    "filtered": (1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6]),
    "smoothed": (7.0229e-7, [1.0, 0.4999, 1e-6, 1e-6]),
}


def example(cost, system=None):
    system = system or homodyne.PAPER.uncertain_system()
    return design_smoother(augment(system, 3.1e-6, 2), *NEAR_INFIMUM[cost], cost)


@given(designs(), st.sampled_from(OUTPUTS), st.sampled_from(LOOPS), seeds)
def test_open_loop_closes_to_the_closed_loop(design, output, loop, seed):
    Delta = admissible_delta(np.random.default_rng(seed), design.plant)
    opened = open_loop(design, output, loop)
    A, B = closed_loop(design, Delta, loop)
    assert_allclose(opened.A + opened.inputs @ Delta @ opened.outputs, A, atol=1e-12)
    assert_allclose(opened.B, B, atol=1e-14)
    blocks = [Delta[block.places[0]] / block.gain for block in opened.blocks]
    kept = opened.assemble(blocks)
    assert_allclose(opened.inputs @ kept @ opened.outputs, A - opened.A, atol=1e-12)


@settings(max_examples=15)
@given(st.sampled_from(["filtered", "smoothed"]).flatmap(lambda cost: designs(cost=cost)))
def test_bound_of_a_design_is_the_analysis_at_its_multipliers_with_more_noise(design):
    plant, theta = design.plant, design.tau * design.multipliers
    loop = open_loop(design, "guaranteed", "theory")
    C = loop.truth - loop.estimate
    spread = loop.inputs @ np.linalg.solve(plant.M(theta), loop.inputs.T)
    weighted = loop.outputs.T @ np.tensordot(theta, plant.N_i, 1) @ loop.outputs
    P = solve_riccati(loop.A, C.T @ C + weighted, -spread).X
    assert_allclose(design.tau * np.trace(spread @ P), design.mean_square_bound, rtol=1e-6)
    # and the noise is more than the loop's own
    excess = design.tau * spread - loop.B @ loop.B.T
    assert np.linalg.eigvalsh(excess).min() > -1e-9 * np.linalg.norm(excess)


@settings(max_examples=15)
@given(designs(), st.sampled_from(LOOPS), seeds)
def test_bound_is_between_every_admissible_delta_and_the_guarantee(design, loop, seed):
    found = analysis_bound(design, loop=loop)
    rng = np.random.default_rng(seed)
    for _ in range(5):
        Delta = admissible_delta(rng, design.plant)
        error = np.trace(error_covariance(design, Delta, "filtered", loop))
        assert error <= found.mean_square * (1 + 1e-6)
    assert found.fraction == 1.0
    assert found.mean_square <= design.mean_square_bound * (1 + 1e-6)


@settings(max_examples=15)
@given(designs(), st.sampled_from(OUTPUTS))
def test_worst_input_meets_the_constraints_and_attains_the_bound(design, output):
    found = analysis_bound(design, output)
    loop = open_loop(design, output, "theory")
    if loop.delay > 0.0:
        plant = design.plant
        finer = augment(plant.system, plant.delay, 14, J_21=plant.J_21)
        loop = model_loop(replace(design, plant=finer), "theory")
    K = found.feedback
    # another route than the gradient: the loop with this input, and its energies
    P = solve_continuous_lyapunov(loop.A + loop.inputs @ K, -loop.B @ loop.B.T)
    C = loop.truth - loop.estimate
    assert_allclose(np.trace(C @ P @ C.T), found.mean_square, rtol=1e-5)
    assert 0.0 <= found.gap < 1e-5
    zeta, xi = loop.outputs @ P @ loop.outputs.T, K @ P @ K.T
    for theta, M_i, N_i in zip(found.multipliers, design.plant.M_i, design.plant.N_i, strict=True):
        allowed, used = np.tensordot(N_i, zeta, 2), np.tensordot(M_i, xi, 2)
        assert used <= allowed + 1e-5 * found.mean_square / theta


@settings(max_examples=15)
@given(designs(), seeds)
def test_no_other_multipliers_have_a_lower_bound(design, seed):
    found = analysis_bound(design)
    loop, plant = open_loop(design, "guaranteed", "theory"), design.plant
    C = loop.truth - loop.estimate
    rng = np.random.default_rng(seed)
    ours = np.where(np.isfinite(found.multipliers), found.multipliers, 1.0)
    for _ in range(5):
        theta = ours * np.exp(rng.uniform(0.01, 1.0) * rng.standard_normal(ours.size))
        spread = loop.inputs @ np.linalg.solve(plant.M(theta), loop.inputs.T)
        weighted = loop.outputs.T @ np.tensordot(theta, plant.N_i, 1) @ loop.outputs
        try:
            P = solve_riccati(loop.A, C.T @ C + weighted, -spread).X
        except ArithmeticError:
            continue  # no bound at all
        assert np.trace(loop.B.T @ P @ loop.B) >= found.mean_square * (1 - 1e-6)


@pytest.mark.parametrize("uncertainty", [0.1, 0.5, 0.9])
def test_uncertain_decay_rate_has_a_constant_worst_case(uncertainty):
    found = analysis_bound(looking_at_nothing(uncertainty), "filtered")
    assert_allclose(found.mean_square, 1 / (2 * (1 - uncertainty)), rtol=1e-7)
    # theta at the minimum of the scalar problem, by hand
    assert_allclose(found.multipliers[0], 0.5 / uncertainty / (1 - uncertainty), rtol=1e-3)
    assert math.isinf(found.multipliers[1])  # that channel is allowed no energy
    assert not found.feedback[1].any()


@pytest.mark.parametrize("uncertainty", [1.0, 1.25, 4.0])
def test_too_much_uncertainty_has_no_bound_and_the_fraction_says_how_much_has(uncertainty):
    found = analysis_bound(looking_at_nothing(uncertainty), "filtered")
    assert math.isinf(found.mean_square)
    assert found.multipliers.size == found.feedback.size == 0
    assert_allclose(found.fraction, 1 / uncertainty, rtol=0.01)
    assert found.fraction < 1 / uncertainty


def test_loop_that_is_not_stable_has_no_bound_for_any_fraction():
    one = np.ones((1, 1))
    smoother = replace(looking_at_nothing(0.5), A_c=one, B_c=one, C_f=one)
    found = analysis_bound(smoother, "filtered")
    assert (found.mean_square, found.fraction) == (math.inf, 0.0)


def test_output_that_no_noise_excites_is_no_obstacle():
    # the second state is driven by nothing, and what its uncertainty feels moves the error
    system = UncertainSystem(
        A=[[-1.0, 0.0], [0.0, -1.0]],
        B1=[[1.0, 0.0], [0.0, 0.0]],
        C0=[[1.0, 0.0]],
        C2=[[1.0, 0.0]],
        D21=[[0.0, 1.0]],
        uncertainties=[
            Uncertainty(B=[[1.0], [0.0]], C=[[0.0, 0.5]], D=[[0.0]]),
            Uncertainty(B=[[0.0], [0.0]], C=[[0.0, 0.0]], D=[[1.0]]),
        ],
    )
    smoother = baselines.kalman_bucy(system)
    found = analysis_bound(smoother, "filtered")
    nominal = error_covariance(smoother, smoother.plant.structured_delta(), "filtered")[0, 0]
    assert_allclose(found.mean_square, nominal, rtol=1e-4)


@pytest.mark.parametrize("loop", LOOPS)
def test_constant_slope_is_the_worst_for_the_filtered_error_of_the_example(loop):
    design = example("filtered")
    at_the_edge = error_covariance(
        design, design.plant.structured_delta((), [-1.0]), "filtered", loop
    )
    found = analysis_bound(design, loop=loop)
    assert_allclose(found.mean_square, at_the_edge[0, 0], rtol=3e-5)
    assert found.mean_square < 0.9 * design.mean_square_bound


def test_constant_slope_is_not_the_worst_for_the_smoothed_error_of_the_example():
    design = example("smoothed")
    edge = error_covariance(design, design.plant.structured_delta((), [-1.0]))[0, 0]
    found = analysis_bound(design, "smoothed")
    assert 1.03 * edge < found.mean_square < 1.05 * edge


def test_delay_model_of_the_smoothed_error_has_converged(monkeypatch):
    found = [analysis_bound(example(cost), "smoothed", "real").mean_square for cost in NEAR_INFIMUM]
    monkeypatch.setattr("robsmooth.analysis.constraints._DELAY_ORDERS", (16, 32))
    fine = [analysis_bound(example(cost), "smoothed", "real").mean_square for cost in NEAR_INFIMUM]
    assert_allclose(found, fine, rtol=1e-5)


def of_sensor(noise):
    gain = Uncertainty([[0.0]], [[0.05]], [[1.0]])
    return UncertainSystem([[-1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, noise]], [gain])


@pytest.mark.parametrize("order", [9, 10, 11])
def test_an_estimator_is_not_judged_by_its_own_model_of_a_long_delay(order):
    """Such a model errs as the estimate does: of order 10, the bound was below a constant error."""
    long = baselines.fixed_lag_smoother(of_sensor(0.03), 1.0, order)
    found = analysis_bound(long, "smoothed", "real")
    assert worst_case(long, "smoothed", "real").mean_square < found.mean_square
    finer = replace(long, plant=augment(long.plant.system, 1.0, 60))
    problem = ConstraintProblem(scaled(model_loop(finer))[0], long.plant)
    assert_allclose(found.mean_square, certify(problem)[0], rtol=1e-3)


@settings(max_examples=15)
@given(designs(cost="smoothed"))
def test_where_a_search_starts_does_not_change_the_bound(design):
    """The multipliers of a coarser delay model are the start: without it the bound is the same."""
    found, system = analysis_bound(design, "smoothed"), design.plant.system
    order = (found.feedback.shape[1] - len(design.A_c) - system.n) // system.m
    finer = replace(
        design, plant=augment(system, design.plant.delay, order, J_21=design.plant.J_21)
    )
    problem = ConstraintProblem(scaled(model_loop(finer, "theory"))[0], design.plant)
    assert_allclose(found.mean_square, certify(problem)[0], rtol=1e-6)


@pytest.mark.parametrize(("delay", "error"), [(30.72, 13.812), (47.43, 14.241)])
def test_a_coarse_model_may_agree_with_the_delay_by_accident_under_its_own_worst_input(
    delay, error
):
    """With order 10 it does here, and the bound is 9.72 and 11.41."""
    spring = Uncertainty([[0.0], [1.0]], [[0.3, 0.0]], [[0.0]])
    A, B1 = [[0.0, 1.0], [-1.0, -0.4]], [[0.0, 0.0], [1.0, 0.0]]
    system = UncertainSystem(A, B1, [[1.0, 0.0]], [[1.0, 0.0]], [[0.0, 0.1]], [spring])
    coarse = baselines.fixed_lag_smoother(system, delay, 2)
    assert_allclose(analysis_bound(coarse, "smoothed", "real").mean_square, error, rtol=1e-3)


@settings(max_examples=15)
@given(
    st.floats(0.02, 1.0), st.floats(0.02, 2.0), st.integers(1, 10), st.sampled_from([False, True])
)
def test_no_constant_uncertainty_has_a_larger_error_than_the_bound(noise, delay, order, robust):
    plant = augment(of_sensor(noise), delay, order)
    classical = partial(baselines.fixed_lag_smoother, plant.system, delay, order)
    design = minimax_smoother(plant) if robust else classical()
    bound = analysis_bound(design, "smoothed", "real").mean_square
    assert worst_case(design, "smoothed", "real").mean_square <= 1.001 * bound


def test_a_delay_that_needs_too_fine_a_model_is_not_judged():
    too_long = baselines.fixed_lag_smoother(of_sensor(1e-4), 1.0, 10)
    with pytest.raises(ArithmeticError, match="order above 80, because 1 s is very long"):
        analysis_bound(too_long, "smoothed", "real")


def test_classical_smoother_has_a_bound_too():
    system = homodyne.PAPER.uncertain_system()
    classical = baselines.fixed_lag_smoother(system, 3.1e-6, 2, copies=True)
    found = analysis_bound(classical, "smoothed", loop="real")
    robust = analysis_bound(example("smoothed"), "smoothed", loop="real")
    assert found.mean_square < robust.mean_square < 1.01 * found.mean_square


def test_bound_does_not_depend_on_the_unit_of_time():
    mega = 2.0**20  # microseconds, nearly
    system = homodyne.PAPER.uncertain_system()
    slow = UncertainSystem(
        A=system.A / mega,
        B1=system.B1 / mega**0.5,
        C0=system.C0,
        C2=system.C2,
        D21=system.D21 * mega**0.5,
        uncertainties=[
            replace(c, B=c.B / mega**0.5, D=c.D * mega**0.5) for c in system.uncertainties
        ],
        nonlinearities=[
            replace(c, B=c.B / mega**0.5, C=c.C / mega**0.5, D=c.D * mega**0.5, function=None)
            for c in system.nonlinearities
        ],
    )
    here, there = (
        analysis_bound(baselines.fixed_lag_smoother(s, lag, 2, copies=True), "smoothed")
        for s, lag in ((system, 3.1e-6), (slow, 3.1e-6 * mega))
    )
    assert_allclose(there.mean_square, here.mean_square, rtol=1e-7)


def test_report_of_a_bound():
    found = analysis_bound(example("filtered"))
    assert repr(found).startswith(f"AnalysisBound(mean_square={found.mean_square:.5g}, gap=")
    assert repr(found).endswith(", fraction=1)")
    none = analysis_bound(looking_at_nothing(2.0), "filtered")
    assert repr(none).startswith("AnalysisBound(mean_square=inf, gap=nan, fraction=0.")


def test_what_is_not_understood_is_refused():
    design = example("filtered")
    linear = baselines.kalman_bucy(design.plant.system)
    with pytest.raises(TypeError, match="smoother must be an Estimator, got str"):
        analysis_bound("design")
    with pytest.raises(ValueError, match=r"output must be one of .*'guaranteed', got 'both'"):
        analysis_bound(design, "both")
    with pytest.raises(ValueError, match="loop must be one of 'theory', 'real', got 'ideal'"):
        analysis_bound(design, loop="ideal")
    with pytest.raises(TypeError, match="copy_noise must be True or False"):
        analysis_bound(design, copy_noise=1)
    with pytest.raises(ValueError, match=r"is for a RobustSmoother or .* got Estimator"):
        analysis_bound(linear)


@pytest.mark.parametrize("time", [1e-9, 1e9])
def test_bound_does_not_depend_on_the_units_of_states_and_measurements(time):
    system = cancelling(DRIVE, GAIN)
    other = in_other_units(system, time, [1e6, 1e-5], [1e4])
    plants = augment(system, 1.0, 1), augment(other, 1.0 / time, 1)
    here, there = (
        analysis_bound(baselines.tuned_fixed_lag_smoother(plant), "smoothed", "real")
        for plant in plants
    )
    assert_allclose(there.mean_square, here.mean_square, rtol=1e-6)
    # theta is in the unit of time, and the worst input a feedback of the plant's own states
    assert_allclose(there.multipliers * time, here.multipliers, rtol=1e-4)
    in_these_units = there.feedback[:, :2] * [1e-6, 1e5] / time**0.5
    assert_allclose(in_these_units, here.feedback[:, :2], rtol=1e-4)
