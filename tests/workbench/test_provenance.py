import getpass
import hashlib
import json
import platform
import shutil
import subprocess
import time
from importlib import metadata

import pytest

from robsmooth.workbench import provenance
from tests.helpers.waiting import PATIENCE

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(folder, *arguments):
    who = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    subprocess.run(["git", "-C", folder, *who, *arguments], check=True, capture_output=True)


def test_provenance_is_written_beside_the_result(tmp_path):
    started = time.perf_counter() - 2
    path = provenance.write(tmp_path / "fig4.pdf", seed=7, started=started, runs=50_000)
    assert path == tmp_path / "fig4.provenance.json"
    about = json.loads(path.read_text())
    assert about["seed"] == 7
    assert about["runs"] == 50_000
    assert 2 <= about["run_time_seconds"] < PATIENCE
    assert about["versions"]["python"] == platform.python_version()
    assert about["versions"]["numpy"] == metadata.version("numpy")
    assert None not in about["versions"].values()
    assert about["machine"]["cores"] >= 1
    lock = (provenance.ROOT / "requirements.lock").read_bytes()
    assert about["lock_sha256"] == hashlib.sha256(lock).hexdigest()


def test_provenance_names_no_person_and_no_place():
    text = json.dumps(provenance.collect())
    assert str(provenance.ROOT) not in text
    assert "/home/" not in text
    assert len(platform.node()) < 4 or platform.node() not in text
    assert len(getpass.getuser()) < 4 or getpass.getuser() not in text


@needs_git
def test_the_revision_is_dirty_only_where_a_source_differs(tmp_path):
    git(tmp_path, "init")
    assert provenance.revision(tmp_path) is None
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    clean = provenance.revision(tmp_path)
    assert len(clean["commit"]) == 40
    assert clean["dirty"] is False
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "fig4.pdf").touch()
    assert provenance.revision(tmp_path) == clean
    (tmp_path / "pyproject.toml").write_text("[tool]\n")
    assert provenance.revision(tmp_path) == {**clean, "dirty": True}


@needs_git
def test_a_folder_of_another_project_has_no_revision(tmp_path):
    git(tmp_path, "init")
    git(tmp_path, "commit", "--allow-empty", "-m", "first")
    (tmp_path / "site-packages").mkdir()
    assert provenance.revision(tmp_path / "site-packages") is None


def test_there_is_no_revision_without_git(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert provenance.revision() is None
