"""The runner, tried on notebooks that are good and on ones that are broken in every known way."""

import json
import math
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import nbformat
import psutil
import pytest

from robsmooth import cli
from robsmooth._support import files
from robsmooth.workbench import parameters, runner
from robsmooth.workbench.execution import Execution
from robsmooth.workbench.parameters import PipelineError
from robsmooth.workbench.runner import Request
from tests.helpers.clusters import cluster_of_threads
from tests.helpers.waiting import PATIENCE, wait_until

FIXTURES = Path(__file__).parent / "notebooks"


class Project:
    """A project folder with some of the fixture notebooks, listed in its profiles.toml."""

    def __init__(self, root):
        self.root = root
        self.profiles = ""
        (root / "notebooks").mkdir()

    def add(self, *fixtures):
        for fixture in fixtures:
            number = 1 + len(list(self.root.glob("notebooks/*.ipynb")))
            shutil.copy(FIXTURES / f"{fixture}.ipynb", self.path(f"{number:02}_{fixture}"))
        self.write_profiles()
        return self

    def write_profiles(self, text=""):
        names = sorted(path.stem for path in self.root.glob("notebooks/*.ipynb"))
        listed = f"notebooks = {json.dumps(names)}\n"
        (self.root / "notebooks" / "profiles.toml").write_text(listed + text)

    def path(self, name):
        return self.root / "notebooks" / f"{name}.ipynb"

    def edit(self, name, old, new):
        source = self.path(name).read_text()
        assert old in source
        self.path(name).write_text(source.replace(old, new))

    def edit_code(self, name, old, new):
        """Replace in the code of a notebook, written as it stands in a cell."""
        notebook = nbformat.read(self.path(name), as_version=4)
        cells = [cell for cell in notebook.cells if old in cell.source]
        assert len(cells) == 1
        cells[0].source = cells[0].source.replace(old, new)
        nbformat.write(notebook, self.path(name))

    def add_optional(self, name):
        """Give a notebook the parameters that the pipeline sets where they are there."""
        defaults = {"str": '""', "bool": "False"}
        lines = [
            f"{each}: {kind} = {defaults[kind]}  # may be there"
            for each, kind in parameters.OPTIONAL.items()
        ]
        self.edit_code(name, "scale: str", "\n".join([*lines, "scale: str"]))

    def run(self, **options):
        request = Request(self.root, **options)
        results = runner.run_notebooks(request, runner.plan(request))
        return sorted(results, key=lambda result: result.task.name)

    def key(self, **options):
        return self.plan(**options)[0].key

    def plan(self, **options):
        return runner.plan(Request(self.root, **options))

    def results(self):
        """Every file in the places of the paper's results, with its content."""
        folders = [self.root / "figures", self.root / "data"]
        files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
        return {path.relative_to(self.root).as_posix(): path.read_bytes() for path in files}


@pytest.fixture
def project(tmp_path, monkeypatch):
    package = tmp_path / "package" / "robsmooth"
    package.mkdir(parents=True)
    (package / "model.py").touch()
    monkeypatch.setattr(runner, "PACKAGE", package)
    return Project(tmp_path)


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
    with pytest.raises(PipelineError, match=r"01_good.ipynb: not a readable .*No such file"):
        project.plan()


def test_an_unlisted_notebook_is_an_error(project):
    project.add("good")
    shutil.copy(project.path("01_good"), project.path("02_extra"))
    with pytest.raises(PipelineError, match=r"notebooks/02_extra.ipynb is not listed"):
        project.plan()


@pytest.mark.parametrize("content", ["", '{"cells": [', "[]", "{}", "5"])
def test_a_damaged_notebook_is_an_error(project, content):
    project.add("good")
    project.path("01_good").write_text(content)
    with pytest.raises(PipelineError, match=r"01_good.ipynb: not a readable notebook"):
        project.plan()


def test_damaged_profiles_are_an_error(project):
    project.add("good").write_profiles("[quick.01_good\n")
    with pytest.raises(PipelineError, match=r"profiles.toml cannot be read"):
        project.plan()


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
        ("[quick.01_god]\nruns = 3\n", r"\[quick\]: notebook 01_god is unknown; known: 01_good"),
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
        ({"time_limit": math.nan}, "time_limit must be a positive number of seconds, .*not nan"),
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

    assert cli.main([*command, "02,03,04,06", "--time-limit", "20"]) == 1
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


def test_an_interrupt_ends_everything_and_says_what_is_kept(project):
    project.add("hanging_cell")
    command = [sys.executable, "-m", "robsmooth", "figures"]
    # what a shell runs in the background ignores the signal, and so would what these tests start
    heeded = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    streams = {"stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, cwd=project.root, preexec_fn=heeded, **streams)
    wait_until(lambda: len(pids(project)) == 2)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "interrupted; notebooks that had finished are kept" in said
    assert_ended(project)
    assert project.results() == {}


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
        ("tcp://127.0.0.1:1", "--dask: no Dask scheduler answers at tcp://127.0.0.1:1 within 5 s"),
        ("http://127.0.0.1:80", "--dask: no Dask scheduler answers at http://127.0.0.1:80"),
        ("tcp://10.0.0.1:80", "--dask: what answers at tcp://10.0.0.1:80 could run code here"),
    ],
)
def test_a_cluster_that_is_not_there_is_one_line_before_anything_runs(
    project, monkeypatch, capsys, address, message
):
    monkeypatch.chdir(project.add("good").root)
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
def test_a_wrong_command_is_an_error(capsys, arguments, message):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["figures", *arguments])
    assert exit_.value.code == 2
    assert message in capsys.readouterr().err


def test_a_wrong_request_is_one_line_and_exit_code_2(project, monkeypatch, capsys):
    monkeypatch.chdir(project.add("good").root)
    assert cli.main(["figures", "--set", "runs=0.5"]) == 2
    message = "robsmooth: --set for 01_good: runs must be of type int, got 0.5 (float)\n"
    assert capsys.readouterr().err == message


def test_outside_the_project_the_command_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figures"]) == 2
    assert "no notebooks/profiles.toml here or above" in capsys.readouterr().err


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
