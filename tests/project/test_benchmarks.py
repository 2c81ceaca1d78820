"""The benchmark: its peers simulate what robsmooth does, and the README says what was measured."""

import json
import sys
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks import __main__ as bench
from benchmarks import (
    exported,
    growth,
    kalman,
    latency,
    race,
    report,
    riccati,
    throughput,
)
from benchmarks.peers import PEERS, cpp, numpy_vectorised, octave, robsmooth_kernel
from benchmarks.problem import Sample, Unavailable, literal_problem
from benchmarks.smoothers import SMOOTHERS
from benchmarks.smoothers.problem import FIXED_LAG, WHOLE, Smoother, sampled
from robsmooth import cli, homodyne
from robsmooth.estimators import baselines

ROOT = Path(__file__).resolve().parents[2]
BY_NAME = {peer.name: peer for peer in PEERS}
# Paths that each simulates in about a second, whatever the machine's speed is.
# Others' packages, JAX's for one, are not in the development environment.
TESTED = {
    "C++, single": 16_000,
    "C++, mixed": 16_000,
    "NumPy, float32": 4000,
    "NumPy, float64": 4000,
    "numba, scalar loop": 1400,
    "Python loop": 100,
    "Octave, vectorised": 4000,
}


@pytest.fixture(scope="module")
def problem():
    return literal_problem()


@pytest.fixture(scope="module")
def reference(problem):
    simulate = robsmooth_kernel.prepare(problem, "mixed")
    return simulate(100_000, race.CHECKED_STEPS, race.REFERENCE_SEED)


def prepared(name, problem):
    try:
        return BY_NAME[name].prepare(problem)
    except Unavailable as reason:
        pytest.skip(str(reason))


# --- the peers -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "paths"), TESTED.items(), ids=str)
def test_a_peer_finds_the_same_errors(name, paths, problem, reference, monkeypatch):
    monkeypatch.setattr(race, "FEWEST_PATHS", paths)
    peer = BY_NAME[name]
    simulate = prepared(name, problem)
    check = race.checked(peer, simulate, reference, seconds=0)
    assert check["agrees"], check["standard_errors_off"]


@pytest.mark.parametrize("precision", ["single", "mixed"])
@pytest.mark.parametrize("paths", [1, 200])
def test_the_cpp_simulates_the_very_same_paths(precision, paths, problem):
    simulate = prepared(f"C++, {precision}", problem)
    ours = robsmooth_kernel.prepare(problem, precision)(paths, 1000, 7)
    *theirs, slips = np.mean(cpp.simulator(problem, precision)(paths, 1000, 7), axis=1)
    assert slips == 0
    assert_allclose(theirs, [ours.filtered.mean_square, ours.smoothed.mean_square], rtol=1e-4)
    if paths > 1:
        assert simulate(paths, 1000, 7).filtered.mean_square == theirs[0]


def test_the_cpp_knows_other_orders(problem):
    prepared("C++, mixed", problem)
    fewer = {
        name: getattr(problem, name)[..., :2]
        for name in ("reference", "copy", "sine_gain", "copy_gain", "noise_gain")
    }
    # the third state takes no part once nothing leads from it to the others
    drift = problem.drift.copy()
    drift[:2, 2] = 0
    large = replace(problem, drift=drift, smoothed=problem.filtered)
    small = replace(
        problem,
        **fewer,
        drift=drift[:2, :2],
        filtered=large.filtered[:2],
        smoothed=large.smoothed[:2],
    )
    expected = cpp.simulator(large, "mixed")(10, 1000, 7)
    assert_allclose(cpp.simulator(small, "mixed")(10, 1000, 7), expected, rtol=1e-9)


class Given:
    """A generator that gives what it was given."""

    def __init__(self, draws):
        self.draws = iter(draws)

    def standard_normal(self, dtype, out):
        out[:] = next(self.draws)


def test_numpy_takes_the_steps_of_the_problem(problem):
    k, draws = problem, np.random.default_rng(1).standard_normal((400, 2, 5))
    phase, x = np.zeros(5), np.zeros((k.order, 5))
    for g1, g2 in draws:
        measured, predicted = np.sin(phase - k.reference @ x), np.sin(k.copy @ x)
        x = x + k.drift @ x + np.outer(k.sine_gain, measured)
        x += np.outer(k.copy_gain, predicted) + np.outer(k.noise_gain, g1)
        phase = phase + k.decay * phase + k.diffusion * g2

    arguments, step = numpy_vectorised.matrices(problem)
    now = np.zeros((step.shape[1], 5))
    now = numpy_vectorised.advance(arguments, step, now, len(draws), Given(draws))
    assert_allclose(now[0], phase, rtol=1e-12)
    assert_allclose(now[1 : 1 + k.order], x, rtol=1e-9, atol=1e-15)


def test_a_peer_that_cannot_run_says_why(monkeypatch, problem):
    for module in (cpp, octave):
        monkeypatch.setattr(module.shutil, "which", lambda name: None)
    cpp.compiled.cache_clear()
    with pytest.raises(Unavailable, match="no C\\+\\+ compiler"):
        BY_NAME["C++, single"].prepare(problem)
    with pytest.raises(Unavailable, match="octave is not installed"):
        BY_NAME["Octave, vectorised"].prepare(problem)


def test_a_wrong_peer_is_found_out(problem, reference):
    peer = BY_NAME["NumPy, float32"]
    simulate = peer.prepare(replace(problem, diffusion=1.5 * problem.diffusion))
    assert not race.checked(peer, simulate, reference, seconds=0)["agrees"]


def test_a_wrong_contender_is_found_out(monkeypatch):
    def doubled():
        return {throughput.OURS: lambda y: y, "the same": lambda y: y, "other": lambda y: 2 * y}

    monkeypatch.setattr(throughput, "contenders", doubled)
    found = throughput.throughput(throughput.Effort(rounds=1, seconds=1e-6))["contenders"]
    assert [name for name, row in found.items() if not row["agrees"]] == ["other"]


@pytest.fixture(scope="module")
def model():
    return sampled(homodyne.PAPER.uncertain_system(), throughput.DT, lag=31)


def filtered(model, y):
    """The estimates of a Kalman filter, from its textbook."""
    z, P, estimates = np.zeros(len(model.F)), model.stationary, []
    for row in y:
        z, P = model.F @ z, model.F @ P @ model.F.T + model.Q
        gain = P @ model.h.T / (model.h @ P @ model.h.T + model.R)
        z, P = z + gain @ (row - model.h @ z), P - gain @ model.h @ P
        estimates.append(model.c @ z)
    return np.array(estimates)[:, 0]


def test_the_filter_of_the_delay_line_is_the_exact_fixed_lag_smoother(model):
    y = np.random.default_rng(0).standard_normal((200, 1))
    smoother = baselines.fixed_lag_smoother(homodyne.PAPER.uncertain_system(), 3.1e-6, 2)
    expected = smoother.discretize(throughput.DT).run(y)[:, 0]
    assert_allclose(filtered(model.with_delay_line(), y), expected, rtol=1e-9, atol=1e-12)


def test_a_smoother_that_is_wrong_or_other_or_absent_is_said_to_be(model):
    def absent(_):
        raise Unavailable("it is not installed")

    def doubled(given):
        return lambda y: 2 * filtered(given.with_delay_line(), y)

    smoothers = [
        Smoother("right", FIXED_LAG, lambda given: partial(filtered, given.with_delay_line())),
        Smoother("wrong", FIXED_LAG, doubled),
        Smoother("other", FIXED_LAG, doubled, differs="it doubles"),
        Smoother("absent", WHOLE, absent),
    ]
    found = kalman.kalman(throughput.Effort(rounds=1, seconds=1e-6), smoothers)
    agrees = {name: row["agrees"] for name, row in found["uses"][FIXED_LAG].items()}
    ours = f"robsmooth, {FIXED_LAG}"
    assert agrees == {ours: True, "right": True, "wrong": False, "other": True}
    assert found["skipped"] == {"absent": "it is not installed"}
    assert found["uses"][FIXED_LAG]["other"]["off_late"] > 0.5


@pytest.mark.filterwarnings("ignore")  # those of other packages are theirs
@pytest.mark.parametrize("smoother", SMOOTHERS, ids=lambda smoother: smoother.name)
def test_anothers_smoother_gives_the_same_estimates_or_says_why_not(smoother, model):
    y = np.random.default_rng(0).standard_normal((300, 1))
    try:
        estimates = smoother.prepare(model)(y)
    except Unavailable as reason:
        pytest.skip(str(reason))
    expected = kalman.ours(homodyne.PAPER.uncertain_system(), 3.1e-6)[smoother.uses](y)[:, 0]
    off = np.abs(estimates - expected) / np.abs(expected).max()
    assert (off[150:].max() < kalman.AGREEMENT) != bool(smoother.differs)
    assert off[150:].max() < 0.1


def test_the_designs_of_others_have_the_same_gain():
    found = riccati.designs(states=(4,), rounds=1)["rows"]
    assert [row["name"] for row in found[:3]] == list(riccati.contenders(growth.chain(4)))[:3]
    assert all(row["agrees"] for row in found)


def test_an_exponent_fits_the_largest_sizes(monkeypatch):
    times = {"10": [9.0] * 3, "100": [2.0, 4.0, 2.0], "200": [8.0] * 3, "400": [32.0, 64.0, 32.0]}
    monkeypatch.setattr(growth, "interleaved", lambda calls, rounds: times)
    curve = growth.Curve("counting", "size", (10, 100, 200, 400), (), lambda size: None, "")
    (row,) = growth.growth(rounds=3, quick=False, curves=(curve,))
    assert row["seconds"] == [9.0, 2.0, 8.0, 32.0]
    assert_allclose(row["exponent"], 2.0)


def test_c_code_that_steps_otherwise_is_found_out(monkeypatch):
    if exported.shutil.which("cc") is None:
        pytest.skip("there is no compiler cc")
    effort = latency.Effort(rounds=1, calls=10, samples=10)
    right = latency.latency(effort)["contenders"]
    assert all(row["agrees"] for row in right.values())
    assert list(map(len, (row["nanoseconds"] for row in right.values()))) == [3, 3, 3, 3, 1, 1, 1]
    driver = exported.DRIVER.replace("B[i] * y[k]", "B[i] * 2 * y[k]")
    monkeypatch.setattr(exported, "DRIVER", driver)
    wrong = latency.latency(effort)["contenders"]
    assert [name for name, row in wrong.items() if not row["agrees"]] == [latency.BY_HAND]


def test_a_workload_takes_the_time_it_is_given():
    peer = replace(BY_NAME["NumPy, float32"], width=1000)
    assert race.workload(peer, rate=1e9, seconds=0.5) == (5000, 100_000)
    assert race.workload(peer, rate=1e7, seconds=0.5) == (1000, 5000)


def test_statistics_are_of_the_squares():
    sample = Sample.of(np.array([1.0, 3.0]), np.array([2.0, 2.0]))
    assert sample.filtered.mean_square == 2.0
    assert sample.filtered.standard_error == 1.0
    assert sample.smoothed.standard_error == 0.0


# --- the command ---------------------------------------------------------------------------------


def one_part_alone(module, *arguments, in_own_process=bench.in_own_process):
    """What a process of its own prints; but here, where all is imported, most parts of `alone`."""
    if module != "alone":
        return in_own_process(module, *arguments)
    *parts, _, peers, quick = arguments
    found = in_own_process("alone", parts[0], "--peers", peers, quick)
    for part in parts[1:]:
        found[part] = import_module(f"benchmarks.{part}").measure(quick == "--quick", peers)
    return json.loads(json.dumps(found))


def test_bench_measures_and_prints(capfd, monkeypatch):
    written = [
        path
        for name in ("results.*", "scaling.*", "history/*")
        for path in report.FOLDER.glob(name)
    ]
    kept = [ROOT / "README.md", *written]
    before = [path.stat().st_mtime_ns for path in kept]
    monkeypatch.setattr(bench, "in_own_process", one_part_alone)
    assert bench.main(["--quick", "--peers", "float64,Octave"]) == 0
    printed = capfd.readouterr().out
    for text in (
        "| NumPy, float64 |",
        "| threads |",
        "| order |",
        "runs^",
        "steps^",
        "lfilter |",
        "| robsmooth, at a fixed lag |",
        "| control.lqe, SciPy |",
        "| nonlinearities g |",
        "| two processes of a Dask cluster |",
        "| design_smoother of the example |",
        "csv to csv |",
        "| 99.9% |",
    ):
        assert text in printed
    skipped = "skipped: Octave, vectorised: octave is not installed"
    assert ("| Octave, vectorised |" in printed) != (skipped in printed)
    assert [path.stat().st_mtime_ns for path in kept] == before


def test_the_command_does_what_the_bench_does(monkeypatch):
    said = []
    ended = SimpleNamespace(returncode=3)
    monkeypatch.setattr(cli.subprocess, "run", lambda *call, **_: said.append(call) or ended)
    assert cli.main(["bench"]) == cli.main(["bench", "--write"]) == 3
    plain = [sys.executable, "-m", "benchmarks"]
    assert said == [(plain,), ([*plain, "--write"],)]


def test_a_quick_run_is_not_written(capfd):
    with pytest.raises(SystemExit, match="2"):
        bench.main(["--quick", "--write"])
    assert "leave out --quick" in capfd.readouterr().err
