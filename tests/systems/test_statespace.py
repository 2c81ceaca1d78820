"""To python-control and from its plants: what it computes with ours, against own formulas."""

import subprocess
import sys

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import signal
from scipy.linalg import expm, logm, solve_continuous_lyapunov

from robsmooth import (
    UncertainSystem,
    augment,
    error_covariance,
    homodyne,
    judge,
)
from robsmooth.analysis.covariance import closed_loop
from robsmooth.estimators.baselines import fixed_lag_smoother, kalman_bucy
from tests.helpers.strategies import (
    admissible_delta,
    designs,
    feasible_design,
    random_system,
    seeds,
    stable_matrix,
    systems,
)

few = settings(max_examples=20)


def a_design(seed=1, g=2, delay=0.4):
    rng = np.random.default_rng(seed)
    return feasible_design(
        rng, augment(random_system(rng, n=2, m=2, measurements=2, g=g), delay, 2)
    )


def transfer(A, B, C, s):
    return C @ np.linalg.solve(s * np.eye(len(A)) - A, B)


def random_plant(rng, n=3, p=2, measurements=2, D=False):
    feedthrough = rng.standard_normal((measurements, p)) if D else np.zeros((measurements, p))
    B, C = rng.standard_normal((n, p)), rng.standard_normal((measurements, n))
    return control.ss(stable_matrix(rng, n), B, C, feedthrough)


def random_intensity(rng, n):
    root = rng.standard_normal((n, n + 1))
    return root @ root.T


# --- systems out ----------------------------------------------------------------------------------


@given(systems(), st.floats(0.01, 100.0))
@few
def test_each_named_part_has_the_transfer_function_of_its_matrices(system, omega):
    sys, s = system.to_statespace(), 1j * omega
    parts = {
        ("y[0]", "W[1]"): transfer(system.A, system.B1[:, [1]], system.C2[[0]], s)[0, 0]
        + system.D21[0, 1],
        ("w[0]", "W[0]"): transfer(system.A, system.B1[:, [0]], system.C0[[0]], s)[0, 0],
    }
    second = system.uncertainties[1]
    parts["y[0]", "xi_1[0]"] = transfer(system.A, second.B, system.C2, s)[0, 0] + second.D[0, 0]
    parts["zeta_0[2]", "xi_1[0]"] = transfer(system.A, second.B, system.uncertainties[0].C, s)[2, 0]
    for i, channel in enumerate(system.nonlinearities):
        parts["y[0]", f"mu[{i}]"] = (
            transfer(system.A, channel.B, system.C2, s)[0, 0] + channel.D[0, 0]
        )
        parts[f"nu[{i}]", "W[0]"] = transfer(system.A, system.B1, channel.C, s)[0, 0]
    for names, expected in parts.items():
        assert control.evalfr(sys[names], s) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_what_goes_out_is_in_continuous_time_a_copy_and_keeps_all_states(monkeypatch):
    monkeypatch.setitem(control.config.defaults, "control.default_dt", 1.0)
    monkeypatch.setitem(control.config.defaults, "statesp.remove_useless_states", True)
    system = UncertainSystem(
        np.diag([-1.0, -2.0]), [[1.0], [0.0]], [[1.0, 0.0]], [[1.0, 0.0]], [[1.0]]
    )
    sys = system.to_statespace()
    assert sys.dt == 0
    assert sys.nstates == 2
    sys.A[0, 0] = 5.0
    assert system.A[0, 0] == -1.0


@pytest.mark.parametrize(
    "sys, words",
    [
        (control.frd([1.0, 2.0], [1.0, 2.0]), "got FrequencyResponseData$"),
        (np.eye(2), "must be a state-space system or transfer function of .*, got ndarray$"),
        (None, "got NoneType"),
    ],
)
def test_another_kind_of_object_is_refused(sys, words):
    with pytest.raises(TypeError, match=words):
        UncertainSystem.from_plant(sys, 1, 1)


def test_importing_the_package_does_not_import_python_control():
    code = "import sys, robsmooth; sys.exit('control' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- plants with noise, as control.lqe has them ---------------------------------------------------


@given(seeds)
def test_the_filter_of_a_plant_is_that_of_lqe(seed):
    rng = np.random.default_rng(seed)
    plant = random_plant(rng)
    Q, R = random_intensity(rng, 2), random_intensity(rng, 2) + 0.1 * np.eye(2)
    drive = plant.B @ Q @ plant.B.T  # lqe(plant, Q, R) wants this symmetric to the last bit
    L, P, poles = control.lqe(plant.A, np.eye(3), plant.C, (drive + drive.T) / 2, R)
    system = UncertainSystem.from_plant(plant, Q, R, outputs=np.eye(3))
    kalman = kalman_bucy(system)
    assert_allclose(kalman.B_c, L, rtol=0, atol=1e-7 * (1 + np.abs(L).max()))
    errors = error_covariance(kalman, np.zeros((4, 2)), "filtered")
    assert_allclose(errors, P, rtol=0, atol=1e-7 * np.trace(P))
    assert_allclose(np.sort_complex(kalman.poles), np.sort_complex(poles), rtol=1e-6)


@given(seeds)
@few
def test_lqe_of_the_exported_system_is_its_kalman_filter(seed):
    rng = np.random.default_rng(seed)
    B, noise = rng.standard_normal((3, 2)), np.diag(rng.uniform(0.3, 1.0, 2))
    system = UncertainSystem(
        A=stable_matrix(rng, 3),
        B1=np.hstack([B, np.zeros((3, 2))]),  # independent of the measurement's, as lqe wants it
        C0=np.eye(3),
        C2=rng.standard_normal((2, 3)),
        D21=np.hstack([np.zeros((2, 2)), noise]),
    )
    sys = system.to_statespace()[["y[0]", "y[1]"], [f"W[{i}]" for i in range(4)]]
    L, _, _ = control.lqe(sys, np.eye(4), system.D21 @ system.D21.T)
    assert_allclose(kalman_bucy(system).B_c, L, rtol=0, atol=1e-7 * (1 + np.abs(L).max()))


@given(seeds)
def test_a_plant_comes_with_its_noises_and_their_channels(seed):
    rng = np.random.default_rng(seed)
    plant = random_plant(rng, D=True)
    Q, R = random_intensity(rng, 2), random_intensity(rng, 2)
    bound = rng.standard_normal((4, 3))
    system = UncertainSystem.from_plant(plant, Q, R, process_uncertainty=bound)
    for name, expected in (("A", plant.A), ("C0", plant.C), ("C2", plant.C)):
        assert_array_equal(getattr(system, name), expected)
    joint = np.vstack([system.B1, system.D21])
    into = np.vstack([plant.B, plant.D])
    expected = into @ Q @ into.T
    expected[3:, 3:] += R
    assert_allclose(joint @ joint.T, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    process, measurement = system.uncertainties
    assert_array_equal(process.C, bound)
    assert_array_equal(measurement.C, np.zeros((1, 3)))
    channels = np.hstack([np.vstack([c.B, c.D]) for c in (process, measurement)])
    assert_array_equal(channels, joint)
    augment(system, 0.0, 0)  # Assumption 1 holds


def test_noise_intensities_of_very_different_units_keep_their_digits():
    plant = control.ss(-np.eye(2), np.eye(2), [[1.0, 1.0]], [[0.0, 0.0]])
    scale = np.diag([1e-9, 1e9])
    Q = scale @ np.array([[2.0, 1.0], [1.0, 3.0]]) @ scale
    system = UncertainSystem.from_plant(plant, Q, 4.0)
    assert_allclose(system.B1 @ system.B1.T, Q, rtol=1e-12)
    assert_array_equal(system.D21, [[0.0, 0.0, 2.0]])


def test_a_robust_design_for_a_plant_holds_its_bound():
    plant = control.tf2ss([1.0], [1.0, 0.8, 4.0])
    system = UncertainSystem.from_plant(
        plant,
        1.0,
        0.01,
        outputs=np.vstack([plant.C, plant.C @ plant.A]),  # position and velocity
        process_uncertainty=0.2 * plant.C,
    )
    design = feasible_design(np.random.default_rng(0), augment(system, 0.5, 3))
    assert design is not None
    for value in (-1.0, 0.0, 1.0):
        error = error_covariance(design, design.plant.structured_delta([value, 0.0]), "filtered")
        assert np.trace(error) <= design.mean_square_bound


PLANT = control.ss(-1.0, [[1.0, 2.0]], 1.0, [[0.0, 0.0]])


@pytest.mark.parametrize(
    "change, error, words",
    [
        (dict(process_noise=-1.0), ValueError, "process_noise must be finite and in"),
        (dict(process_noise=np.eye(3)), ValueError, r"process_noise must have shape \(2, 2\)"),
        (dict(process_noise=[[1, 2], [2, 1]]), ValueError, "process_noise must be nonneg.*-1"),
        (dict(process_noise=[[1, 0.5], [0, 1]]), ValueError, "process_noise must be symmetric"),
        (dict(measurement_noise=[[-1e-30]]), ValueError, "measurement_noise must be nonneg.*-1"),
        (dict(measurement_noise="1"), TypeError, "measurement_noise must be a real number"),
        (dict(outputs=[[1.0, 0.0]]), ValueError, r"C0 must have shape \(any, 1\)"),
        (dict(process_uncertainty=[[1, 2]]), ValueError, r"uncertainties\[0\]\.C must have shape"),
        (dict(measurement_uncertainty=[[1, 2]]), ValueError, r"uncertainties\[1\]\.C must have"),
        (dict(plant=control.ss(-1, 1, 1, 0, True)), ValueError, "plant must be in continuous.*d2c"),
        (dict(plant=control.tf(1, [1, -0.5], 0.1)), ValueError, "plant .* steps of dt=0.1: d2c of"),
        (dict(plant=signal.dlti(1, [1, -0.5], dt=0.1)), ValueError, "plant .* dt=0.1: d2c of"),
        (dict(plant=signal.lti([2.0], [1.0])), ValueError, "plant must have a state"),
        (dict(plant=control.tf(2, 1)), ValueError, "plant must have a state"),
        (dict(plant=signal.lti([1, 0, 0], [1, 2])), ValueError, "plant must be proper"),
        (dict(plant=control.tf([1, 0, 0], [1, 2])), ValueError, "plant must be proper"),
        (
            dict(plant=control.tf(1, [1, 2]), outputs=[[1]]),
            TypeError,
            "plant must have states, a TransferFunction has none",
        ),
        (
            dict(plant=signal.lti(1, [1, 2]), process_uncertainty=[[0.1]]),
            TypeError,
            "plant must have states, .*process_uncertainty",
        ),
        (
            dict(plant=control.tf([[[1], [2]]], [[[1, 1], [1, 2]]])),
            TypeError,
            r"plant must be control\.ss\(\.\.\.\) where it has several",
        ),
        (dict(gain_uncertainty=np.inf), ValueError, "gain_uncertainty must be finite"),
        (
            dict(gain_uncertainty=[0.1, 0.1]),
            ValueError,
            r"gain_uncertainty must have shape \(1, 1\)",
        ),
        (dict(gain_uncertainty=True), TypeError, "gain_uncertainty must be .*type bool"),
        (dict(plant=control.ss([], [], [], [[1.0]])), ValueError, "plant must have a state"),
        (
            dict(plant=signal.ZerosPolesGain([], [-1 + 2j], 5.0)),
            ValueError,
            "denominator of plant must be real",
        ),
        (
            dict(plant=signal.ZerosPolesGain([], [-1.0], np.array([5.0, 2.0]))),
            TypeError,
            "where it has several inputs or outputs",
        ),
    ],
)
def test_what_makes_no_system_of_a_plant_is_one_clear_error(change, error, words):
    arguments = {"plant": PLANT, "process_noise": 1.0, "measurement_noise": 1.0, **change}
    with pytest.raises(error, match=f"^(?!.*\n).*{words}"):
        UncertainSystem.from_plant(**arguments)


# --- plants of other kinds ------------------------------------------------------------------------

NUMERATOR, DENOMINATOR = [0.5, 2.0], [1.0, 0.8, 4.0, 1.0]
ZEROS, POLES = np.roots(NUMERATOR), np.roots(DENOMINATOR)
KINDS = {
    "control.tf": control.tf(NUMERATOR, DENOMINATOR),
    "control.zpk": control.zpk(ZEROS, POLES, 0.5),
    "control.ss": control.tf2ss(NUMERATOR, DENOMINATOR),
    "scipy.signal.TransferFunction": signal.TransferFunction(NUMERATOR, DENOMINATOR),
    "scipy.signal.ZerosPolesGain": signal.ZerosPolesGain(ZEROS, POLES, 0.5),
    "scipy.signal.StateSpace": signal.StateSpace(*signal.tf2ss(NUMERATOR, DENOMINATOR)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_plant_has_its_response_and_the_same_errors(kind):
    system = UncertainSystem.from_plant(KINDS[kind], 1.0, 0.01)
    s = 0.7j
    expected = np.polyval(NUMERATOR, s) / np.polyval(DENOMINATOR, s)
    assert transfer(system.A, system.B1[:, :1], system.C2, s)[0, 0] == pytest.approx(expected)
    # the filter's error by the spectral factorisation (N Q N* + R D D*) = R F F*, of scalars
    n, d = np.polymul(NUMERATOR, [-0.5, 2.0]), np.polymul(DENOMINATOR, [-1.0, 0.8, -4.0, 1.0])
    roots = np.roots(np.polyadd(n, 0.01 * d))
    closed = np.poly(roots[roots.real < 0.0]).real
    error = 0.01 * (closed[1] - DENOMINATOR[1])  # Yovits and Jackson's formula
    kalman = kalman_bucy(system)
    assert error_covariance(kalman, kalman.plant.structured_delta(), "filtered") == pytest.approx(
        error, rel=1e-9
    )


def test_a_small_numerator_is_not_taken_for_zero():
    """Both libraries' conversions drop what is below 1e-14."""
    plant = control.tf([1e-16, 2e-16], [1.0, 2.0, 3.0])
    system = UncertainSystem.from_plant(plant, 1.0, 1e-34)
    expected = 1e-16 * (1.0j + 2.0) / (1.0j**2 + 2.0 * 1.0j + 3.0)
    found = transfer(system.A, system.B1[:, :1], system.C2, 1.0j)
    assert found[0, 0] == pytest.approx(expected, rel=1e-12, abs=0.0)


def test_several_outputs_of_one_denominator_are_several_measurements():
    plant = signal.TransferFunction([[1.0, 3.0], [1.0, 0.0]], [1.0, 0.4, 2.0])
    system = UncertainSystem.from_plant(plant, 1.0, 0.01)
    s = 0.3j
    found = transfer(system.A, system.B1[:, :1], system.C2, s)[:, 0]
    assert_allclose(found, np.array([s + 3.0, s]) / (s**2 + 0.4 * s + 2.0), rtol=1e-12)


def test_units_of_time_change_no_error_of_a_transfer_function():
    def error(unit):
        zeros, poles, gain = signal.butter(6, 1.0 / unit, analog=True, output="zpk")
        plant = signal.ZerosPolesGain(zeros, poles, gain)
        system = UncertainSystem.from_plant(plant, unit, 0.01 * unit)
        smoother = fixed_lag_smoother(system, 0.5 * unit, 3)
        return error_covariance(smoother, smoother.plant.structured_delta()).item()

    assert error(1e-6) == pytest.approx(error(1.0), rel=1e-9)
    assert error(1e5) == pytest.approx(error(1.0), rel=1e-9)


def test_a_discrete_plant_is_converted_as_the_message_says():
    B, C, dt = np.array([[1.0], [0.5]]), np.array([[1.0, 0.0]]), 0.3
    A = np.array([[0.0, 1.0], [-2.0, -0.4]])
    Ad, Bd, *_ = signal.cont2discrete((A, B, C, np.zeros((1, 1))), dt)
    found = logm(np.block([[Ad, Bd], [np.zeros((1, 2)), np.eye(1)]])) / dt
    assert_allclose(found, np.vstack([np.hstack([A, B]), np.zeros((1, 3))]), atol=1e-12)


def test_a_gain_uncertainty_is_relative_whatever_the_unit_of_the_measurement():
    plant = control.ss([[-1.0]], [[1.0]], [[1.0], [2.0]], [[0.0], [0.0]])
    volts = control.ss([[-1.0]], [[1.0]], [[1e3], [2e-3]], [[0.0], [0.0]])
    in_volts = np.diag([0.01 * 1e6, 0.04 * 1e-6])
    systems_ = [
        UncertainSystem.from_plant(plant, 1.0, np.diag([0.01, 0.04]), gain_uncertainty=[0.2, 0.1]),
        UncertainSystem.from_plant(
            volts, 1.0, in_volts, outputs=[[1.0], [2.0]], gain_uncertainty=[0.2, 0.1]
        ),
    ]
    one, other = (judge(fixed_lag_smoother(system, 0.2, 2)) for system in systems_)
    for name in ("nominal", "worst_constant", "certified"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6)
    assert one.worst_constant > 1.1 * one.nominal


@given(seeds)
@few
def test_a_gain_uncertainty_is_a_gain_that_is_off(seed):
    """The error of a filter whose sensors have other gains, by the equation of the whole loop."""
    rng = np.random.default_rng(seed)
    plant, R = random_plant(rng, n=2), np.diag(rng.uniform(0.1, 1.0, 2))
    sizes, values = rng.uniform(0.0, 0.5, 2), rng.uniform(-1.0, 1.0, 2)
    for size in (sizes, float(sizes[0])):
        system = UncertainSystem.from_plant(plant, np.eye(2), R, gain_uncertainty=size)
        kalman = kalman_bucy(system)
        Delta = kalman.plant.structured_delta([0.0, 0.0, *values])
        gain = np.diag(1.0 + values * size) @ plant.C  # y = (1 + delta) C x
        A = np.block([[plant.A, np.zeros((2, 2))], [kalman.B_c @ gain, kalman.A_c]])
        noise = np.block([[plant.B, np.zeros((2, 2))], [np.zeros((2, 2)), kalman.B_c @ np.sqrt(R)]])
        P = solve_continuous_lyapunov(A, -noise @ noise.T)
        off = np.hstack([plant.C, -plant.C])
        expected = off @ P @ off.T
        assert_allclose(
            error_covariance(kalman, Delta, "filtered"),
            expected,
            rtol=0,
            atol=1e-9 * np.trace(expected),
        )
    assert [c.C.any() for c in system.uncertainties] == [False, False, True, True]


# --- estimators out -------------------------------------------------------------------------------


@given(designs(), st.floats(0.01, 100.0))
@few
def test_an_estimator_has_the_response_of_its_matrices(design, omega):
    sys, system = design.to_statespace(), design.plant.system
    C = np.vstack([design.C_a, design.C_f, design.C_c[system.m :]])
    expected = transfer(design.A_c, design.B_c, C, 1j * omega)
    assert_allclose(
        sys.frequency_response([omega]).complex.reshape(expected.shape),
        expected,
        rtol=0,
        atol=1e-9 * (1 + np.abs(expected).max()),
    )
    assert_allclose(
        np.sort_complex(sys.poles()), np.sort_complex(design.poles), rtol=1e-6, atol=1e-9
    )
    copies = [f"mu_copy[{i}]" for i in range(system.g)]
    assert sys.input_labels == [*(f"y[{j}]" for j in range(system.l)), *copies]


def smoothed_of(design, slopes):
    """The smoothed estimates of a design, its copies replaced by slopes."""
    names = [f"smoothed[{i}]" for i in range(design.plant.system.m)]
    return design.to_statespace(slopes)[names, :]


def test_step_and_forced_response_are_those_of_the_exponential():
    design = a_design()
    slopes = [0.3, -0.2]
    sys = smoothed_of(design, slopes)
    A = design.A_c + design.B_c[:, 2:] @ np.diag(slopes) @ design.C_c[2:]
    times = np.linspace(0.0, 2.0, 9)
    step = control.step_response(sys, times)
    ramp = control.forced_response(sys, times, np.vstack([times, 0 * times]))
    for i, t in enumerate(times):
        settled = np.linalg.solve(A, (expm(A * t) - np.eye(len(A))) @ design.B_c[:, :2])
        assert_allclose(step.outputs[:, :, i], design.C_a @ settled, atol=1e-9)
        growing = np.linalg.solve(A, settled - t * design.B_c[:, :2])
        assert_allclose(ramp.outputs[:, i], (design.C_a @ growing)[:, 0], atol=1e-9)


def test_closing_the_copies_by_python_control_is_closing_them_by_slopes():
    design = a_design()
    slopes = np.array([0.4, 0.1])
    sys = design.to_statespace()
    y, smoothed = ["y[0]", "y[1]"], ["smoothed[0]", "smoothed[1]"]
    gain = np.zeros((4, 6))
    gain[2:, 4:] = np.diag(slopes)
    closed = control.feedback(sys, control.ss([], [], [], gain), sign=1)
    assert_allclose(closed.A, design.to_statespace(slopes).A, rtol=1e-12)
    s = 0.7j
    assert_allclose(
        control.evalfr(smoothed_of(design, slopes), s),
        control.evalfr(closed, s)[:2, :2],
        rtol=1e-9,
    )
    nominal = control.evalfr(smoothed_of(design, [0.0, 0.0]), s)
    assert_allclose(control.evalfr(sys[smoothed, y], s), nominal, rtol=1e-12)


@given(designs(), seeds, st.floats(0.01, 100.0))
@few
def test_python_control_joins_system_and_estimator_by_the_names_of_their_signals(
    design, seed, omega
):
    plant, system = design.plant, design.plant.system
    Delta = admissible_delta(np.random.default_rng(seed), plant)
    parts = system.to_statespace(), design.to_statespace()
    labels = [label for part in parts for label in part.output_labels]
    zeta = [label for label in labels if label.startswith(("zeta", "nu"))]
    xi = [label for part in parts for label in part.input_labels if label.startswith(("xi", "mu"))]
    uncertainty = control.ss([], [], [], Delta, 0, inputs=zeta, outputs=xi)
    loop = control.interconnect(
        [*parts, uncertainty],
        inputs=[f"W[{i}]" for i in range(system.q)],
        outputs=[f"smoothed[{i}]" for i in range(system.m)],
        check_unused=False,
    )
    A, B = closed_loop(design, Delta)
    read_out = np.hstack([np.zeros_like(plant.C_p0), design.C_a])
    response = transfer(A, B[:, : system.q], read_out, 1j * omega)
    assert_allclose(
        loop.frequency_response([omega]).complex.reshape(response.shape),
        response,
        rtol=0,
        atol=1e-8 * (1e-3 + np.abs(response).max()),
    )


def test_estimators_stand_side_by_side():
    system = homodyne.PAPER.uncertain_system()
    pair = [fixed_lag_smoother(system, 3.1e-6, 2), kalman_bucy(system)]
    both = control.append(*(estimator.to_statespace([0.0]) for estimator in pair))
    poles = np.concatenate([estimator.poles for estimator in pair])
    assert_allclose(np.sort_complex(both.poles()), np.sort_complex(poles), rtol=1e-9)


def test_slopes_of_an_estimator_are_checked():
    design = a_design()
    with pytest.raises(ValueError, match=r"slopes must have shape \(2\), got \(1,\)"):
        design.to_statespace([0.0])
    with pytest.raises(ValueError, match="slopes must be finite"):
        design.to_statespace([0.0, np.inf])
