"""The worst uncertainty: against grids, random ones, quadrature, and what theory says of it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robsmooth import (
    Estimator,
    UncertainSystem,
    Uncertainty,
    UnstableLoopError,
    augment,
    design_smoother,
    error_covariance,
    homodyne,
)
from robsmooth.analysis.constraints import analysis_bound
from robsmooth.analysis.worst_case import (
    mean_square_and_gradient,
    worst_case,
    worst_dynamic_case,
)
from robsmooth.estimators import baselines
from robsmooth.estimators.loop import LOOPS, OUTPUTS, open_loop
from tests.helpers.loops import looking_at_nothing
from tests.helpers.strategies import (
    admissible_delta,
    designs,
    feasible_design,
    random_system,
    seeds,
)


@pytest.fixture(scope="module")
def example():
    """Its cost is on the smoothed error, for which no constant uncertainty is the worst."""
    plant = augment(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    return design_smoother(plant, 7.0229e-7, [1.0, 0.4999, 1e-6, 1e-6], "smoothed")


def designed(seed, cost="filtered", size=0.1, **sizes):
    """A random design whose bound was not minimised."""
    rng = np.random.default_rng(seed)
    design = feasible_design(rng, augment(random_system(rng, size=size, **sizes), 0.7, 2), cost)
    assert design is not None
    return design


@settings(max_examples=20)
@given(designs(), st.sampled_from(OUTPUTS), st.sampled_from(LOOPS), seeds)
def test_gradient_is_that_of_the_error(design, output, loop, seed):
    rng = np.random.default_rng(seed)
    opened = open_loop(design, output, loop)
    Delta = 0.9 * admissible_delta(rng, design.plant)
    value, gradient = mean_square_and_gradient(opened, Delta)
    if output != "guaranteed":
        assert_allclose(value, np.trace(error_covariance(design, Delta, output, loop)), rtol=1e-8)
    direction = rng.standard_normal(Delta.shape)
    step = 1e-5
    beside = [
        mean_square_and_gradient(opened, Delta + sign * step * direction)[0] for sign in (1, -1)
    ]
    scale = np.linalg.norm(gradient) * np.linalg.norm(direction) + value
    assert abs((beside[0] - beside[1]) / (2 * step) - (gradient * direction).sum()) < 1e-5 * scale


@settings(max_examples=15)
@given(designs(), st.sampled_from(["smoothed", "filtered"]), st.sampled_from(LOOPS), seeds)
def test_no_admissible_uncertainty_is_worse(design, output, loop, seed):
    worst = worst_case(design, output, loop)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        Delta = admissible_delta(rng, design.plant)
        error = np.trace(error_covariance(design, Delta, output, loop))
        assert error <= worst.mean_square * (1 + 1e-9)
    assert worst.nominal <= worst.mean_square


@settings(max_examples=15)
@given(designs(), st.sampled_from(["smoothed", "filtered"]))
def test_worst_uncertainty_is_admissible_and_has_the_error_that_it_is_said_to(design, output):
    plant, worst = design.plant, worst_case(design, output)
    assert worst.mean_square == np.trace(error_covariance(design, worst.Delta, output))
    blocks, slopes = [], []
    row = column = 0
    for rows, columns in zip(plant.input_sizes, plant.output_sizes, strict=True):
        blocks.append(worst.Delta[row : row + rows, column : column + columns])
        row, column = row + rows, column + columns
    k, g = plant.system.k, plant.system.g
    for block, channel in zip(blocks[:k], plant.system.uncertainties, strict=True):
        assert np.linalg.norm(block, 2) <= 1 + 1e-12
        assert channel.C.any() or not block.any()
    for own, copy, channel in zip(
        blocks[k : k + g], blocks[k + g :], plant.system.nonlinearities, strict=True
    ):
        assert own == copy
        assert abs(own[0, 0]) <= channel.lipschitz * (1 + 1e-12)
        slopes.append(own[0, 0])
    assert_array_equal(worst.Delta, plant.structured_delta(blocks[:k], slopes))


def test_worst_of_two_slopes_is_the_largest_of_a_grid():
    plain = random_system(np.random.default_rng(3), n=2, m=2, measurements=2, g=2, size=0.15)
    channels = [Uncertainty(c.B, 0 * c.C, c.D) for c in plain.uncertainties]
    system = UncertainSystem(
        plain.A, plain.B1, plain.C0, plain.C2, plain.D21, channels, plain.nonlinearities
    )
    design = baselines.fixed_lag_smoother(system, 0.7, 2, copies=True)
    worst = worst_case(design)
    constants = [c.lipschitz for c in system.nonlinearities]
    grid = [
        np.trace(error_covariance(design, design.plant.structured_delta((), slopes)))
        for a in np.linspace(-1, 1, 21)
        for b in np.linspace(-1, 1, 21)
        for slopes in [(a * constants[0], b * constants[1])]
    ]
    assert max(grid) <= worst.mean_square * (1 + 1e-12)
    assert_allclose(max(grid), worst.mean_square, rtol=1e-3)


def test_worst_slope_of_the_example_is_the_edge_of_its_sector(example):
    for output in ("smoothed", "filtered"):
        worst = worst_case(example, output, loop="real")
        assert_array_equal(worst.Delta, example.plant.structured_delta((), [-1.0]))


@pytest.mark.parametrize("uncertainty", [0.2, 0.9])
def test_decay_rate_is_at_its_slowest(uncertainty):
    worst = worst_case(looking_at_nothing(uncertainty), "filtered")
    assert_allclose(worst.mean_square, 1 / (2 * (1 - uncertainty)), rtol=1e-12)
    assert_array_equal(worst.Delta, np.diag([1.0, 0.0]))
    assert worst.guarantee is None
    assert worst.tightness is None
    assert repr(worst).startswith("WorstCase(mean_square=")


@pytest.mark.parametrize("uncertainty", [1.0, 1.5])
def test_worst_case_is_infinite_where_the_loop_can_be_unstable(uncertainty):
    smoother = looking_at_nothing(uncertainty)
    worst = worst_case(smoother, "filtered")
    assert math.isinf(worst.mean_square)
    assert_allclose(worst.nominal, 0.5)
    A = smoother.plant.A_p + smoother.plant.B1_tilde @ worst.Delta @ smoother.plant.C1_tilde
    assert np.linalg.eigvals(A).real.max() > -1e-12


def test_worst_case_of_a_loop_that_is_never_stable_is_infinite():
    smoother = looking_at_nothing(0.1)
    broken = Estimator(**{**vars(smoother), "A_c": np.array([[1.0]])})
    worst = worst_case(broken, "filtered")
    assert math.isinf(worst.mean_square)
    assert math.isinf(worst.nominal)


def test_without_uncertainty_the_nominal_case_is_the_worst():
    design = baselines.kalman_bucy(UncertainSystem([[-1.0]], [[1.0, 0.0]], [[1]], [[1]], [[0, 1]]))
    worst = worst_case(design)
    assert worst.mean_square == worst.nominal
    assert worst.Delta.shape == (0, 0)


@settings(max_examples=6)
@given(st.sampled_from(["filtered", "smoothed"]).flatmap(lambda cost: designs(cost=cost)))
def test_guarantee_holds_for_the_error_that_it_is_for(design):
    worst = worst_case(design, "guaranteed")
    assert worst.mean_square <= worst.guarantee == design.mean_square_bound
    assert worst.tightness == worst.mean_square / worst.guarantee
    assert worst_case(design, "smoothed").guarantee is None
    covered = worst_case(design, "filtered").guarantee
    assert covered == (worst.guarantee if design.cost == "filtered" else None)


def test_guaranteed_error_is_against_the_model_of_the_delay(example):
    # the model is good, and so is C_a instead of w-hat's gain: the two errors are nearly the same
    smoothed, guaranteed = (worst_case(example, o) for o in ("smoothed", "guaranteed"))
    assert smoothed.mean_square != guaranteed.mean_square
    assert_allclose(smoothed.mean_square, guaranteed.mean_square, rtol=0.01)


def test_search_does_not_depend_on_the_seed():
    design = designed(8, n=3, m=2, measurements=2, g=2)
    first, second = (worst_case(design, seed=seed).mean_square for seed in (0, 1))
    assert_allclose(first, second, rtol=1e-9)


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("output", OUTPUTS)
def test_worst_phase_of_the_example_is_the_best_of_a_grid(example, output, loop):
    found = worst_dynamic_case(example, output, loop)
    opened = open_loop(example, output, loop)
    some = np.arange(0, len(found.frequencies), 37)
    phases = np.exp(1j * np.linspace(0, 2 * np.pi, 721))
    for i in some:
        s = 1j * found.frequencies[i]
        best = 0.0
        for phase in phases:
            Delta = np.diag([0.0, phase, phase])
            A = opened.A + opened.inputs @ Delta @ opened.outputs
            states = np.linalg.solve(s * np.eye(len(A)) - A, opened.B)
            T = (opened.truth * np.exp(-s * opened.delay) - opened.estimate) @ states
            best = max(best, (np.abs(T) ** 2).sum())
        assert best <= found.spectra[2, i] * (1 + 1e-9)
        assert_allclose(best, found.spectra[2, i], rtol=1e-4)
    slopes = found.Delta[:, 1, 1]
    assert_allclose(np.abs(slopes), 1.0, rtol=1e-9)
    assert_array_equal(slopes, found.Delta[:, 2, 2])


@pytest.mark.parametrize(
    "seed, sizes, output", [(3, {"m": 1, "g": 0}, "smoothed"), (5, {"m": 2, "g": 1}, "filtered")]
)
def test_worst_at_each_frequency_is_worse_than_constant_and_than_random(seed, sizes, output):
    design = designed(seed, n=2, measurements=2, **sizes)
    found = worst_dynamic_case(design, output, starts=4)
    nominal, constant, worst = found.spectra
    assert found.constant.mean_square < found.mean_square
    assert (worst >= constant * (1 - 1e-9)).all()
    assert (worst >= nominal * (1 - 1e-9)).all()
    # the integral, by another rule, is what the Lyapunov equation says
    log = np.log(found.frequencies)
    for spectrum, expected in zip(
        found.spectra,
        (found.constant.nominal, found.constant.mean_square, found.mean_square),
        strict=True,
    ):
        inside = np.trapezoid(spectrum * found.frequencies, log) / np.pi
        assert_allclose(inside, expected, rtol=2e-3)
    loop, rng = open_loop(design, output, "theory"), np.random.default_rng(seed)
    for i in rng.integers(len(worst), size=40):
        blocks = [rng.standard_normal((2, *block.shape)) for block in loop.blocks]
        blocks = [real + 1j * imaginary for real, imaginary in blocks]
        Delta = loop.assemble([each / np.linalg.norm(each, 2) for each in blocks], ())
        A = loop.A + loop.inputs @ Delta @ loop.outputs
        s = 1j * found.frequencies[i]
        T = (loop.truth * np.exp(-s * loop.delay) - loop.estimate) @ np.linalg.solve(
            s * np.eye(len(A)) - A, loop.B
        )
        assert (np.abs(T) ** 2).sum() <= worst[i] * (1 + 1e-9)


def test_an_uncertainty_that_knows_the_future_is_worse_than_the_exact_worst_case():
    # |1/(j omega + 1 - Delta)|^2 is at most 1/(|j omega + 1| - a)^2; causal: 1/2(1 - a)
    a = 0.3
    smoother = looking_at_nothing(a)
    found = worst_dynamic_case(smoother, "filtered")
    omega = found.frequencies
    assert_allclose(found.spectra[2], 1 / (np.sqrt(1 + omega**2) - a) ** 2, rtol=1e-9)
    exact = analysis_bound(smoother, "filtered").mean_square
    assert_allclose(exact, worst_case(smoother, "filtered").mean_square, rtol=1e-6)
    assert found.mean_square > 1.1 * exact


def test_no_theorem_has_the_worst_at_each_frequency_below_the_guarantee(example):
    above = designed(25, n=2, m=1, measurements=1, g=0)
    assert worst_dynamic_case(above, "guaranteed").mean_square > 1.05 * above.mean_square_bound
    assert analysis_bound(above).mean_square < above.mean_square_bound
    assert worst_dynamic_case(example, "guaranteed").mean_square < example.mean_square_bound


def test_dynamic_case_wants_a_loop_that_is_proven_stable():
    with pytest.raises(UnstableLoopError, match=r"no multipliers prove .* scaled by 0\.[67]"):
        worst_dynamic_case(looking_at_nothing(1.5), "filtered")


def test_without_uncertainty_nothing_is_worse_than_the_nominal_error():
    system = UncertainSystem(A=[[-1.0]], B1=[[1, 0]], C0=[[1.0]], C2=[[1.0]], D21=[[0, 0.1]])
    for smoother in (
        baselines.fixed_lag_smoother(system, 0.2, 2),
        baselines.kalman_bucy(replace(system, uncertainties=[Uncertainty([[0]], [[0]], [[0]])])),
    ):
        nothing = smoother.plant.structured_delta()
        nominal = error_covariance(smoother, nothing)[0, 0]
        found = worst_dynamic_case(smoother)
        assert_allclose(found.mean_square, nominal, rtol=1e-4)
        assert found.constant.mean_square == found.constant.nominal == nominal


def test_worst_cases_do_not_depend_on_the_unit_of_time():
    design = designed(5, n=2, m=1, measurements=1, g=1)
    system, fast = design.plant.system, 2.0**30

    def faster(channel):
        return {"B": channel.B * fast, "D": channel.D}

    quick = UncertainSystem(
        A=system.A * fast,
        B1=system.B1 * fast**0.5,
        C0=system.C0,
        C2=system.C2,
        D21=system.D21 / fast**0.5,
        uncertainties=[Uncertainty(C=c.C, **faster(c)) for c in system.uncertainties],
        nonlinearities=[
            type(c)(C=c.C, lipschitz=c.lipschitz, **faster(c)) for c in system.nonlinearities
        ],
    )
    pair = [
        baselines.fixed_lag_smoother(s, lag, 2, copies=True)
        for s, lag in ((system, 0.7), (quick, 0.7 / fast))
    ]
    slow, fast_one = (worst_case(each, loop="real") for each in pair)
    assert_allclose(fast_one.mean_square, slow.mean_square, rtol=1e-9)
    slow, fast_one = (worst_dynamic_case(each, "filtered", "real", starts=2) for each in pair)
    assert_allclose(fast_one.mean_square, slow.mean_square, rtol=1e-7)
    assert repr(slow).startswith("WorstDynamicCase(mean_square=")


def test_what_is_not_understood_is_refused(example):
    for function in (worst_case, worst_dynamic_case):
        with pytest.raises(TypeError, match="smoother must be an Estimator, got str"):
            function("design")
        with pytest.raises(ValueError, match=r"output must be one of .*, got 'both'"):
            function(example, "both")
        with pytest.raises(ValueError, match="loop must be one of 'theory', 'real', got 'ideal'"):
            function(example, loop="ideal")
        with pytest.raises(ValueError, match="starts must be an integer of at least 1"):
            function(example, starts=0)
        with pytest.raises(ValueError, match="seed must be an integer of at least 0"):
            function(example, seed=-1)
