"""The benchmark: its peers simulate what robsmooth does, and the README says what was measured."""

import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks import __main__ as bench
from benchmarks import (
    aims,
    exported,
    growth,
    history,
    kalman,
    latency,
    machine,
    processes,
    race,
    report,
    riccati,
    tables,
    targets,
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


@pytest.fixture(scope="module")
def results():
    return json.loads((report.FOLDER / "results.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def undisturbed(results):
    """The record, where others did not have the whole machine when it was measured."""
    load, cores = results["about"]["load_before"], results["about"]["machine"]["cores"]
    if load > cores:
        pytest.skip(f"the record is of a machine with a load of {load:.1f}: times mean nothing")
    return results


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
    theirs = np.mean(cpp.simulator(problem, precision)(paths, 1000, 7), axis=1)
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


def test_without_a_compiler_the_steps_of_python_are_timed(monkeypatch, results):
    monkeypatch.setattr(exported.shutil, "which", lambda name: None)
    found = latency.latency(latency.Effort(rounds=1, calls=10, samples=10))
    assert not any(name.startswith("C,") for name in found["contenders"])
    (table,) = tables.latency_tables({**results, "latency": found})
    assert f"| {latency.OURS} |" in table.markdown()


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


def test_bench_measures_and_prints(capfd):
    kept = [ROOT / "README.md", *report.FOLDER.glob("results.*"), *report.FOLDER.glob("scaling.*")]
    before = [path.stat().st_mtime_ns for path in kept]
    assert bench.main(["--quick", "--peers", "NumPy,Octave"]) == 0
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


def test_an_incomplete_run_is_not_written(results, capsys):
    peers = {name: peer for name, peer in results["race"]["peers"].items() if "JAX" not in name}
    bench.keep({**results, "race": {**results["race"], "peers": peers}})
    assert "nothing is written" in capsys.readouterr().out


def test_a_peer_that_disagrees_is_marked(results):
    peers = results["race"]["peers"]
    wrong = {
        **results["race"],
        "peers": {**peers, "Python loop": {**peers["Python loop"], "agrees": False}},
    }
    changed = {**results, "race": wrong}
    assert aims.disagreeing(changed) == ["Python loop"]
    assert "DISAGREES" in tables.peers_table(changed).markdown()
    assert not aims.is_complete(changed)


def test_a_design_that_takes_too_long_is_said_to(results):
    first, *others = results["targets"]
    slow = {**results, "targets": [{**first, "measured": 0.08}, *others]}
    said = set(aims.shortfalls(slow)) - set(aims.shortfalls(results))
    assert said == {"design_smoother of the example: 80 ms; the aim is 1 ms"}


def test_a_minimax_smoother_that_takes_too_long_is_said_to(results):
    first, *others = results["guarantees"]
    slow = {**results, "guarantees": [{**first, "seconds": 2.0}, *others]}
    (sentence,) = set(aims.shortfalls(slow)) - set(aims.shortfalls(results))
    assert sentence.startswith("the minimax smoother of the paper's example, smoothed takes 2.0 s")


# --- former runs ---------------------------------------------------------------------------------


def test_a_ratio_is_worse_only_beyond_a_tenth_and_the_quartiles():
    before = {name: [1.0, 0.95, 1.05] for name in ("same", "less", "spread", "worse", "better")}
    now = {
        "same": [1.0, 0.9, 1.1],
        "less": [0.92, 0.91, 0.93],  # by less than a tenth
        "spread": [0.85, 0.7, 1.0],
        "worse": [0.85, 0.8, 0.9],
        "better": [1.5, 1.4, 1.6],
        "new": [1.0, 1.0, 1.0],
    }
    run = {"written": "2026-01-02T00:00:00", "commit": "a" * 40, "figures": before}
    found = history.compared(now, [{**run, "figures": {}}, run])
    assert [row["name"] for row in found["rows"]] == list(before)
    assert [row["name"] for row in found["rows"] if row["worse"]] == ["worse"]
    said = aims.regressions({"since": found})
    assert said == ["WORSE than on 2026-01-02: worse: 0.85, before 1.00"]


def test_runs_are_kept_by_machine_and_the_last_is_compared_with(tmp_path, results):
    about, figures = results["about"], history.figures(results)
    for date in ("2026-01-01", "2026-01-02"):
        path = history.keep({**about, "written": date}, figures, tmp_path)
    assert path.name == f"{machine.slug(about['machine'])}.json"
    runs = history.former(about["machine"], tmp_path)
    assert [run["written"] for run in runs] == ["2026-01-01", "2026-01-02"]
    assert history.former({**about["machine"], "cores": 64}, tmp_path) == []
    found = history.compared(figures, runs)
    assert found["written"] == "2026-01-02"
    assert len(found["rows"]) == len(figures)
    assert not any(row["worse"] for row in found["rows"])


def test_of_every_ratio_that_is_kept_the_higher_is_the_better(results):
    waits = [row for row in results["targets"] if "ratio" in row]
    slower = {**results, "targets": [{**row, "ratio": 2 * row["ratio"]} for row in waits]}
    before, now = history.figures(results), history.figures(slower)
    changed = {name for name in before if now[name] != before[name]}
    assert len(changed) == len(waits)
    assert all(now[name][0] < before[name][0] for name in changed)


# --- past one machine ----------------------------------------------------------------------------


def test_the_cost_is_what_the_measured_rates_make_it():
    measured = {"rates": {"one": 1e8}, "speed_up": {"processes": [1.6, 1.5, 1.7]}, "call": 0.01}
    found = processes.cost(measured)
    assert found["share"] == 0.8
    assert {row["path_steps"]: row["core_seconds"] for row in found["rows"]}[1e12] == 1e12 / 8e7
    assert_allclose(found["fed"], found["call"] / 0.01)
    assert found["call"] == 80.0  # s, of the largest call at that rate


# --- the record ----------------------------------------------------------------------------------


def test_the_record_says_why_what_grows_faster_than_a_cube_does(undisturbed):
    curves = undisturbed["growth"]["curves"]
    against = {curve["against"] for curve in curves}
    assert {"states n", "uncertainties k", "nonlinearities g", "samples"} <= against
    for curve in curves:
        assert curve["reason"]
        assert curve["exponent"] < 3.3, curve["name"]  # dense linear algebra, and its memory


def test_the_record_has_the_packages_that_smooth_and_design(results):
    measured = [name for rows in results["kalman"]["uses"].values() for name in rows]
    assert {smoother.name for smoother in SMOOTHERS} <= {*measured, *results["kalman"]["skipped"]}
    assert results["processes"]["same_bits"]
    named = [target.name for target in targets.TARGETS]
    assert [row["name"] for row in results["targets"]][: len(named)] == named


def test_the_record_certifies_what_a_prototype_did_or_less(results):
    for row in results["guarantees"]:
        assert row["minimax"] <= row["reference"]
        assert row["minimax"] <= min(row["classical"], row["tuned"]) * (1 + 1e-6)


def test_the_readme_quotes_the_record(results):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"{report.BEGIN}\n{report.readme_block(results)}{report.END}" in text


def test_the_report_is_of_the_record(results):
    assert (report.FOLDER / "results.md").read_text(encoding="utf-8") == report.markdown(results)


def test_the_record_is_complete_and_the_readme_says_which_aims_it_misses(results):
    assert aims.is_complete(results)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert all(f"- Missed here: {missed}.\n" in text for missed in aims.shortfalls(results))
    peers = results["race"]["peers"]
    for (name, precision), aim in aims.RACE.items():
        met = peers[name][f"ratio_{precision}"] >= aim
        assert met == (f"times as fast as {name}; the aim is" not in text), name


def test_the_record_scales(undisturbed):
    scales = undisturbed["scales"]
    for what in ("runs", "steps"):
        assert abs(scales[what]["exponent"] - 1) < 0.05
    assert scales["memory"][-1]["megabytes"] < 1.1 * scales["memory"][0]["megabytes"]
    assert scales["first_call"]["call"] < 1.0
    for row in scales["orders"][1:]:
        assert row["relative"] < 1 + row["order"]  # no order falls off a cliff
    (two,) = [row for row in scales["threads"] if row["threads"] == 2]
    assert two["speed_up"] > 1.8


def test_the_record_smooths_millions_of_samples_a_second(undisturbed):
    records = undisturbed["throughput"]["contenders"]
    for name in ("robsmooth", "robsmooth, a gap in ten", "robsmooth, compiled copies"):
        assert records[name]["rate"] > 1e6, name
    assert records["scipy.signal.lfilter"]["ratio"] > 0.1  # lfilter has neither gaps nor copies


def test_the_record_says_what_files_cost(undisturbed):
    paths = undisturbed["from_files"]["paths"]
    assert list(paths) == ["csv to csv", "csv to npy", "npy to npy", "parquet to npy"]
    for name, row in paths.items():
        assert row["rate"] > 5e5, name
        assert row["share"] < 1.0, name
