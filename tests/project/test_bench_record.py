"""The record of the benchmark: what is judged, what is compared with former runs, what is told."""

import json
from pathlib import Path

import pytest
from numpy.testing import assert_allclose

from benchmarks import __main__ as bench
from benchmarks import aims, exported, history, latency, machine, processes, report, tables, targets
from benchmarks.smoothers import SMOOTHERS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def results():
    return json.loads((report.FOLDER / "results.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def undisturbed(results):
    """The record, where others did not have the whole machine when it was measured."""
    if aims.is_overloaded(results["about"]):
        pytest.skip("the record is of a machine that had too much else to do: times mean nothing")
    return results


def test_without_a_compiler_the_steps_of_python_are_timed(monkeypatch, results):
    monkeypatch.setattr(exported.shutil, "which", lambda name: None)
    found = latency.latency(latency.Effort(rounds=1, calls=10, samples=10))
    assert not any(name.startswith("C,") for name in found["contenders"])
    (table,) = tables.latency_tables({**results, "latency": found})
    assert f"| {latency.OURS} |" in table.markdown()


def test_an_incomplete_run_is_not_written(results, capsys):
    peers = {name: peer for name, peer in results["race"]["peers"].items() if "JAX" not in name}
    bench.keep({**results, "race": {**results["race"], "peers": peers}})
    assert "nothing is written" in capsys.readouterr().out


@pytest.mark.parametrize(("load", "kept"), [(1.0, True), (2.5, False)])
def test_a_run_on_a_busy_machine_is_not_compared_with(load, kept, results, monkeypatch, tmp_path):
    monkeypatch.setattr(report, "write", lambda results: None)
    monkeypatch.setattr(history, "FOLDER", tmp_path)
    about = {**results["about"], "load_before": load}
    about["machine"] = {**about["machine"], "cores": 2}
    bench.keep({**results, "about": about})
    assert bool(list(tmp_path.iterdir())) == kept


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


def test_the_cost_is_what_the_measured_rates_make_it():
    measured = {"rates": {"one": 1e8}, "speed_up": {"processes": [1.6, 1.5, 1.7]}, "call": 0.01}
    found = processes.cost(measured)
    assert found["share"] == 0.8
    assert {row["path_steps"]: row["core_seconds"] for row in found["rows"]}[1e12] == 1e12 / 8e7
    assert_allclose(found["fed"], found["call"] / 0.01)
    assert found["call"] == 80.0  # s, of the largest call at that rate


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


def test_the_record_is_complete_and_its_report_says_which_aims_it_misses(results):
    assert aims.is_complete(results)
    missed = aims.shortfalls(results)
    told = (report.FOLDER / "results.md").read_text(encoding="utf-8")
    assert all(f"- {each}\n" in told for each in missed)
    assert f"{len(missed)} aim" in (ROOT / "README.md").read_text(encoding="utf-8")
    peers = results["race"]["peers"]
    for (name, precision), aim in aims.RACE.items():
        met = peers[name][f"ratio_{precision}"] >= aim
        assert met == (f"times as fast as {name}; the aim is" not in told), name


def test_the_record_scales(undisturbed):
    scales = undisturbed["scales"]
    for what in ("runs", "steps"):
        # no faster than the work; below one, what any call costs shows in the smallest
        assert scales[what]["exponent"] < 1.05
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
