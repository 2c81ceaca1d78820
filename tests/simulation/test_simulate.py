"""Simulation of any system: its steps, its errors and checks, each by a second route.

Seeds are fixed. Had they been free, a correct program would fail a comparison at `SIGMAS` = 4.5
standard errors once in 150 000 times; there are about 70 of them here.
"""

import math
import warnings
from dataclasses import replace

import numba
import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebvander
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad, solve_ivp
from scipy.linalg import block_diag
from scipy.signal import cont2discrete
from scipy.special import erfc
from scipy.stats import norm

from robsmooth._numerics.vectors import BLOCK
from robsmooth._support.checkpoint import CheckpointError
from robsmooth._support.errors import UnstableLoopError
from robsmooth.analysis.covariance import error_covariance
from robsmooth.estimators.baselines import fixed_lag_smoother, kalman_bucy
from robsmooth.homodyne import PAPER
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.moments import stationary_errors
from robsmooth.homodyne.montecarlo import monte_carlo
from robsmooth.simulation import noise
from robsmooth.simulation import simulate as run
from robsmooth.simulation.kernel import CHUNK, Function
from robsmooth.simulation.loop import NonlinearLoop, Steps, nonlinear_loop
from robsmooth.simulation.simulate import sample_paths, simulate
from robsmooth.simulation.statistics import InadmissibleWarning
from robsmooth.systems.augmented import augment
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.system import UncertainSystem
from tests.helpers.loops import assert_within
from tests.helpers.printed import printed_estimator
from tests.helpers.strategies import (
    admissible_delta,
    feasible_design,
    random_system,
)


def with_functions(system, *functions):
    members = [
        replace(c, function=f) for c, f in zip(system.nonlinearities, functions, strict=True)
    ]
    return replace(system, nonlinearities=members)


def scalar_system(function=None, lipschitz=1.0, into_state=0.0):
    """An Ornstein-Uhlenbeck process of variance 1/2, measured through 1 + psi."""
    return UncertainSystem(
        A=[[-1.0]],
        B1=[[1.0, 0.0]],
        C0=[[1.0]],
        C2=[[1.0]],
        D21=[[0.0, 0.5]],
        uncertainties=[Uncertainty(B=[[1.0]], C=[[0.3]], D=[[0.0]])],
        nonlinearities=[
            Nonlinearity([[into_state]], [[1.0]], [[0.5]], lipschitz=lipschitz, function=function)
        ],
    )


def soft(value):
    """A function of slope zero at zero, and Lipschitz with constant one."""
    return value - np.tanh(value)


def curved_estimator(delay=0.3, order=2, seed=3):
    """An estimator for a system with m = l = g = k = 2, its functions curved, with its copies."""
    system = random_system(np.random.default_rng(seed), n=3, m=2, measurements=2, g=2)
    system = with_functions(system, soft, lambda v: 0.5 * np.sin(v))
    return fixed_lag_smoother(system, delay, order, copies=True)


def referring_to(estimator, *references):
    """The same estimator for nonlinearities with these references."""
    plant, members = estimator.plant, estimator.plant.system.nonlinearities
    members = [replace(c, reference=r) for c, r in zip(members, references, strict=True)]
    system = replace(plant.system, nonlinearities=members)
    return replace(estimator, plant=replace(plant, system=system))


# --- the scheme -----------------------------------------------------------------------------------


def restoring(value):
    return -2.0 * np.tanh(2.0 * value)


def restored_loop(slope):
    """The equation dx = (-x - 2 tanh 2x) dt + dW, the slope taken into the linear part."""
    one = np.eye(1)
    return NonlinearLoop(
        drift=-one,
        inputs=one,
        noise=one,
        arguments=one,
        reference=0 * one,
        readout=np.ones((3, 1)),
        delta=np.array([[slope]]),
        functions=(Function([0], [0], restoring, True),),
        lipschitz=np.array([4.0]),
    )


def variance_of_the_chain(integrator, reach=3.3, size=80, nodes=40):
    """Stationary E x^2 of the steps, without sampling: their transfer operator on polynomials."""
    angles = np.pi * (np.arange(size) + 0.5) / size
    x = reach * np.cos(angles)
    draws, weights = np.polynomial.hermite_e.hermegauss(nodes)
    z = np.repeat(x, nodes)[None]
    after = integrator.advance(0.0, z, integrator.noise @ np.tile(draws, size)[None])[0]
    values_to_coefficients = 2 / size * np.cos(np.outer(np.arange(size), angles))
    values_to_coefficients[0] /= 2
    basis = chebvander(np.clip(after / reach, -1, 1), size - 1) @ values_to_coefficients
    operator = np.einsum("k,ikj->ij", weights / weights.sum(), basis.reshape(size, nodes, size))
    conditions = np.vstack([operator.T - np.eye(size), np.ones(size)])
    density = np.linalg.lstsq(conditions, np.eye(size + 1)[-1], rcond=None)[0]
    return density @ x**2


@pytest.mark.parametrize(("slope", "bias_of_default"), [(0.0, 5e-3), (-2.8865, 1e-3)])
def test_stationary_variance_converges_with_the_second_order(slope, bias_of_default):
    def potential(x):
        return x**2 + 2 * np.log(np.cosh(2 * x))

    total, second = (quad(lambda x, p=p: x**p * np.exp(-potential(x)), -8, 8)[0] for p in (0, 2))
    loop = restored_loop(slope)
    biases = [
        variance_of_the_chain(Steps(loop, step)) / (second / total) - 1
        for step in 0.05 / 2.0 ** np.arange(5)
    ]
    orders = np.log2(np.divide(biases[:-1], biases[1:]))
    assert (np.diff(orders) > 0.0).all()
    assert orders[-1] == pytest.approx(2.0, abs=0.05)
    assert run.STEP_OF_TIME_CONSTANT / loop.argument_rate() == pytest.approx(0.05)
    assert abs(biases[0]) < bias_of_default


@pytest.mark.parametrize("referenced", [False, True])
def test_equations_are_those_of_the_paper(referenced):
    """Without noise: against scipy's solver on the system and the estimator as they are written."""
    estimator = curved_estimator()
    taken_off = np.zeros((2, len(estimator.A_c)))
    if referenced:
        estimator, weights = two_detectors(("filtered", "smoothed"))
        taken_off = np.vstack([weights[0] @ estimator.C_f, weights[1] @ estimator.C_a])
    system, m, measurements = estimator.plant.system, 2, 2
    x_size = system.n
    block = np.array([[0.3, -0.2, 0.4], [0.1, 0.5, -0.3]])

    def xi(t, zeta):
        return math.cos(3 * t) * np.tanh(zeta[[0, 0]])

    def rates(t, state):
        x, x_hat = state[:x_size], state[x_size:-measurements]
        first, second = system.uncertainties
        r = taken_off @ x_hat
        inputs = [(first, block @ first.C @ x), (second, xi(t, (second.C @ x)[:, None])[:, 0])]
        inputs += [(c, c.function(c.C @ x - r[i])) for i, c in enumerate(system.nonlinearities)]
        dx = system.A @ x + sum(c.B @ u for c, u in inputs)
        dy = system.C2 @ x + sum(c.D @ u for c, u in inputs)
        copies = [
            c.function(nu)
            for c, nu in zip(system.nonlinearities, estimator.C_c[m:] @ x_hat - r, strict=True)
        ]
        dx_hat = estimator.A_c @ x_hat + estimator.B_c @ [*dy, *copies]
        return np.concatenate([dx, dx_hat, dy])

    loop = nonlinear_loop(estimator, [block, xi])
    start = np.random.default_rng(0).standard_normal((loop.order, 1))
    start[x_size + 3 :] = 0.0
    exact = solve_ivp(
        rates, (0, 1.2), np.append(start, [0, 0]), rtol=1e-11, atol=1e-12, dense_output=True
    )
    misfits = []
    for steps in (32, 64, 128):
        integrator = Steps(loop, 1.2 / steps, measured=True)
        z = np.vstack([start, np.zeros((measurements, 1))])
        integral = np.zeros((measurements, 1))
        for k in range(steps):
            z = integrator.advance(k * integrator.step, z, np.zeros_like(z))
            integral += z[loop.order :]
        found = np.vstack([z[: loop.order], integral])[:, 0]
        misfits.append(np.abs(found - exact.y[:, -1]).max())
    assert misfits[-1] < 1e-4
    assert_allclose(np.log2(np.divide(misfits[:-1], misfits[1:])), 2.0, atol=0.25)


def drawn(seed, size, steps):
    """The normal variables of the first paths, (steps, size, paths), by the generators alone."""
    generator = np.empty(noise.WORDS * BLOCK, np.uint32)
    noise.seed_paths(np.uint64(seed), np.uint64(0), generator)
    parts = []
    for rows, count in zip(size, steps, strict=True):
        pairs = -(-rows // noise.DRAWS)
        normals = np.empty(count * pairs * noise.DRAWS * BLOCK, np.float32)
        noise.fill_gaussians(generator, count * pairs, normals)
        parts.append(normals.reshape(count, -1, BLOCK)[:, :rows].astype(float))
    return parts


def test_the_kernel_takes_the_steps_of_the_scheme():
    """Its paths, with functions of all kinds, against NumPy's steps with the same noise."""
    estimator, _ = two_detectors(("filtered", "smoothed"))
    uncertainties = [lambda t, zeta: 0.3 * np.cos(t) * zeta[[0, 0]], [[0.5], [0.2]]]
    found = sample_paths(estimator, uncertainties=uncertainties, runs=5, duration=3.0, seed=7)
    loop = nonlinear_loop(estimator, uncertainties)
    steps = Steps(loop, found.step, measured=True)
    count, N, measured = len(found.time), loop.order, 2
    warm_up = simulate(estimator, uncertainties=uncertainties, runs=1, duration=3.0).warm_up
    before = round(warm_up / found.step)
    start, of_state = drawn(7, (loop.stationary_root.shape[1], N), (1, before + count))
    (of_measurement,) = drawn(noise.mix(np.uint64(7)), (measured,), (before + count,))
    z = np.vstack([loop.stationary_root @ start[0], np.zeros((measured, BLOCK))])
    for k in range(before + count):
        normals = np.vstack([of_state[k], of_measurement[k]])
        z = steps.advance((k - before) * found.step, z, steps.noise @ normals)
        if k >= before:
            signals = (steps.scheme.signals @ z)[:, :5].T
            for name, columns in (("w", [0, 1]), ("filtered", [2, 3]), ("smoothed", [4, 5])):
                assert_allclose(getattr(found, name)[:, k - before], signals[:, columns], rtol=1e-9)
            assert_allclose(found.y[:, k - before], signals[:, -2:], rtol=1e-9, atol=1e-9)


# --- the errors -----------------------------------------------------------------------------------


# The scheme is exact for linear functions, too, which it does not know to be linear.
exact_for_any_step = pytest.mark.filterwarnings("ignore::robsmooth.LongStepWarning")


@exact_for_any_step
@pytest.mark.parametrize(("delay", "order"), [(0.0, 0), (0.4, 0), (0.3, 2)])
def test_errors_of_a_linear_loop_have_their_covariance(delay, order):
    rng = np.random.default_rng(10 * order)
    system = random_system(rng, n=3, m=2, measurements=2, g=2)
    Delta = admissible_delta(rng, augment(system, delay, order))
    # functions that are the slopes of Delta: rows are the inputs 2 + 2, then 2 and 2 copies
    slopes = np.diag(Delta[4:, 4:])[:2]
    system = with_functions(system, *(lambda v, s=s: s * v for s in slopes))
    estimator = fixed_lag_smoother(system, delay, order, copies=True)
    result = simulate(
        estimator,
        uncertainties=[Delta[:2, :3], Delta[2:4, 3:4]],
        runs=200,
        duration=60.0,
        step=0.2 if order == 0 else 0.15,
    )
    assert_allclose(result.equivalent_delta, Delta, rtol=1e-9, atol=1e-12)
    for output in ("filtered", "smoothed"):
        expected = error_covariance(estimator, Delta, output, "real")
        error = getattr(result, output)
        assert_within(error.mean_square, np.trace(expected), error.standard_error)
        assert error.standard_error < 0.03 * np.trace(expected)
    assert result.constraints.max() <= 1.0 + 1e-9
    assert not result.violated.any()


def test_system_without_channels_has_its_covariance():
    system = UncertainSystem(
        A=[[-1.0, 1.0], [0.0, -0.5]],
        B1=np.eye(2, 3),
        C0=[[1.0, 0.0]],
        C2=[[1.0, 0.0]],
        D21=[[0, 0, 1]],
    )
    estimator = fixed_lag_smoother(system, 0.5, 3)
    result = simulate(estimator)
    for output in ("filtered", "smoothed"):
        error = getattr(result, output)
        expected = error_covariance(estimator, np.zeros((0, 0)), output)
        assert_within(error.mean_square, np.trace(expected), error.standard_error)
    assert result.constraints.shape == result.violated.shape == (0,)


@pytest.mark.parametrize("uncertainty", [1.0, -1.0, lambda t, zeta: np.cos(5 * t) * zeta])
def test_guarantee_of_a_design_holds_in_the_nonlinear_loop(uncertainty):
    plant = augment(scalar_system(soft), 0.2, 2)
    design = feasible_design(np.random.default_rng(0), plant)
    error = simulate(design, uncertainties=[uncertainty], runs=64, duration=30.0).filtered
    assert error.mean_square + 4 * error.standard_error < design.mean_square_bound


def test_statistical_linearisation_predicts_the_errors_of_a_weak_nonlinearity():
    estimator = curved_estimator()
    result = simulate(estimator, runs=1024, duration=250.0)
    for output in ("filtered", "smoothed"):
        predicted = error_covariance(estimator, result.equivalent_delta, output, loop="real")
        error = getattr(result, output)
        assert error.standard_error < 0.003 * np.trace(predicted)
        assert error.mean_square == pytest.approx(np.trace(predicted), rel=0.01)
    assert np.abs(np.diag(result.equivalent_delta)).max() > 0.01  # not a linear loop


def test_uncertainty_may_be_a_function():
    """One that is linear, so that its errors are known."""
    estimator = fixed_lag_smoother(scalar_system(lambda v: 0.2 * v), 0.2, 2, copies=True)
    result = simulate(estimator, uncertainties=[lambda _, zeta: -zeta], runs=512)
    Delta = estimator.plant.structured_delta([-1.0], [0.2])
    for output in ("filtered", "smoothed"):
        expected = error_covariance(estimator, Delta, output, loop="real")[0, 0]
        nominal = error_covariance(estimator, 0 * Delta, output, loop="real")[0, 0]
        error = getattr(result, output)
        assert_within(error.mean_square, expected, error.standard_error)
        assert abs(nominal - expected) > 20 * error.standard_error
    assert result.constraints[0] == pytest.approx(1.0)


def test_uncertainty_is_given_the_time_from_the_start_of_averaging():
    times = []

    def xi(t, zeta):
        times.append(t)
        return 0.0 * zeta

    estimator = kalman_bucy(scalar_system(soft))
    result = simulate(estimator, uncertainties=[xi], runs=1, duration=2.0, step=0.1)
    assert min(times[1:]) == pytest.approx(-result.warm_up)
    assert max(times) == pytest.approx(2.0)


# --- the reference --------------------------------------------------------------------------------


def homodyne_estimator(name, parameters=PAPER):
    if name == "robust":
        return printed_estimator()
    system = parameters.uncertain_system()
    return fixed_lag_smoother(system, 3.1e-6, 2, copies=name == "classical with copies")


HOMODYNE_ESTIMATORS = ["classical", "classical with copies", "robust"]
# Both simulations take the step of a whole part of the lag, which is long for some of these loops.
at_the_step_of_the_kernel = pytest.mark.filterwarnings("ignore::robsmooth.LongStepWarning")


def test_the_paper_system_is_simulated_with_its_detector():
    """As it is, without a word on the reference: the classical smoother's 0.0484."""
    estimator = homodyne_estimator("classical")
    result = simulate(estimator, runs=512, duration=1e-3, seed=1)
    expected = stationary_errors(PAPER, estimator)
    for name in ("filtered", "smoothed"):
        error = getattr(result, name)
        assert error.standard_error < 4e-3 * error.mean_square
        assert_within(error.mean_square, getattr(expected, name), error.standard_error)
    assert result.smoothed.mean_square == pytest.approx(0.0484, rel=0.02)


@at_the_step_of_the_kernel
@pytest.mark.parametrize("name", HOMODYNE_ESTIMATORS)
@pytest.mark.parametrize("oscillator", ["filtered", "smoothed"])
def test_homodyne_loop_has_the_errors_of_its_own_kernel(name, oscillator):
    estimator = homodyne_estimator(name)
    how = {"runs": 512, "duration": 1e-3, "step": 3.875e-7}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InadmissibleWarning)  # rare excursions of the error
        result = simulate(referring_to(estimator, oscillator), seed=2, **how)
    kernel = monte_carlo(PAPER, estimator, oscillator=oscillator, **how)
    moments = stationary_errors(PAPER, estimator, oscillator=oscillator)
    assert kernel.slips == 0
    for output in ("filtered", "smoothed"):
        here, there = getattr(result, output), getattr(kernel, output)
        assert here.standard_error < 4e-3 * here.mean_square
        deviation = math.hypot(here.standard_error, there.standard_error)
        assert_within(here.mean_square, there.mean_square, deviation)
        assert_within(here.mean_square, getattr(moments, output), here.standard_error)


def test_errors_with_a_reference_are_predicted_by_its_equivalent_slopes():
    estimator = fixed_lag_smoother(PAPER.uncertain_system(), 3.1e-6, 2, copies=True)
    found = simulate(estimator, runs=64, duration=1e-3)
    with_reference = {"loop": "real", "allow_inadmissible": True, "reference": "system"}
    predicted = error_covariance(estimator, found.equivalent_delta, **with_reference)[0, 0]
    assert predicted == pytest.approx(found.smoothed.mean_square, rel=0.02)


@at_the_step_of_the_kernel
@pytest.mark.parametrize("name", ["classical", "classical with copies"])
def test_without_a_reference_the_sine_is_of_the_whole_phase(name):
    """As the words of Section IV-E have it, in a loop that is quiet enough to stay in lock."""
    parameters = replace(PAPER, kappa=4e3)
    estimator = homodyne_estimator(name, parameters)
    how = {"duration": 2e-3, "step": 7.75e-7}
    kernel = monte_carlo(parameters, estimator, oscillator="none", runs=2048, **how)
    with pytest.warns(InadmissibleWarning, match=r"nonlinearities\[0\] less its copy for"):
        result = simulate(referring_to(estimator, None), runs=512, **how)
    for output in ("filtered", "smoothed"):
        here, there = getattr(result, output), getattr(kernel, output)
        deviation = math.hypot(here.standard_error, there.standard_error)
        assert deviation < 0.02 * there.mean_square
        assert_within(here.mean_square, there.mean_square, deviation)


@pytest.mark.parametrize("name", HOMODYNE_ESTIMATORS)
@pytest.mark.parametrize(
    "options",
    [{}, {"oscillator": "smoothed"}, {"oscillator": "none"}, {"copy": False}],
    ids=str,
)
def test_matrices_are_those_of_the_homodyne_loop(name, options):
    """The linear loops of any slopes of the sines, which have every matrix in them."""
    estimator = homodyne_estimator(name)
    if not options.get("copy", True):
        estimator = replace(estimator, B_c=estimator.B_c * [1.0, 0.0])
    reference = options.get("oscillator", "filtered")
    if options.get("oscillator") == "none":
        reference = None
    homodyne = homodyne_loop(PAPER, estimator, **options)
    general = nonlinear_loop(referring_to(estimator, reference))
    N = general.order
    assert_allclose(general.noise[:N, :2], homodyne.noise, rtol=1e-14)
    assert not general.noise[:N, 2:].any()
    readout = block_diag(1.0, homodyne.readout[:2])
    assert_array_equal(general.readout, readout)
    for sine, copy in np.random.default_rng(0).uniform(-1, 1, (3, 2)):
        slopes = (np.array([sine, copy]) - PAPER.beta) / PAPER.gamma
        delta = block_diag(0.0, np.diag(slopes))
        found = general.drift[:N] + general.inputs[:N] @ delta @ general.arguments
        size = np.abs(homodyne.linearised_drift(sine, copy)).max()
        assert_allclose(found, homodyne.linearised_drift(sine, copy), rtol=0, atol=1e-12 * size)


def two_detectors(references=(None, None)):
    """Two outputs, each seen by a detector of its own; arguments that are made of both."""
    system = random_system(np.random.default_rng(5), n=3, m=2, measurements=2, g=2)
    weights = np.array([[2.0, 0.0], [0.5, -1.0]])
    members = [
        replace(c, C=(weights @ system.C0)[[i]], function=f, reference=references[i])
        for i, (c, f) in enumerate(
            zip(system.nonlinearities, (soft, lambda v: 0.5 * np.sin(v)), strict=True)
        )
    ]
    estimator = fixed_lag_smoother(
        replace(system, nonlinearities=members), delay=0.3, order=2, copies=True
    )
    return estimator, weights


@exact_for_any_step
@pytest.mark.parametrize("seed", range(3))
def test_errors_of_a_linear_loop_with_references_have_their_covariance(seed):
    """Two linear nonlinearities, and an estimate taken off each one's argument."""
    estimator, _ = two_detectors(("smoothed", "smoothed"))
    slopes = np.array([0.6, -0.5])
    system = with_functions(estimator.plant.system, *(lambda v, s=s: s * v for s in slopes))
    # with the plant's own gains for its copies, the error would not depend on the reference
    gains = estimator.B_c * [1.0, 1.0, -1.0, 2.0]
    estimator = replace(estimator, plant=augment(system, 0.3, 2), B_c=gains)
    Delta = estimator.plant.structured_delta((), slopes)
    result = simulate(estimator, runs=200, duration=60.0, step=0.15, seed=seed)
    assert_allclose(result.equivalent_delta, Delta, rtol=1e-9, atol=1e-12)
    for output in ("filtered", "smoothed"):
        arguments = (estimator, Delta, output, False)
        expected = error_covariance(*arguments, reference="system")
        error = getattr(result, output)
        assert_within(error.mean_square, np.trace(expected), error.standard_error)
        without = np.trace(error_covariance(*arguments))
        assert abs(np.trace(expected) - without) > 5 * error.standard_error


def test_estimator_run_on_a_record_with_its_reference_gives_the_estimates():
    """A phase near zero: a detector has many points of lock, and the record may begin far off."""
    parameters = replace(PAPER, kappa=4e3)
    estimator = homodyne_estimator("classical with copies", parameters)
    estimator = referring_to(estimator, "smoothed")
    settled, misfits = slice(300, None), []  # it starts from zero
    for step in (3.1e-7, 1.55e-7):
        paths = sample_paths(estimator, runs=8, duration=2e-4, step=step)
        known = zip(paths.y, paths.reference, strict=True)
        found = [
            estimator.discretize(step).run(y, reference=r, output="filtered") for y, r in known
        ]
        misfits.append(np.std((found - paths.filtered)[:, settled]))
    assert misfits[0] < 0.01
    assert misfits[1] / misfits[0] == pytest.approx(0.5, abs=0.3)
    without = [estimator.discretize(step).run(y, output="filtered") for y in paths.y]
    assert np.std((without - paths.filtered)[:, settled]) > 5 * misfits[1]


def test_record_of_a_loop_without_a_reference_has_zeros():
    paths = sample_paths(curved_estimator(), runs=2, duration=1.0)
    assert_array_equal(paths.reference, np.zeros((*paths.y.shape[:2], 2)))


def test_a_reference_that_is_no_estimate_of_w_is_refused():
    estimator = referring_to(curved_estimator(), "filtered", None)
    for function in (simulate, sample_paths):
        with pytest.raises(ValueError, match="there is no estimate of the argument of"):
            function(estimator)


# --- the checks of the theory's constraints -------------------------------------------------------


def dead_zone(value):
    return np.sign(value) * np.maximum(2 * np.abs(value) - 1.0, 0.0)


def test_time_outside_the_lipschitz_region_is_that_of_a_gaussian():
    """|psi(nu)| > |nu| where |nu| > 1, and nu is exactly Gaussian, of variance 1/2."""
    with pytest.warns(InadmissibleWarning, match=r"; nonlinearities\[0\] for 0\.1\d+ of the"):
        result = simulate(kalman_bucy(scalar_system(dead_zone)), runs=400)
    outside, samples = erfc(1.0), 400 * 100 / 2
    assert_within(result.violated[2], outside, math.sqrt(outside / samples))
    scaled = math.sqrt(0.5)
    expected = quad(lambda v: dead_zone(v) ** 2 * norm.pdf(v, scale=scaled), -9, 9, points=[0])[0]
    assert result.constraints[2] == pytest.approx(expected / 0.5, rel=0.03)
    assert_array_equal(result.constraints[[0, 3]], 0.0)  # no uncertainty, and no copy


def test_constraints_are_of_whole_arguments_and_excursions_of_what_is_left():
    """A detector that is steered away: never outside its slopes, yet beyond the constraint."""
    system = scalar_system(lambda v: 0.5 * v)
    estimator = kalman_bucy(system)
    estimator = referring_to(replace(estimator, C_f=-5.0 * estimator.C_f), "filtered")
    with pytest.warns(InadmissibleWarning, match=r"nonlinearities\[0\] for 0 of the time \(1\d"):
        result = simulate(estimator, runs=200)
    assert not result.violated.any()
    loop = nonlinear_loop(estimator)
    P = loop.stationary_root @ loop.stationary_root.T
    left = loop.arguments[-2] @ P @ loop.arguments[-2]
    assert result.constraints[2] == pytest.approx(0.25 * left / P[0, 0], rel=0.05)


def test_constraint_of_a_constant_is_its_square():
    result = simulate(kalman_bucy(scalar_system(soft)), uncertainties=[0.5], runs=4)
    assert result.constraints[0] == pytest.approx(0.25)
    assert result.violated[0] == 0.0


# --- paths ----------------------------------------------------------------------------------------


def test_sample_paths_are_those_that_are_averaged():
    estimator = curved_estimator()
    arguments = {"runs": 5, "duration": 7.0, "seed": 4, "uncertainties": [0.5, -1.0]}
    result = simulate(estimator, **arguments)
    paths = sample_paths(estimator, **arguments)
    assert paths.step == result.step
    for name, error in (
        ("filtered", paths.w - paths.filtered),
        ("smoothed", paths.delayed - paths.smoothed),
    ):
        mean_square = (error**2).sum(axis=-1).mean()
        assert_allclose(getattr(result, name).mean_square, mean_square, rtol=1e-9)
    lag = round(0.3 / paths.step)
    assert_array_equal(paths.delayed[:, lag:], paths.w[:, :-lag])
    assert_allclose(paths.time, paths.step * np.arange(1, paths.w.shape[1] + 1))
    other = simulate(estimator, **(arguments | {"seed": 5}))
    assert other.smoothed.mean_square != pytest.approx(result.smoothed.mean_square, rel=1e-3)


def test_same_seed_gives_the_same_numbers():
    estimator = curved_estimator()
    first, again = (simulate(estimator, runs=3, duration=2.0, seed=9) for _ in range(2))
    assert first.smoothed == again.smoothed
    assert_array_equal(first.constraints, again.constraints)


def test_estimator_run_on_the_record_gives_the_estimates():
    """The record holds means over steps: what is lost is the course of the noise within them."""
    estimator = kalman_bucy(scalar_system(soft))
    misfits = []
    for step in (0.04, 0.02):
        paths = sample_paths(estimator, runs=20, duration=20.0, step=step)
        A, B, *_ = cont2discrete(
            (estimator.A_c, estimator.B_c[:, :1], np.eye(1), np.zeros((1, 1))), step
        )
        x_hat = paths.filtered[:, 0] / estimator.C_f[0]
        for k in range(1, len(paths.time)):
            x_hat = x_hat @ A.T + paths.y[:, k] @ B.T
        misfits.append(np.std(paths.filtered[:, -1] - x_hat @ estimator.C_f.T))
    # within a step white noise w ends in x_hat as K int (e^{A s} - mean) dw, of size h^(3/2);
    # a time constant's worth of steps adds up to h
    assert misfits[0] < 0.01
    assert misfits[1] / misfits[0] == pytest.approx(0.5, abs=0.3)


def test_without_a_lag_both_errors_are_the_same():
    result = simulate(kalman_bucy(scalar_system(soft)), runs=3, duration=2.0)
    assert result.smoothed == result.filtered


@pytest.mark.parametrize("unit", [2.0**-30, 1e-6, 3.15e7])
def test_results_do_not_depend_on_the_unit_of_time(unit):
    estimator = curved_estimator()
    system = estimator.plant.system
    other = replace(
        system,
        A=system.A * unit,
        B1=system.B1 * math.sqrt(unit),
        C2=system.C2 * unit,
        D21=system.D21 * math.sqrt(unit),
        uncertainties=[replace(c, B=c.B * unit, D=c.D * unit) for c in system.uncertainties],
        nonlinearities=[replace(c, B=c.B * unit, D=c.D * unit) for c in system.nonlinearities],
    )
    slow = replace(
        estimator,
        plant=augment(other, estimator.plant.delay / unit, 2),
        A_c=estimator.A_c * unit,
        B_c=estimator.B_c * [1.0, 1.0, unit, unit],
    )
    arguments = {"runs": 4, "uncertainties": [1.0, -0.5]}
    here, there = simulate(estimator, **arguments), simulate(slow, **arguments)
    assert there.step * unit == pytest.approx(here.step, rel=1e-12)
    assert_allclose(there.smoothed.mean_square, here.smoothed.mean_square, rtol=1e-9)
    assert_allclose(there.filtered.mean_square, here.filtered.mean_square, rtol=1e-9)
    assert_allclose(there.constraints, here.constraints, rtol=1e-9)


def soft_with_a_branch(value):
    return value - math.tanh(value) if value > 0.0 else value + math.tanh(-value)


def soft_array(values):
    result = np.empty_like(values)
    for i in range(values.size):
        result[i] = values[i] - math.tanh(values[i])
    return result


@pytest.mark.parametrize(
    "function",
    [
        numba.njit(lambda value: value - math.tanh(value)),
        numba.njit(soft_with_a_branch),
        numba.njit(soft_array),
        numba.vectorize(soft_with_a_branch),
    ],
    ids=["number", "branch", "array", "ufunc"],
)
def test_compiled_functions_give_the_numbers_of_plain_ones(function):
    results = [
        simulate(kalman_bucy(scalar_system(each), copies=True), runs=3, duration=3.0)
        for each in (soft, function)
    ]
    expected, found = (result.filtered.mean_square for result in results)
    assert found == pytest.approx(expected, rel=1e-12)


def test_a_compiled_sine_gives_the_numbers_of_numpys():
    """To 2e-11, the error of the vectorised sine, in a loop that forgets errors."""
    estimator = homodyne_estimator("classical with copies")
    system = estimator.plant.system
    how = {"runs": 3, "duration": 1e-4}
    compiled = simulate(estimator, **how)
    in_python = with_functions(system, lambda v: system.nonlinearities[0].function(v))
    called_back = simulate(replace(estimator, plant=augment(in_python, 3.1e-6, 2)), **how)
    for output in ("filtered", "smoothed"):
        expected = getattr(called_back, output).mean_square
        assert getattr(compiled, output).mean_square == pytest.approx(expected, rel=1e-9)


def test_error_of_a_function_is_raised_and_the_next_call_works():
    def failing(t, zeta):
        if t > 1.0:
            raise LookupError("of the user")
        return 0.0 * zeta

    estimator = kalman_bucy(scalar_system(soft))
    for _ in range(2):
        with pytest.raises(LookupError, match="of the user"):
            simulate(estimator, uncertainties=[failing], runs=3, duration=5.0)
    assert simulate(estimator, runs=3, duration=5.0).filtered.mean_square > 0.0


def test_interrupt_in_a_function_ends_the_simulation():
    def interrupted(t, zeta):
        if t > 1.0:
            raise KeyboardInterrupt
        return 0.0 * zeta

    with pytest.raises(KeyboardInterrupt):
        simulate(kalman_bucy(scalar_system(soft)), uncertainties=[interrupted], runs=3)


def test_functions_may_change_their_argument():
    def spoiling(t, zeta):
        zeta *= 0.5
        return zeta

    estimator = kalman_bucy(scalar_system(soft))
    kind = {"runs": 3, "duration": 5.0}
    spoilt = simulate(estimator, uncertainties=[spoiling], **kind)
    assert (
        spoilt.filtered
        == simulate(estimator, uncertainties=[lambda _, z: 0.5 * z], **kind).filtered
    )


@pytest.mark.parametrize("change", [{"seed": 1}, {"runs": 5}, {"uncertainties": [0.5]}, "function"])
def test_checkpoint_of_another_simulation_is_refused(change, tmp_path):
    estimator, how = kalman_bucy(scalar_system(soft)), {"runs": 4, "duration": 2.0}
    how["checkpoint"] = tmp_path / "run"
    simulate(estimator, **how)
    if change == "function":
        estimator, change = kalman_bucy(scalar_system(lambda v: soft(v) * (1 + 1e-9))), {}
    with pytest.raises(CheckpointError, match="of another computation: "):
        simulate(estimator, **how | change)


# --- what a user sees -----------------------------------------------------------------------------


def test_result_describes_itself(terminal):
    result = simulate(kalman_bucy(scalar_system(soft)), runs=3, duration=5.0, progress=True)
    for part in ("smoothed", "filtered", "3 runs of 5 s", "seed 0", "path-steps"):
        assert part in repr(result)
    assert result.path_steps == 3 * round((result.warm_up + result.duration) / result.step)
    assert 0.0 < result.filtered.standard_error < result.filtered.mean_square
    assert "100%" in terminal.readouterr().err


def test_single_path_has_no_standard_error():
    result = simulate(kalman_bucy(scalar_system(soft)), runs=1, duration=2.0)
    assert math.isnan(result.smoothed.standard_error)


def test_diverging_path_is_named():
    estimator = kalman_bucy(scalar_system(lambda v: 4.0 * v, into_state=1.0))
    with pytest.raises(RuntimeError, match=r"path \d+ of seed 7 diverges: by [\d.]+ s an output"):
        simulate(estimator, runs=600, seed=7)


def test_path_that_is_not_a_number_is_named():
    """The paths to have |x| > 2.5 in the first chunk of steps in which there are any."""
    bound = 2.5
    paths = sample_paths(kalman_bucy(scalar_system(soft)), runs=40, duration=30.0, step=0.1)
    beyond = np.abs(paths.w[..., 0]) > bound
    first = int(beyond.any(axis=0).argmax())
    assert beyond.any()
    end = (first // CHUNK + 1) * CHUNK
    path, time = int(beyond[:, :end].any(axis=1).argmax()), paths.time[end - 1]
    undefined = scalar_system(lambda v: np.where(np.abs(v) > bound, np.nan, soft(v)))
    with pytest.raises(RuntimeError, match=rf"path {path} of seed 0 diverges: by {time:.4g} s an"):
        simulate(kalman_bucy(undefined), runs=40, duration=30.0, step=0.1)


def test_loop_that_is_unstable_without_its_nonlinearities_is_refused():
    unstable = replace(kalman_bucy(scalar_system(soft)), A_c=np.array([[0.5]]))
    with pytest.raises(UnstableLoopError, match="not stable without its nonlinearities"):
        simulate(unstable)


def test_nonlinearity_without_a_function_is_refused():
    with pytest.raises(ValueError, match=r"nonlinearities\[0\] has no function: a design does"):
        simulate(kalman_bucy(scalar_system()))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"smoother": 1}, TypeError, "smoother must be an Estimator, got int"),
        ({"runs": 0}, ValueError, "runs must be an integer of at least 1, got 0"),
        ({"seed": -1}, ValueError, "seed must be an integer of at least 0, got -1"),
        ({"duration": 0.0}, ValueError, "duration must be"),
        ({"duration": 1e-3, "step": 0.1}, ValueError, "duration must be at least one step"),
        ({"step": 0.03}, ValueError, "step must divide the smoother's delay, 0.2 s, into whole"),
        ({"step": -1.0}, ValueError, "step must be"),
        ({"progress": None}, TypeError, "progress must be True or False, got None"),
        ({"uncertainties": 0.5}, TypeError, "uncertainties must be a sequence"),
        ({"uncertainties": [0.1, 0.2]}, ValueError, "uncertainties must have 1 entries, got 2"),
        ({"uncertainties": ["a"]}, TypeError, r"uncertainties\[0\] must be a real number"),
        (
            {"uncertainties": [np.eye(2)]},
            ValueError,
            r"uncertainties\[0\] must have shape \(1, 1\)",
        ),
        ({"uncertainties": [-1.5]}, ValueError, r"uncertainties\[0\] must have norm at most 1"),
        (
            {"uncertainties": [lambda t, zeta: zeta[0]]},
            ValueError,
            r"uncertainties\[0\] must map .* to shape \(1, paths\), got \(2,\) for 2 paths",
        ),
        (
            {"uncertainties": [list[int]]},
            ValueError,
            r"uncertainties\[0\] must map .*, got TypeError: list expected at most 1 argument",
        ),
    ],
)
def test_bad_arguments_are_refused(arguments, error, message):
    arguments = {"smoother": fixed_lag_smoother(scalar_system(soft), 0.2, 1)} | arguments
    with pytest.raises(error, match=message):
        simulate(arguments.pop("smoother"), **arguments)
