"""The environment's locks, and what make does with them."""

import os
import re
import stat
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LOCKS = ("requirements.lock", "requirements-dev.lock", "requirements-uv.lock")


def pinned(lock):
    """Names, and what is locked of each: its version with markers, and its hashes."""
    entries = re.split(r"\n(?=\S)", (ROOT / lock).read_text())
    lines = [re.sub(r"\n\s*#.*", "", entry) for entry in entries if not entry.startswith("#")]
    return {re.match(r"[\w.-]+", line)[0]: line.strip() for line in lines}


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
    groups = project["dependency-groups"]
    run = project["project"]["dependencies"] + groups["build"]
    assert set(run) <= pinned("requirements.lock").keys()
    assert set(groups["dev"]) <= pinned("requirements-dev.lock").keys()
    assert not set(groups["dev"]) & pinned("requirements.lock").keys()


def test_make_alone_lists_every_target():
    listed = set(re.findall(r"^  ([a-z]+) ", make(), flags=re.MULTILINE))
    assert listed > {"setup", "figures", "test", "lab", "clean", "help"}
    for target in listed:
        assert f"\n{target}:" in (ROOT / "Makefile").read_text()


def test_make_figures_hands_on_its_variables():
    assert make("-n", "figures").endswith("robsmooth figures --profile 'paper'  \n")
    chosen = make("-n", "figures", "PROFILE=quick", "ONLY=03", "DASK=tcp://host:1")
    wanted = "robsmooth figures --profile 'quick' --only '03' --dask 'tcp://host:1'\n"
    assert chosen.endswith(wanted)


def test_ci_runs_the_tests():
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & stat.S_IXUSR
    assert script.read_text().splitlines()[-1] == "make test"
    assert "run: .ci/run" in (ROOT / ".github/workflows/ci.yml").read_text()
