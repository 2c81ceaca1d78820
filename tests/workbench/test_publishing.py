"""What becomes of the files that notebooks write, without the time that kernels take."""

import json
import os
import re
import signal
import subprocess
import sys
from hashlib import sha256

import pytest

from robsmooth import cli
from robsmooth._support import files
from robsmooth.workbench import runner
from robsmooth.workbench.execution import FOLDER
from tests.helpers.checkpoints import largest_file


@pytest.fixture
def write(project, monkeypatch):
    """Two notebooks, and a function of a name and of what that notebook does in its folder."""
    written = {}

    class Executed:
        def __init__(self, notebook, values, staging, time_limit):
            self.started = self.seconds = 0.0
            self.executed = staging / notebook.name
            self.executed.write_text("as executed")
            for each in written[notebook.stem]:
                each(staging)

        def finished(self):
            return True

        def failure(self):
            return ""

    def write(name, *doings):
        written[name] = doings
        notebook = project.path(name).read_text()
        project.path(name).write_text(notebook.replace("does all", "does all now"))

    monkeypatch.setattr(runner.processes, "Execution", Executed)
    # without what git says, and the time, a run is the same each time
    monkeypatch.setattr(runner.provenance, "collect", lambda **about: {"files": about["files"]})
    project.add("good", "good")
    write("01_good", file("figures/1.txt"))
    write("02_good", file("figures/2.txt"))
    return write


def file(name, content="old"):
    """Write a file, in the folder that is given later."""

    def doing(folder):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)

    return doing


def statuses(results):
    return [result.status for result in results]


def published(project, name):
    """The files in a provenance, each of which is there as it says; nothing where there is none."""
    path = project.root / "figures" / f"{name}.provenance.json"
    digests = json.loads(path.read_text())["files"] if path.exists() else {}
    for each, digest in digests.items():
        assert sha256((project.root / each).read_bytes()).hexdigest() == digest
    return {each: (project.root / each).read_text() for each in digests}


# --- one notebook does not end the others --------------------------------------------------------

NO_NAME = "is not a regular file with a name of printable signs"
BAD = {
    "not UTF-8": (lambda to: os.mkfifo(os.fsencode(to) + b"/data/fig\xff"), NO_NAME),
    "two lines": (file("figures/two\nlines"), NO_NAME),
    "a link": (lambda to: (to / "data/link").symlink_to("/etc/hostname"), NO_NAME),
    "a link to a folder": (lambda to: (to / "data/link").symlink_to("/etc"), NO_NAME),
    "a pipe": (lambda to: os.mkfifo(to / "data/pipe"), NO_NAME),
    "the runner's own suffix": (file("data/a.unpublished"), NO_NAME),
    "an input": (file("data/published.toml"), "published.toml is an input of the notebooks"),
    "its own provenance": (file("figures/02_good.provenance.json"), "is the provenance of 02_good"),
    "a file of another": (file("figures/1.txt"), "figures/1.txt is a file of 01_good"),
    "a folder that is there": (file("figures/folder"), "figures/folder is a folder"),
    "a file that is there": (file("figures/2.txt/inside"), "(File exists|Not a directory): "),
    "a long name": (file(f"figures/{'a' * 250}"), "File name too long: "),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_notebook_whose_files_cannot_be_published_fails_alone(project, write, kind):
    (project.root / "figures/folder").mkdir(parents=True)
    (project.root / "data").mkdir()
    (project.root / "data/published.toml").write_text("V = 0.15")
    assert statuses(project.run()) == ["done", "done"]
    before = project.results()
    bad, message = BAD[kind]
    write("01_good", file("figures/1.txt", "new"))
    write("02_good", file("figures/new.txt", "new"), bad)
    good, failed = project.run()
    assert (good.status, failed.status) == ("done", "failed")
    assert failed.failure.startswith("its files were not published: ")
    assert re.search(message, failed.failure)
    assert published(project, "01_good") == {"figures/1.txt": "new"}
    mine = {"figures/1.txt", "figures/01_good.provenance.json"}
    after = project.results()
    assert {each: after[each] for each in after.keys() - mine} == {
        each: before[each] for each in before.keys() - mine
    }


def test_a_notebook_that_cannot_be_started_fails_alone(project, write):
    def full(_):
        raise OSError(28, "No space left on device")

    write("01_good", full)
    first, second = project.run()
    assert first.failure == "it could not be started: [Errno 28] No space left on device"
    assert second.status == "done"


def test_what_changes_an_input_fails(project, write):
    (project.root / "data").mkdir()
    (project.root / "data/published.toml").write_text("V = 0.15")
    write("01_good", lambda _: (project.root / "data/published.toml").write_text("V = 0.16"))
    (failed,) = project.run(only=["01"])
    assert failed.status == "failed"
    assert "what they depend on changed in the meantime" in failed.failure


def test_two_notebooks_that_write_one_file_are_refused_also_in_runs_of_one(project, write):
    assert statuses(project.run(only=["01"])) == ["done"]
    write("02_good", file("figures/1.txt", "of the second"))
    (refused,) = project.run(only=["02"])
    assert refused.status == "failed"
    assert refused.failure.endswith("figures/1.txt is a file of 01_good")
    assert published(project, "01_good") == {"figures/1.txt": "old"}
    write("01_good", file("figures/other.txt"))  # a figure moves to the other notebook
    assert statuses(project.run()) == ["done", "done"]
    assert published(project, "02_good") == {"figures/1.txt": "of the second"}


# --- all or nothing ------------------------------------------------------------------------------

OLD = {"figures/a.txt": "old", "figures/b.txt": "old", "data/gone.txt": "old"}
NEW = {"figures/a.txt": "new", "figures/b.txt": "new", "data/c.txt": "new"}


def write_all(write, contents):
    write("01_good", *(file(each, content) for each, content in contents.items()))


def assert_the_next_run_is_as_if_nothing_had_been(project):
    (result,) = project.run(only=["01"])
    assert result.status == "done"
    assert published(project, "01_good") == NEW
    assert project.results().keys() == {*NEW, "figures/01_good.provenance.json"}
    assert not [*project.root.rglob("*.unpublished")]


def test_a_disk_that_fills_while_publishing_leaves_the_earlier_results(project, write, monkeypatch):
    write_all(write, OLD)
    project.run(only=["01"])
    write_all(write, NEW)
    before, sizes, publish = project.results(), range(10, 2000, 50), runner._publish
    for size in sizes:

        def limited(*arguments, size=size):
            with largest_file(size):
                return publish(*arguments)

        monkeypatch.setattr(runner, "_publish", limited)
        (result,) = project.run(only=["01"])
        if result.status == "done":
            break
        assert "File too large" in result.failure
        assert project.results() == before
    assert sizes[0] < size < sizes[-1]
    assert published(project, "01_good") == NEW


def kill_at_change(project, number):
    """Run in a process that is killed as it changes the results' folders for the n-th time."""
    if child := os.fork():
        return os.waitpid(child, 0)[1] == signal.SIGKILL
    changes, watched = iter(range(number)), {"os.rename", "os.remove"}

    def hook(event, arguments):
        if event in watched and "staging" not in str(arguments) and next(changes, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    project.run(only=["01"])
    os._exit(0)


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_reader_of_the_provenance_sees_all_or_nothing_whenever_the_run_is_killed(project, write):
    write_all(write, OLD)
    project.run(only=["01"])
    seen, number = [], 0
    while True:
        write_all(write, NEW)
        if not kill_at_change(project, number):
            break
        seen.append(published(project, "01_good"))
        assert seen[-1] in (OLD, {}, NEW)
        assert_the_next_run_is_as_if_nothing_had_been(project)
        write_all(write, OLD)
        project.run(only=["01"])
        number += 1
    assert all(each in seen for each in (OLD, {}, NEW))
    assert number > 8


# --- what a record may say -----------------------------------------------------------------------


@pytest.mark.parametrize("place", ["data/published.toml", "keep.txt", "elsewhere/keep.txt"])
@pytest.mark.parametrize(
    "path", ["{0}", "figures/../{0}", "data/../{0}", "./{0}", "figures/link/{0}", "{root}/{0}"]
)
def test_no_path_of_a_stamp_reaches_what_is_not_of_its_notebook(project, write, path, place):
    kept = project.root / place
    for folder in (kept.parent, project.root / "figures"):
        folder.mkdir(exist_ok=True)
    kept.write_text("precious")
    (project.root / "figures/link").symlink_to(project.root)
    assert statuses(project.run(only=["01"])) == ["done"]
    stamp = project.root / "build/paper/stamps/01_good.json"
    stored = json.loads(stamp.read_text())
    named = path.format(place, root=project.root)
    stored["files"][named] = sha256(b"precious").hexdigest()
    stamp.write_text(json.dumps(stored))
    assert statuses(project.run(only=["01"])) == ["done"], "a stamp that cannot be is not fresh"
    assert kept.read_text() == "precious"


@pytest.mark.parametrize(
    "text", ["[]", "{}", '{"key": 1, "files": {}}', '{"key": "", "files": ["figures/1.txt"]}']
)
def test_a_damaged_stamp_is_none(project, write, text):
    project.run()
    (project.root / "build/paper/stamps/01_good.json").write_text(text)
    assert statuses(project.run()) == ["done", "fresh"]


def test_what_someone_has_changed_is_not_removed(project, write):
    write("01_good", file("figures/1.txt"), file("figures/touched.txt"), file("figures/gone.txt"))
    project.run(only=["01"])
    (project.root / "figures/touched.txt").write_text("by hand")
    write("01_good", file("figures/1.txt"))
    project.run(only=["01"])
    assert project.results().keys() - {"figures/01_good.provenance.json"} == {
        "figures/1.txt",
        "figures/touched.txt",
    }


# --- runs beside and after one another -----------------------------------------------------------


def test_runs_that_write_to_the_papers_figures_share_a_lock(project, write):
    with files.exclusive_lock(project.root / "build/paper/lock"):
        for build in ("a", "b"):
            with pytest.raises(BlockingIOError, match="is in use by another run"):
                project.run(build=project.root / build)
        assert statuses(project.run(profile="quick", build=project.root / "a")) == ["done", "done"]
    assert statuses(project.run(build=project.root / "a")) == ["done", "done"]


def test_a_run_ends_and_removes_what_an_earlier_one_left(project, write):
    staging = project.root / "build/paper/staging/01_good.before"
    staging.mkdir(parents=True)
    (project.root / "figures").mkdir()
    (project.root / "figures/half.pdf.unpublished").touch()
    environment = os.environ | {FOLDER: str(staging / "jupyter")}
    program = [sys.executable, "-c", "import time; time.sleep(3600)"]
    with subprocess.Popen(program, env=environment) as left:
        assert statuses(project.run()) == ["done", "done"]
        assert left.wait() == -signal.SIGKILL
    assert not staging.parent.exists()
    assert not [*project.root.rglob("*.unpublished")]


@pytest.mark.parametrize("build", ["/dev/null", "/proc/nowhere", "figures"])
def test_a_folder_that_is_of_no_use_is_one_sentence(project, write, build, monkeypatch, capsys):
    (project.root / "figures/quick/lock").mkdir(parents=True)  # which makes the third of them one
    monkeypatch.chdir(project.root)
    assert cli.main(["figures", "--profile", "quick", "--build", build]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(f"{build}|lock cannot be locked: ", line)
