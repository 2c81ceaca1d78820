"""The runner, tried on notebooks that are good and on ones that are broken in every known way."""

import json
import math
import shutil
import signal
import subprocess
import sys
import time

import psutil
import pytest

from robsmooth import cli
from robsmooth._support import files
from robsmooth._support.cluster import connect
from robsmooth.workbench import parameters, runner
from robsmooth.workbench.execution import Execution
from robsmooth.workbench.parameters import PipelineError
from tests.helpers.clusters import cluster_of_threads
from tests.helpers.signals import heed_signals
from tests.helpers.waiting import PATIENCE, wait_until

# --- what is refused before anything runs --------------------------------------------------------


@pytest.mark.parametrize("fixture, count", [("no_parameters", 0), ("two_parameters", 2)])
def test_a_notebook_needs_exactly_one_parameters_cell(project, fixture, count):
    project.add("good", fixture)
    with pytest.raises(PipelineError, match=f"02_{fixture}.ipynb: exactly one .* not {count}$"):
        project.run()
    assert not (project.root / "build").exists()


def test_a_renamed_notebook_is_an_error(project):
    project.add("good")
    project.path("01_good").rename(project.path("better"))
    with pytest.raises(PipelineError, match=r"'01_good' is not one of \['better'\]"):
        project.plan()


def test_an_unlisted_notebook_is_an_error(project):
    project.add("good")
    shutil.copy(project.path("01_good"), project.path("02_extra"))
    with pytest.raises(PipelineError, match=r"notebooks/02_extra.ipynb is not listed"):
        project.plan()


@pytest.mark.parametrize(
    "content", ["", '{"cells": [', "[]", "{}", "5", "[" * 100_000, '{"nbformat": 3}', "\x00"]
)
def test_a_damaged_notebook_is_an_error(project, content):
    project.add("good")
    project.path("01_good").write_text(content)
    assert_unreadable(project)


def assert_unreadable(project):
    with pytest.raises(PipelineError, match=r"^01_good.ipynb: not a readable notebook") as refused:
        project.plan()
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize("name", ["cell_type", "source", "metadata"])
@pytest.mark.parametrize("value", [None, 5, "parameters", ["parameters"]])
def test_a_notebook_with_a_cell_that_is_none_is_an_error(project, name, value):
    notebook = json.loads(project.add("good").path("01_good").read_text())
    if value is None:
        del notebook["cells"][1][name]
    elif (name, value) == ("source", "parameters"):
        notebook["cells"][1] = value
    elif (name, value) == ("source", ["parameters"]):
        notebook["cells"] = value
    else:
        notebook["cells"][1][name] = value
    project.path("01_good").write_text(json.dumps(notebook))
    assert_unreadable(project)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"[quick.01_good\n", "cannot be read: "),
        (b"notebooks = []  # \xff", "cannot be read: 'utf-8' codec"),
        (b"x = " + b"[" * 5000, "cannot be read: maximum recursion depth"),
        (b"", r"\$: 'notebooks' is a required property"),
        (b"notebooks = 5", r"\$.notebooks: 5 is not of type 'array'"),
        (b"notebooks = [1]", r"\$.notebooks\[0\]: 1 is not one of \['01_good'\]"),
        (b'notebooks = ["../notebooks/01_good"]', r"\$.notebooks\[0\]: .* is not one of"),
        (b'notebooks = ["a\\u0000b"]', r"\$.notebooks\[0\]: .* is not one of"),
        (b'notebooks = ["01_good", "01_good"]', r"\$.notebooks: .* has non-unique elements"),
        (b"notebooks = []\nquick = 5", r"\$.quick: 5 is not of type 'object'"),
        (b"notebooks = []\nquick.01_good = 5", r"\$.quick.*: 5 is not of type 'object'"),
    ],
)
def test_damaged_profiles_are_an_error(project, content, message):
    project.add("good")
    (project.root / "notebooks" / "profiles.toml").write_bytes(content)
    with pytest.raises(PipelineError, match=f"profiles.toml.*{message}") as refused:
        project.plan(profile="quick")
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    "values, message",
    [
        ({"rums": 5}, "rums is unknown; known: check, lag, runs, scale, seed$"),
        ({"output_dir": "x"}, "output_dir is set by the pipeline"),
        ({"scheduler": "x"}, "scheduler is set by the pipeline"),
        ({"checkpoint_dir": "x"}, "checkpoint_dir is set by the pipeline"),
        ({"runs": "many"}, r"runs must be of type int, got 'many' \(str\)"),
        ({"runs": 2.0}, r"runs must be of type int, got 2.0 \(float\)"),
        ({"runs": True}, r"runs must be of type int, got True \(bool\)"),
        ({"lag": True}, r"lag must be of type float, got True \(bool\)"),
        ({"check": 1}, r"check must be of type bool, got 1 \(int\)"),
        ({"runs": 0}, r"runs must be finite and in \[1, 1e\+09\], got 0"),
        ({"lag": 0}, r"lag must be finite and in \(0, 0.001\], got 0.0"),
        ({"lag": 0.0011}, r"lag must be finite and in \(0, 0.001\], got 0.0011"),
        ({"lag": math.nan}, "lag must be finite .*, got nan"),
        ({"lag": math.inf}, "lag must be finite .*, got inf"),
        ({"lag": 10**400}, "lag must be finite .*, got inf"),
        ({"runs": 10**5000}, "runs must be finite .*, got inf"),
        ({"runs": "9" * 200_000}, r"runs must be of type int, got '9{59} \(str\)$"),
        ({"scale": "\udcff"}, "--set for 01_good: .* can't encode"),
    ],
)
def test_a_wrong_value_is_refused_before_anything_runs(project, values, message):
    project.add("good").add_optional("01_good")
    with pytest.raises(PipelineError, match=message):
        project.run(parameters=values)
    assert not (project.root / "build").exists()


def test_values_at_the_ends_of_a_closed_interval_and_ints_for_floats_are_taken(project):
    project.add("good").edit("01_good", "(0, 1e-3] s", "(-inf, 3] s")
    (task,) = project.plan(parameters={"runs": 1, "lag": 3})
    assert task.values["runs"] == 1
    assert task.values["lag"] == 3.0
    assert type(task.values["lag"]) is float


def test_a_value_goes_to_the_notebooks_that_have_it(project):
    project.add("good", "foreign_kernel")
    good, foreign = project.plan(parameters={"runs": 9})
    assert good.values["runs"] == 9
    assert "runs" not in foreign.values
    with pytest.raises(PipelineError, match="runs is unknown"):
        project.plan(only=["foreign"], parameters={"runs": 9})


def test_profile_values_are_used_and_overridden(project):
    project.add("good").write_profiles("[quick.01_good]\nruns = 3\nlag = 1e-6\n")
    assert project.plan()[0].values == {}
    quick = {"runs": 3, "lag": 1e-6}
    assert project.plan(profile="quick")[0].values == quick
    assert project.plan(profile="quick", parameters={"runs": 4})[0].values == {**quick, "runs": 4}


@pytest.mark.parametrize(
    "table, message",
    [
        ("[quick.01_good]\nrums = 3\n", r"profiles.toml, \[quick.01_good\]: parameter rums is unk"),
        ("[quick.01_good]\nruns = -3\n", r"\[quick.01_good\]: runs must be finite and in"),
        ("[quick.01_god]\nruns = 3\n", r"\$.quick: '01_god' is not one of \['01_good'\]"),
    ],
)
def test_a_wrong_profile_is_an_error(project, table, message):
    project.add("good").write_profiles(table)
    with pytest.raises(PipelineError, match=message):
        project.plan(profile="quick")


@pytest.mark.parametrize(
    "line, message",
    [
        ("runs = 5", r"line 4 must read name: type = value"),
        ("runs: complex = 5", r"line 4 must read .* with type one of bool, int, float, str"),
        ("runs: int = 2 * 3", r"parameters cell: runs: "),
        ("runs: int = 5.0", r"default: runs must be of type int"),
        (
            "runs: int = 0  # [1, inf) runs",
            r"default: runs must be .* in \[1, inf\), got 0",
        ),
        ("runs: int = 5  # [1; 9] runs", r"runs: the comment must open with \[low, high\]"),
        ("runs: int = 5  # [one, 9] runs", r"runs: could not convert string to float: 'one'"),
        ("runs: int =", r"line 4 is not Python"),
        ("runs: int = " + "-" * 200_000 + "1", r"parameters cell: (runs|line 1 is not Python)"),
        ("runs: int = " + "(" * 200_000, r"line \d+ is not Python"),
    ],
)
def test_a_parameters_cell_that_cannot_be_checked_is_an_error(project, line, message):
    project.add("good").edit(
        "01_good", "runs: int = 50_000  # [1, 1e9] runs = paths of", line + " #"
    )
    with pytest.raises(PipelineError, match=message):
        project.plan()


@pytest.mark.parametrize("folder", ["output_dir", "data_dir"])
def test_a_notebook_must_let_its_folders_be_chosen(project, folder):
    project.add("good").edit("01_good", f"{folder}: str", "elsewhere: str")
    with pytest.raises(PipelineError, match=f"the parameters cell must hold {folder}: str"):
        project.plan()


@pytest.mark.parametrize(("name", "kind"), parameters.OPTIONAL.items())
def test_what_the_pipeline_may_set_must_have_its_type(project, name, kind):
    project.add("good").edit("01_good", "seed: int = 7", f"{name}: int = 7")
    with pytest.raises(PipelineError, match=f"the parameters cell must hold {name}: {kind}"):
        project.plan()


def test_a_comment_may_hold_an_equals_sign(project):
    project.add("good")
    read = parameters.read(project.path("01_good"))
    assert read["runs"].default == 50_000
    assert read["runs"].interval == {"low": 1.0, "high": 1e9, "without": []}


def test_notebooks_are_selected_by_parts_of_their_names():
    names = ["01_model", "02_design", "03_sweep", "03_sweep_wide"]
    assert runner.select(names, []) == names
    assert runner.select(names, ["02", "model"]) == ["01_model", "02_design"]
    assert runner.select(names, ["03"]) == ["03_sweep", "03_sweep_wide"]
    with pytest.raises(PipelineError, match="02_desing is unknown; known: 01_model, 02_design"):
        runner.select(names, ["02_desing"])


@pytest.mark.parametrize(
    "options, message",
    [
        ({"jobs": 0}, "jobs must be 1 or more, not 0"),
        *(
            ({"time_limit": value}, r"time_limit must be in \(0, 1e6\] s, not")
            for value in (math.nan, math.inf, -1.0, 0.0, 1e300)
        ),
    ],
)
def test_a_wrong_option_is_an_error(project, options, message):
    with pytest.raises(PipelineError, match=message):
        project.add("good").run(**options)


# --- runs ----------------------------------------------------------------------------------------


def test_every_notebook_is_run_and_one_summary_tells_of_the_failures(project, monkeypatch, capsys):
    monkeypatch.setattr(Execution, "seconds", 0.0)  # a cell is over its limit, no notebook is
    project.add("good", "raises", "exits", "dies", "foreign_kernel", "hanging_cell")
    project.write_profiles('[quick."01_good"]\nruns = 3\n')
    quick = project.root / "build" / "quick"
    (quick / "figures").mkdir(parents=True)
    (quick / "figures" / "figure.txt").write_text("yesterday's")
    monkeypatch.chdir(project.root / "notebooks")
    reports = []
    monkeypatch.setattr(cli, "_write_report", lambda run: reports.append(run))
    command = ["figures", "--profile", "quick", "--only"]

    assert cli.main([*command, "02,03,04,06", "--time-limit", "6"]) == 1
    assert (quick / "figures" / "figure.txt").read_text() == "yesterday's"
    assert not (quick / "staging").exists()
    output, summary = capsys.readouterr()
    assert "02_raises: FAILED" in output
    assert "4 of 4 notebooks failed; their earlier results are untouched." in summary
    assert "02_raises, cell 4\n" in summary
    assert "ArithmeticError: the bound does not hold" in summary
    assert "03_exits, cell 3\n" in summary
    assert "SystemExit: 0" in summary
    assert "04_dies, cell 3\n" in summary
    assert "Kernel died" in summary
    assert "06_hanging_cell, cell 3\n" in summary
    assert "timed out" in summary
    assert "\x1b" not in output + summary
    for name in ("02_raises", "03_exits", "04_dies", "06_hanging_cell"):
        assert f"executed copy: {quick / 'notebooks' / name}.ipynb" in summary
        assert (quick / "notebooks" / f"{name}.ipynb").exists()
    assert reports == []

    assert cli.main([*command, "good,foreign"]) == 0
    output, summary = capsys.readouterr()
    assert "01_good: done" in output
    assert "05_foreign_kernel: done" in output
    assert [(run.root, run.results) for run in reports] == [(project.root, quick)]
    assert (quick / "data" / "result.json").read_text() == "3"
    about = json.loads((quick / "figures" / "01_good.provenance.json").read_text())
    assert about["parameters"] == {"runs": 3}
    assert about["seed"] == 7
    assert set(about["files"]) == {"figures/figure.txt", "data/result.json"}
    assert not (project.root / "figures").exists()


def test_a_fresh_notebook_is_skipped_and_any_change_runs_it_again(project):
    project.add("good")
    (first,) = project.run()
    assert first.status == "done"
    results = project.results()
    assert results["figures/figure.txt"] == b"50000 runs, lag 3.1e-06, paper"
    assert results.keys() == set(first.files)

    (second,) = project.run()
    assert second.status == "fresh"
    assert second.files == first.files
    assert project.results() == results

    for file, content in results.items():
        (project.root / file).unlink()
        assert runner._fresh(project.plan()[0]) is None
        (project.root / file).write_bytes(content + b"touched up by hand")
        assert runner._fresh(project.plan()[0]) is None
        (project.root / file).write_bytes(content)
        assert runner._fresh(project.plan()[0]) == first.files
    stamp = project.root / "build" / "paper" / "stamps" / "01_good.json"
    whole = stamp.read_text()
    for damage in ("", "[]", "{}", '{"key": 1, "files": {"elsewhere/x": 1}}'):
        stamp.write_text(damage)
        assert runner._fresh(project.plan()[0]) is None
    stamp.write_text(whole)

    project.edit("01_good", "figure.txt", "fig1.txt")
    assert project.run()[0].status == "done"
    assert "figures/fig1.txt" in project.results()
    assert "figures/figure.txt" not in project.results()  # no orphans of its last run

    before = project.results()
    project.edit("01_good", "runs > 0", "runs < 0")
    (failed,) = project.run()
    assert failed.status == "failed"
    assert failed.failure.startswith("cell 5\n")
    assert project.results() == before


def test_values_of_ones_own_never_reach_the_results_of_the_paper(project):
    (result,) = project.add("good").run(parameters={"runs": 11})
    assert result.status == "done"
    assert project.results() == {}
    custom = project.root / "build" / "custom"
    assert (custom / "data" / "result.json").read_text() == "11"


def test_all_that_a_result_depends_on_is_in_its_key(project):
    project.add("good").write_profiles("[quick.01_good]\nruns = 3\n")
    (project.root / "data").mkdir()
    keys = [project.key(), project.key(profile="quick"), project.key(parameters={"runs": 4})]
    for change in (
        lambda: project.edit("01_good", "## Checks", "## Checks!"),
        lambda: (runner.PACKAGE / "model.py").write_text("x = 1"),
        lambda: (runner.PACKAGE / "robsmooth.mplstyle").write_text("font.size: 8"),
        lambda: (project.root / "requirements.lock").write_text("numpy==2.4.6"),
        lambda: (project.root / "data" / "published.toml").write_text("V = 0.15"),
        lambda: (project.root / "data" / "nonlinear_floor.json").write_text("{}"),
    ):
        assert project.key() == project.key()
        change()
        keys.append(project.key())
    assert len(set(keys)) == len(keys)
    project.write_profiles("[quick.01_good]\nruns = 5\n")
    assert project.key() == keys[-1]  # what a notebook does not use does not matter


def test_the_time_limit_ends_the_kernel_and_what_it_started(project, monkeypatch):
    over = PATIENCE + 0.1  # as soon as the kernel has started something
    seconds = property(lambda _: over if len(pids(project)) == 2 else 0.0)
    monkeypatch.setattr(Execution, "seconds", seconds)
    (result,) = project.add("hanging_cell").run(time_limit=PATIENCE)
    assert result.failure == "cell 3\nthe time limit of 600 s for the notebook was reached"
    assert result.seconds == over
    assert_ended(project)


@pytest.mark.parametrize(
    "numbers", [[signal.SIGINT] * 5, [signal.SIGHUP], [signal.SIGKILL]], ids=["INT", "HUP", "KILL"]
)
def test_whatever_ends_a_run_ends_all_that_it_started(project, numbers):
    project.add("hanging_cell")
    with command(project, "figures") as process:
        wait_until(lambda: len(pids(project)) == 2)
        for number in numbers:
            process.send_signal(number)
            time.sleep(0.02)
        _, said = process.communicate(timeout=PATIENCE)
    if numbers == [signal.SIGKILL]:
        assert process.returncode == -signal.SIGKILL
    else:
        assert process.returncode == 130
        (line,) = said.splitlines()
        assert "interrupted; notebooks that had finished are kept" in line
        assert not (project.root / "build/paper/staging").exists()
    assert_ended(project)
    assert project.results() == {}


def command(project, *arguments, code=""):
    """The command in a process that heeds signals, after some code."""
    code = f"import signal, sys\n{code}\nfrom robsmooth.__main__ import main\nsys.exit(main())"
    streams = {"stderr": subprocess.PIPE, "text": True, "preexec_fn": heed_signals}
    return subprocess.Popen([sys.executable, "-c", code, *arguments], cwd=project.root, **streams)


INTERRUPTED = """
class Finder:
    def find_spec(name, path, target=None):
        if name == "{0}":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder)
"""


@pytest.mark.parametrize("module", ["robsmooth.cli", "argparse", "numpy", "robsmooth.workbench"])
def test_an_interrupt_during_the_import_is_no_traceback(project, module):
    project.add("good")
    with command(project, "figures", code=INTERRUPTED.format(module)) as process:
        assert process.communicate(timeout=PATIENCE)[1] == ""
    assert process.returncode == -signal.SIGINT


def test_signals_wait_until_a_run_has_ended_all(project, monkeypatch, capsys):
    came = []

    def run_notebooks(run, tasks, stop):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.raise_signal(number)
        came.extend(stop)
        yield from ()

    monkeypatch.setattr(cli, "run_notebooks", run_notebooks)
    monkeypatch.chdir(project.add("good").root)
    heed_signals()  # for this test
    assert cli.main(["figures"]) == 130
    assert came == [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    assert "interrupted; notebooks that had finished are kept" in capsys.readouterr().err


def test_an_interrupt_while_nothing_runs_is_heeded_at_once(project, monkeypatch, capsys):
    monkeypatch.setattr(cli, "plan", lambda _: signal.raise_signal(signal.SIGTERM))
    monkeypatch.chdir(project.add("good").root)
    assert cli.main(["figures"]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_a_signal_that_is_ignored_stays_so(project, monkeypatch):
    def run_notebooks(run, tasks, stop):
        signal.raise_signal(signal.SIGHUP)
        assert list(stop) == []
        yield from ()

    monkeypatch.setattr(cli, "run_notebooks", run_notebooks)
    monkeypatch.chdir(project.add("good").root)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    assert cli.main(["figures"]) == 0
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler


def test_the_users_own_settings_stay_out_of_a_run(project, monkeypatch):
    project.add("good").edit(
        "01_good", "runs > 0", "__import__('matplotlib').rcParams['font.size'] == 10"
    )
    (project.root / "matplotlib").mkdir()
    (project.root / "matplotlib" / "matplotlibrc").write_text("font.size: 99")
    monkeypatch.setenv("MPLCONFIGDIR", str(project.root / "matplotlib"))
    monkeypatch.setenv("MPLBACKEND", "no such backend")
    (result,) = project.run()
    assert result.failure == ""


def test_a_second_run_in_the_same_place_is_refused(project):
    project.add("good")
    with (
        files.exclusive_lock(project.root / "build" / "paper" / "lock"),
        pytest.raises(BlockingIOError, match="lock is in use by another run: wait until that ends"),
    ):
        project.run()


def pids(project):
    """Of the kernel of hanging_cell, and of what it has started."""
    told = project.root / "build" / "pids"
    return [int(pid) for pid in told.read_text().split()] if told.exists() else []


def assert_ended(project):
    assert len(pids(project)) == 2
    wait_until(lambda: not any(map(psutil.pid_exists, pids(project))))


# --- clusters and checkpoints --------------------------------------------------------------------


def test_a_notebook_that_can_use_a_cluster_is_given_its_scheduler(project):
    project.add("good", "foreign_kernel").add_optional("01_good")
    project.edit_code("01_good", "write_text(str(runs))", "write_text(scheduler)")
    project.edit_code("01_good", "figure.txt", "of_its_own.txt")
    with cluster_of_threads() as (cluster, _):
        results = project.run(dask=cluster.scheduler_address)
    assert [result.failure for result in results] == ["", ""]
    assert project.results()["data/result.json"].decode() == cluster.scheduler_address
    about = (project.root / "figures" / "01_good.provenance.json").read_text()
    assert cluster.scheduler_address not in about
    assert project.run()[0].status == "fresh", "the results do not depend on where they are from"


@pytest.mark.parametrize(
    "address, message",
    [
        (
            "tcp://127.0.0.1:1",
            "--dask: no Dask scheduler answers at tcp://127.0.0.1:1 within 0.2 s",
        ),
        ("http://127.0.0.1:80", "--dask: no Dask scheduler answers at http://127.0.0.1:80"),
        ("tcp://10.0.0.1:80", "--dask: what answers at tcp://10.0.0.1:80 could run code here"),
    ],
)
def test_a_cluster_that_is_not_there_is_one_line_before_anything_runs(
    project, monkeypatch, capsys, address, message
):
    monkeypatch.chdir(project.add("good").root)
    assert connect.__wrapped__.__defaults__ == (5.0,)  # s, in which a scheduler may still start
    monkeypatch.setattr(connect.__wrapped__, "__defaults__", (0.2,))
    assert cli.main(["figures", "--dask", address]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"robsmooth: {message}")
    assert not (project.root / "build").exists()


def test_without_dask_a_cluster_is_refused_in_one_line(project, monkeypatch, capsys):
    monkeypatch.chdir(project.add("good").root)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert cli.main(["figures", "--dask", "tcp://127.0.0.1:8786"]) == 2
    message = "a cluster needs the package distributed: pip install 'robsmooth[cluster]'"
    assert capsys.readouterr().err == f"robsmooth: --dask: {message}\n"


def test_an_interrupted_notebook_resumes_and_one_with_other_inputs_starts_anew(project):
    project.add("good").add_optional("01_good")
    write = """
with open(Path(checkpoint_dir, "saved"), "a+") as saved:
    saved.write(str(runs))
    saved.seek(0)
    Path(data_dir, "result.json").write_text(saved.read())
"""
    project.edit_code("01_good", 'Path(data_dir, "result.json").write_text(str(runs))', write)
    project.edit_code("01_good", "assert check", 'assert Path("../done").exists()')
    checkpoints = project.root / "build" / "paper" / "checkpoints"
    for other in ("01_good/0123456789abcdef", "01_good-wide/0123456789abcdef"):
        (checkpoints / other).mkdir(parents=True)

    assert project.run()[0].status == "failed"
    mine = project.key()[:16]
    assert [path.name for path in (checkpoints / "01_good").iterdir()] == [mine]
    assert (checkpoints / "01_good" / mine / "saved").read_text() == "50000"

    (project.root / "done").touch()
    assert project.run()[0].status == "done"
    assert project.results()["data/result.json"] == b"50000" * 2, "the second run has resumed"
    assert {path.name for path in checkpoints.iterdir()} == {"01_good-wide"}

    project.edit("01_good", "runs: int = 50_000", "runs: int = 7")
    assert project.run()[0].status == "done"
    assert project.results()["data/result.json"] == b"7"


# --- the command ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--set", "runs"], "runs is not of the form NAME=VALUE"),
        (["--profile", "fast"], "invalid choice: 'fast'"),
    ],
)
def test_a_wrong_command_is_a_short_error(capsys, arguments, message):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["figures", *arguments])
    assert exit_.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.splitlines()[-1]) < 300


@pytest.mark.parametrize("option", ["--dask", "--build"])
def test_a_long_value_is_not_repeated_whole(project, monkeypatch, capsys, option):
    monkeypatch.chdir(project.add("good").root)
    assert cli.main(["figures", option, "x" * 5000]) == 2
    said = capsys.readouterr().err
    assert said.startswith("robsmooth: ")
    assert len(said) < 650


def test_a_wrong_request_is_one_line_and_exit_code_2(project, monkeypatch, capsys):
    monkeypatch.chdir(project.add("good").root)
    assert cli.main(["figures", "--set", "runs=0.5"]) == 2
    message = "robsmooth: --set for 01_good: runs must be of type int, got 0.5 (float)\n"
    assert capsys.readouterr().err == message


def test_outside_the_project_the_command_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figures"]) == 2
    assert "no notebooks/profiles.toml here or above" in capsys.readouterr().err


@pytest.mark.parametrize("sign", "-([{9")
def test_a_long_value_of_set_is_one_short_sentence(project, monkeypatch, capsys, sign):
    monkeypatch.chdir(project.add("good").root)
    assert cli.main(["figures", "--set", f"runs={200_000 * sign}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("robsmooth: --set for 01_good: runs must be ")
    assert len(line) < 200
    with pytest.raises(SystemExit):
        cli.main(["figures", "--set", 200_000 * sign])
    assert len(capsys.readouterr().err) < 1000


@pytest.mark.parametrize(
    "text, value",
    [("runs=5", 5), ("lag=1e-6", 1e-6), ("check=false", False), ("profile=quick", "quick")],
)
def test_set_reads_values_as_python_writes_them(text, value):
    assert cli._setting(text) == (text.partition("=")[0], value)


def test_the_folder_to_work_in_is_named_from_where_the_command_is_given(project, monkeypatch):
    project.add("good")
    monkeypatch.chdir(project.root)
    monkeypatch.setattr(cli, "_write_report", lambda run: None)
    assert cli.main(["figures", "--profile", "quick", "--build", "elsewhere"]) == 0
    assert (project.root / "elsewhere" / "quick" / "data" / "result.json").is_file()
