"""The environment's locks, and what make does with them."""

import os
import re
import stat
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ("requirements.lock", "requirements-dev.lock", "requirements-uv.lock")


def pinned(lock):
    """Names, and what is locked of each: its version with markers, and its hashes."""
    entries = re.split(r"\n(?=\S)", (ROOT / lock).read_text())
    lines = [re.sub(r"\n\s*#.*", "", entry) for entry in entries if not entry.startswith("#")]
    return {re.match(r"[\w.-]+", line)[0]: line.strip() for line in lines}


def names(requirements):
    """Of packages elsewhere; what includes another group has none."""
    asked = [Requirement(each).name for each in requirements if isinstance(each, str)]
    return set(asked) - {"robsmooth"}


def make(*arguments):
    environment = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    command = ["make", "--no-print-directory", *arguments]
    run = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    return run.stdout


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_is_exact_and_hashed_and_names_no_place(lock):
    assert pinned(lock)
    for entry in pinned(lock).values():
        assert re.match(r"[\w.-]+==[\w.]+", entry)
        assert "--hash=sha256:" in entry
    text = (ROOT / lock).read_text()
    assert "://" not in text
    assert "/" not in text.replace("\\\n", "")
    assert "--index" not in text


def test_a_development_environment_holds_the_run_environment():
    assert pinned("requirements-dev.lock").items() >= pinned("requirements.lock").items()


def test_the_locks_hold_what_the_project_asks_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    groups, extras = project["dependency-groups"], project["project"]["optional-dependencies"]
    library = names(project["project"]["dependencies"] + groups["build"])
    notebooks = names(extras["notebooks"] + extras["control"] + extras["plot"])
    development = names(groups["dev"] + groups["test"] + extras["cluster"])
    assert library | notebooks <= pinned("requirements.lock").keys()
    assert development <= pinned("requirements-dev.lock").keys()
    assert not development & pinned("requirements.lock").keys()


def test_the_locks_hold_no_version_that_the_project_does_not_allow():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    for requirement in map(Requirement, asked):
        if requirement.name != "robsmooth":
            entry = pinned("requirements-dev.lock")[requirement.name]
            assert re.match(r"[\w.-]+==([\w.]+)", entry)[1] in requirement.specifier


def test_make_alone_lists_every_target():
    listed = set(re.findall(r"^  ([a-z-]+) ", make(), flags=re.MULTILINE))
    assert listed > {"setup", "figures", "test", "test-browser", "lab", "clean", "help"}
    for target in listed:
        assert f"\n{target}:" in (ROOT / "Makefile").read_text()


def test_make_figures_hands_on_its_variables():
    assert make("-n", "figures").endswith("robsmooth figures --profile 'paper'  \n")
    chosen = make("-n", "figures", "PROFILE=quick", "ONLY=03", "DASK=tcp://host:1")
    wanted = "robsmooth figures --profile 'quick' --only '03' --dask 'tcp://host:1'\n"
    assert chosen.endswith(wanted)


def test_make_lab_changes_nothing_of_jupyters_security_but_for_root(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    for user, said in (("0", "--allow-root"), ("1000", "")):
        (tmp_path / "id").write_text(f"#!/bin/sh\necho {user}\n")
        (tmp_path / "id").chmod(0o755)
        command = make("-n", "lab", "LAB=--port=9000").split(".venv/bin/jupyter lab")[1]
        assert command.replace("\\", "").split() == [*said.split(), "--port=9000", "notebooks"]


def test_ci_runs_the_tests():
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & stat.S_IXUSR
    assert script.read_text().splitlines()[-1] == "make test"
    assert "run: .ci/run" in (ROOT / ".github/workflows/ci.yml").read_text()


def test_ci_runs_actions_by_their_commits_and_once_for_a_push():
    workflow = (ROOT / ".github/workflows/ci.yml").read_text()
    actions = re.findall(r"uses: (\S+)", workflow)
    assert actions
    for action in actions:
        assert re.fullmatch(r"actions/[\w-]+@[0-9a-f]{40}", action)
    assert "push:\n    branches: [main]\n  pull_request:\n" in workflow
    assert "cancel-in-progress: true" in workflow


def test_ci_looks_for_known_faults_of_all_that_is_locked_and_installed():
    workflow = (ROOT / ".github/workflows/ci.yml").read_text()
    (command,) = re.findall(r"pip-audit==[\d.]+ pip-audit ([^\n]+\n[^\n]+)", workflow)
    for lock in ("requirements.lock", "requirements-dev.lock", "requirements-uv.lock"):
        assert (ROOT / lock).exists()
        assert f"-r {lock}" in command


def test_ci_tests_the_lowest_and_the_newest_versions_of_every_python():
    workflow = (ROOT / ".github/workflows/ci.yml").read_text()
    assert "make test-library PYTHON=python RESOLUTION=lowest-direct" in workflow
    assert "make test-library PYTHON=python RESOLUTION=highest" in workflow
    (newest,) = re.findall(r"python: \[(.*)\]", workflow)
    assert newest == ", ".join(f'"3.{minor}"' for minor in (11, 12, 13, 14))
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"] == (
        ">=3.11"
    )


@pytest.fixture
def bare_machine(tmp_path, monkeypatch):
    """A folder of programs that is all there is, and what looks for a chromium there."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CHROMIUM", raising=False)

    def provide(name, script):
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)

    provide("sudo", 'shift && exec "$@"')
    return provide


def look_for_chromium():
    command = [sys.executable, "-m", "tests.interface.browser.chromium"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_a_missing_browser_is_installed_by_apt(bare_machine, tmp_path):
    provide_it = f"echo '#!/bin/sh' > {tmp_path}/chromium && /bin/chmod +x {tmp_path}/chromium"
    bare_machine("apt-get", f'case "$*" in *"install "*chromium*) {provide_it};; esac')
    assert look_for_chromium().stdout == f"the browser is {tmp_path}/chromium\n"


@pytest.mark.parametrize("apt", ["exit 1", None], ids=["apt fails", "no apt"])
def test_a_browser_that_cannot_be_installed_is_asked_for_in_a_sentence(bare_machine, apt):
    if apt:
        bare_machine("apt-get", apt)
    run = look_for_chromium()
    assert run.returncode == 1
    assert run.stderr.endswith("or name one with CHROMIUM=/path/to/it\n")
    assert "Traceback" not in run.stderr


def test_a_browser_that_is_named_is_the_one(bare_machine, tmp_path, monkeypatch):
    bare_machine("chromium", "exit")
    bare_machine("mine", "exit")
    monkeypatch.setenv("CHROMIUM", str(tmp_path / "mine"))
    assert look_for_chromium().stdout == f"the browser is {tmp_path}/mine\n"
    monkeypatch.setenv("CHROMIUM", "none")
    run = look_for_chromium()
    assert run.returncode == 1
    assert run.stderr == "CHROMIUM=none is no program that can be run\n"


def test_browser_tests_say_why_they_are_skipped():
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "tests/interface/browser"]
    environment = os.environ | {"CHROMIUM": "none"}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout
    assert "CHROMIUM=none is no program that can be run" in run.stdout
    assert re.search(r"^=+ \d+ skipped in", run.stdout, flags=re.MULTILINE)
