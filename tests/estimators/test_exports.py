"""An estimator for other programs: its C against Python's own steps, its matrices, its control."""

import ctypes
import math
import re
import subprocess
from dataclasses import replace

import control
import numpy as np
import pytest
import scipy.io
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import robsmooth as rs
from robsmooth.estimators import baselines
from tests.helpers.compilers import STRICT, checked_by_its_record, compile_c
from tests.helpers.strategies import random_system, seeds
from tests.helpers.systems import EXAMPLE, in_other_units

FUNCTIONS = (np.tanh, np.sin), ("tanh(x)", "sin(x)")
DOUBLE, SINGLE = 1e-12, np.finfo(np.float32).eps
WALK = rs.UncertainSystem([[-1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 1.0]])


def of_copies(seed, n=2, m=2, measurements=2, g=2, order=2):
    """A smoother that runs copies, with a delay model."""
    system = random_system(np.random.default_rng(seed), n, m, measurements, g, size=0.4)
    channels = [
        replace(c, function=f) for c, f in zip(system.nonlinearities, FUNCTIONS[0][:g], strict=True)
    ]
    system = replace(system, nonlinearities=channels)
    return baselines.fixed_lag_smoother(system, 0.5, order, copies=True)


def record_of(discrete, path, rows, seed=1):
    """Write a record with gaps and references, and its estimates, in the form of that of `to_c`."""
    rng = np.random.default_rng(seed)
    y, reference = rng.standard_normal((rows, discrete.l)), rng.standard_normal((rows, discrete.g))
    y[rng.random(y.shape) < 0.2] = np.nan
    y[rows // 3 : rows // 2] = np.nan
    estimates = []
    for output in ("smoothed", "filtered"):
        discrete.reset()
        estimates.append(discrete.run(y, reference=reference, output=output))
    np.savetxt(path, np.hstack([y, reference, *estimates]), "%.17g", ",", header="a record")
    return path


# --- the C code ----------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::robsmooth.LongStepWarning")
@settings(max_examples=8)
@given(
    st.sampled_from([(1, 1, 1, 0, 0), (2, 2, 1, 1, 2), (3, 1, 2, 2, 3), (2, 1, 4, 0, 1)]),
    seeds,
    st.floats(-3, 0.5),
)
def test_the_c_code_makes_the_estimates_of_python(tmp_path_factory, sizes, seed, exponent):
    n, m, measurements, g, order = sizes
    estimator = of_copies(seed, n, m, measurements, g, order)
    rng, dt = np.random.default_rng(seed), 10**exponent / np.abs(estimator.poles).max()
    mean, offset = rng.standard_normal(n), rng.standard_normal(measurements)
    discrete = estimator.discretize(dt, delay="model", mean=mean, offset=offset)
    source = tmp_path_factory.mktemp("c") / "estimator.c"
    discrete.to_c(source, functions=FUNCTIONS[1][:g])
    assert checked_by_its_record(source) < DOUBLE
    record = record_of(discrete, source.with_name("record.csv"), rows=600)
    assert checked_by_its_record(source, record) < DOUBLE


def test_the_program_sees_a_wrong_function(tmp_path):
    discrete = of_copies(3).discretize(0.1, delay="model")
    discrete.to_c(tmp_path / "wrong.c", functions=["tanh(x)", "sin(1.001 * x)"])
    assert checked_by_its_record(tmp_path / "wrong.c") > 1e-6


def test_a_function_of_ones_own_is_called_by_its_name(tmp_path):
    """As a table is: it is declared by a header that the compiler includes."""
    (tmp_path / "mine.h").write_text(
        "#include <math.h>\nstatic inline double mine(double x) { return tanh(x); }\n"
    )
    of_copies(3).discretize(0.1, delay="model").to_c(tmp_path / "made.c", ["mine(x)", "sin(x)"])
    include = ("-include", str(tmp_path / "mine.h"))
    assert checked_by_its_record(tmp_path / "made.c", None, *include) < DOUBLE


def test_single_precision_rounds_and_does_no_more(tmp_path):
    """A step rounds the state once, and the terms of its change, which are smaller, a few times.

    That decays with the slowest pole, so that the sum over all steps is a geometric series.
    """
    estimator = of_copies(3)
    for part in (0.3, 1e-3, 1e-5):
        dt = part / np.abs(estimator.poles).max()
        discrete = estimator.discretize(dt, delay="model")
        functions = ["tanhf(x)", "sinf(x)"]
        discrete.to_c(tmp_path / "single.c", functions, precision="float")
        record = record_of(discrete, tmp_path / "record.csv", rows=3000)
        left = 1 - np.exp(-np.abs(estimator.poles.real).min() * dt)
        terms = len(estimator.A_c) + discrete.l + 3 * discrete.g
        rounded = SINGLE * (min(3000, 1 / left) + terms)
        off = checked_by_its_record(tmp_path / "single.c", record)
        assert 1e-9 < off < rounded, part


def test_a_slow_mode_keeps_its_rate_in_single_precision(tmp_path):
    """In single precision 1 - 1e-7 is 1 - 1.19e-7: the mode would decay by a fifth faster."""
    dt = 1e-7
    discrete = baselines.kalman_bucy(WALK).discretize(dt, delay="model")
    discrete.to_c(tmp_path / "slow.c", precision="float")
    text = (tmp_path / "slow.c").read_text()
    (rate,) = re.findall(r"case 1:\n\s+next\[0\] = x\[0\] \+ \((-[\d.e-]+)f \* x", text)
    assert_allclose(float(np.float32(rate)), -dt, rtol=1e-6)


def test_the_code_of_other_units_makes_the_same_of_the_same(tmp_path):
    other = in_other_units(WALK, 1e-9, [1e-6], [1e12])
    for name, system, dt in (("one", WALK, 0.1), ("other", other, 1e8)):
        discrete = baselines.fixed_lag_smoother(system, 2 * dt, 2).discretize(dt, delay="model")
        discrete.to_c(tmp_path / f"{name}.c", precision="float")
        assert checked_by_its_record(tmp_path / f"{name}.c") < 100 * SINGLE


def test_the_header_is_one_for_cpp(tmp_path):
    of_copies(3).discretize(0.1, delay="model").to_c(tmp_path / "made.c", FUNCTIONS[1])
    loop = tmp_path / "loop.cpp"
    loop.write_text(
        'extern "C" {\n#include "made.h"\n}\n'
        "int main() { made_state s; made_init(&s); return s.x[0] != 0; }\n"
    )
    compile_c(tmp_path / "made.c", tmp_path / "made.o", *STRICT, "-c")
    flags = ("-Wall", "-Werror", str(tmp_path / "made.o"))
    compile_c(loop, tmp_path / "loop", *flags, compiler="c++")


def test_a_step_that_leaves_the_range_changes_nothing(tmp_path):
    discrete = baselines.fixed_lag_smoother(WALK, 0.5, 1).discretize(0.1, delay="model")
    discrete.to_c(tmp_path / "made.c")
    library = compile_c(tmp_path / "made.c", tmp_path / "made.so", *STRICT, "-shared", "-fPIC")
    step = ctypes.CDLL(str(library)).made_step
    state, smoothed, filtered = (
        (ctypes.c_double * 2)(1.0, 2.0),
        *((ctypes.c_double * 1)() for _ in "sf"),
    )
    assert step(state, (ctypes.c_double * 1)(math.inf), smoothed, filtered) == 1
    assert [*state, *smoothed, *filtered] == [1.0, 2.0, 0.0, 0.0]
    assert step(state, (ctypes.c_double * 1)(math.nan), smoothed, filtered) == 0
    discrete.reset([1.0, 2.0])
    assert_allclose([smoothed[0]], discrete.step([math.nan]), rtol=1e-14)
    assert_allclose([filtered[0]], discrete.filtered, rtol=1e-14)


COUNTED = """
#include <cmath>
#include <cstdio>
static int products, sums, functions;
struct Counted {
    double value;
    Counted(double given = 0) : value(given) {}
};
static Counted operator*(Counted a, Counted b) { products++; return a.value * b.value; }
static Counted operator+(Counted a, Counted b) { sums++; return a.value + b.value; }
static Counted operator-(Counted a, Counted b) { sums++; return a.value - b.value; }
static bool isnan(Counted a) { return std::isnan(a.value); }
static bool isfinite(Counted a) { return std::isfinite(a.value); }
static Counted probe(Counted a) { functions++; return a; }
"""


@pytest.mark.parametrize(("measurements", "g"), [(1, 0), (2, 2)])
def test_the_operations_of_a_step_are_as_its_comment_says(tmp_path, measurements, g):
    discrete = of_copies(5, measurements=measurements, g=g).discretize(0.1, delay="model")
    discrete.to_c(tmp_path / "made.c", functions=["probe(x)"] * g)
    code, header = ((tmp_path / f"made.{kind}").read_text() for kind in "ch")
    said = re.search(r"at most (\d+) multiplications, (\d+) additions, (\d+) func", code)
    program = COUNTED + header.replace("typedef double", "typedef Counted")
    program += re.sub(r"#include .*\n", "", code.partition("#ifdef ROBSMOOTH_TEST")[0])
    program += "int main() { made_state s; Counted y[2], given[2], one[2], two[2]; made_init(&s);"
    for gaps in np.ndindex((2,) * measurements):
        program += "".join(f"y[{i}] = {'NAN' if gap else '1'};" for i, gap in enumerate(gaps))
        program += (
            f"products = sums = functions = 0; made_step(&s, y{', given' * bool(g)}, one, two);"
        )
        program += 'std::printf("%d %d %d ", products, sums, functions);'
    (tmp_path / "counted.cpp").write_text(program + "}")
    target = compile_c(tmp_path / "counted.cpp", tmp_path / "counted", "-w", compiler="c++")
    printed = subprocess.run([target], capture_output=True, text=True, check=True).stdout
    counted = np.array(printed.split(), dtype=int).reshape(-1, 3)
    assert_array_equal(np.array(said.groups(), dtype=int), counted.max(axis=0))


# --- what is refused -----------------------------------------------------------------------------


MANY = rs.UncertainSystem([[-1.0]], [[1.0, 0, 0, 0, 0, 0]], [[1.0]], np.ones((5, 1)), np.eye(6)[1:])


@pytest.mark.parametrize(
    ("estimator", "path", "options", "sentence"),
    [
        (WALK, "1st.c", {}, "path must be NAME.c with a NAME for C, got '1st.c'"),
        (WALK, "naïve.c", {}, "path must be NAME.c with a NAME for C, got 'naïve.c'"),
        (WALK, "made.cpp", {}, "path must be NAME.c with a NAME for C, got 'made.cpp'"),
        (WALK, "made.c", {"precision": "half"}, "precision must be .*'double'.*'float'.*half"),
        (MANY, "made.c", {}, "to_c is for .* at most 4 measurements, got DiscreteSmoother"),
        (EXAMPLE, "made.c", {}, "functions must be a list of 1 expressions .*'sin.x.'.* got None"),
        (EXAMPLE, "made.c", {"functions": "sin(x)"}, "functions must be a sequence of expr"),
        (EXAMPLE, "made.c", {"functions": ["sin(x)"] * 2}, "functions must have 1 entries, got 2"),
        (EXAMPLE, "made.c", {"functions": ["x); abort("]}, "functions must be a list of 1"),
        (EXAMPLE, "made.c", {"functions": [np.sin]}, "functions must be a list of 1"),
    ],
)
def test_what_is_refused_is_said_and_nothing_is_written(
    tmp_path, estimator, path, options, sentence
):
    copies = estimator is EXAMPLE
    smoother = baselines.fixed_lag_smoother(estimator, 1e-6, 1, copies=copies)
    discrete = smoother.discretize(1e-7, delay="model")
    with pytest.raises((ValueError, TypeError), match=sentence):
        discrete.to_c(tmp_path / path, **options)
    assert list(tmp_path.iterdir()) == []


def test_an_exact_smoother_has_no_c_code_and_no_transfer_function():
    discrete = baselines.fixed_lag_smoother(WALK, 0.5, 1).discretize(0.1)
    with pytest.raises(ValueError, match="to_c is for an estimator with its delay model"):
        discrete.to_c("made.c")
    with pytest.raises(ValueError, match="to_statespace is for delay='model' without copies"):
        discrete.to_statespace()
    with pytest.raises(ValueError, match="to_statespace is for delay='model' without copies"):
        of_copies(3).discretize(0.1, delay="model").to_statespace()


def test_numbers_that_single_precision_does_not_hold_are_refused(tmp_path):
    far = in_other_units(WALK, 1.0, [1e50], [1.0])
    discrete = baselines.kalman_bucy(far).discretize(0.1, delay="model")
    with pytest.raises(ValueError, match="precision must be 'double'"):
        discrete.to_c(tmp_path / "made.c", precision="float")
    discrete.to_c(tmp_path / "made.c")
    assert checked_by_its_record(tmp_path / "made.c") < DOUBLE


def test_what_was_taken_before_is_not_in_the_code(tmp_path):
    discrete = of_copies(3).discretize(0.1, delay="model")
    discrete.run(np.ones((20, 2)))
    state = discrete.state
    discrete.to_c(tmp_path / "later.c", FUNCTIONS[1])
    assert discrete.samples == 20
    assert_array_equal(discrete.state, state)
    assert checked_by_its_record(tmp_path / "later.c") < DOUBLE


# --- matrices, and python-control ----------------------------------------------------------------


def test_the_matrices_are_those_of_a_step():
    discrete = of_copies(3).discretize(0.1, delay="model")
    step = discrete.matrices
    x, expected = np.zeros(len(step["transition"])), []
    y, reference = np.random.default_rng(1).standard_normal((2, 30, 2))

    def copies(x, r):
        nu = step["arguments"] @ x - r
        return np.array([np.tanh(nu[0]), np.sin(nu[1])])

    for row, r in zip(y, reference, strict=True):
        mu = copies(x, r)
        ahead = step["transition"] @ x + step["measurement"] @ row + step["copies"] @ mu
        x = ahead + step["correction"] @ (copies(ahead, r) - mu)
        expected.append(step["smoothed"] @ x)
    assert_allclose(discrete.run(y, reference=reference), expected, rtol=1e-11, atol=1e-13)
    assert_allclose(step["filtered"] @ x, discrete.filtered, rtol=1e-11)


def test_the_matrices_of_an_exact_smoother_are_those_of_its_filter():
    discrete = baselines.fixed_lag_smoother(WALK, 0.5, 1).discretize(0.1)
    step, y = discrete.matrices, np.random.default_rng(1).standard_normal((400, 1))
    P = np.eye(1)
    for _ in range(400):
        K = (step["Phi"] @ P @ step["H"].T + step["S"]) / (step["H"] @ P @ step["H"].T + step["R"])
        P = (
            step["Phi"] @ P @ step["Phi"].T
            + step["Q"]
            - K @ (step["Phi"] @ P @ step["H"].T + step["S"]).T
        )
    x = np.zeros(1)
    for row in y:
        x = step["transition"] @ x + K @ (row - step["measurement"] @ x)
    assert_allclose(discrete.run(y, output="filtered")[-1], step["filtered"] @ x, rtol=1e-9)


def test_matrices_can_be_read_only_and_go_to_matlab(tmp_path):
    discrete = of_copies(3).discretize(0.1, delay="model")
    with pytest.raises(ValueError, match="read-only"):
        discrete.matrices["transition"][0, 0] = 1.0
    with pytest.raises(TypeError):
        discrete.matrices["transition"] = 1.0
    scipy.io.savemat(tmp_path / "step.mat", discrete.matrices)
    found = scipy.io.loadmat(tmp_path / "step.mat")
    for name, matrix in discrete.matrices.items():
        assert_array_equal(found[name], matrix)


@pytest.mark.filterwarnings("ignore::robsmooth.LongStepWarning")
@settings(max_examples=10)
@given(seeds, st.floats(-2, 1))
@example(seed=0, exponent=1.0)  # a sample is longer than twice the delay
def test_python_control_has_the_same_responses(seed, exponent):
    system = random_system(np.random.default_rng(seed), n=2, m=2, measurements=2, g=0)
    estimator = baselines.fixed_lag_smoother(system, 0.5, 2)
    dt = 10**exponent / np.abs(estimator.poles).max()
    discrete = estimator.discretize(dt, delay="model")
    there = discrete.to_statespace()
    assert there.dt == dt
    assert there.output_labels == ["smoothed[0]", "smoothed[1]", "filtered[0]", "filtered[1]"]
    y = np.random.default_rng(seed).standard_normal((50, 2))
    found = control.forced_response(there, dt * np.arange(50), y.T).outputs.T
    size = np.abs(found).max()
    assert_allclose(found[:, :2], discrete.run(y), rtol=0, atol=1e-11 * size)
    discrete.reset()
    assert_allclose(found[:, 2:], discrete.run(y, output="filtered"), rtol=0, atol=1e-11 * size)
