"""The notebooks: how they are committed, what each must hold, and that all run, twice alike."""

import json
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from robsmooth.pipeline import parameters

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))
NUMBERED = sorted(ROOT.glob("notebooks/[0-9][0-9]_*.ipynb"))
OF_THE_PAPER = {
    "01_uncertainty_modelling",
    "02_smoother_design",
    "03_delta_sweep",
    "04_nonlinear_monte_carlo",
}

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
numbered_notebook = pytest.mark.parametrize("path", NUMBERED, ids=lambda path: path.stem)


def cells(path, kind):
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == kind]


def headings(path):
    lines = [line for cell in cells(path, "markdown") for line in cell.source.splitlines()]
    return [line for line in lines if line.startswith("## ")]


def test_the_notebooks_of_the_paper_are_there():
    assert {path.stem for path in NUMBERED} >= OF_THE_PAPER


@every_notebook
def test_a_notebook_is_committed_without_results(path):
    for cell in cells(path, "code"):
        assert not cell.outputs
        assert cell.execution_count is None
    assert "papermill" not in nbformat.read(path, as_version=4).metadata


def test_the_notebooks_hold_nothing_that_make_format_would_take_out():
    command = [sys.executable, "-m", "nbstripout", "--verify", "--keep-id", *NOTEBOOKS]
    assert subprocess.run(command, check=False).returncode == 0


@every_notebook
def test_a_notebook_opens_anywhere_with_the_kernel_of_its_environment(path):
    metadata = nbformat.read(path, as_version=4).metadata
    assert metadata.kernelspec.name == "python3"
    assert metadata.language_info.name == "python"


@every_notebook
def test_a_notebook_is_valid_and_its_cells_have_names_of_their_own(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    nbformat.validate(notebook)
    names = [cell["id"] for cell in notebook["cells"]]
    assert len(set(names)) == len(names)


@every_notebook
def test_a_notebook_stands_on_the_installed_package(path):
    source = "\n".join(cell.source for cell in cells(path, "code"))
    assert "sys.path" not in source
    assert "\nclass " not in source


@numbered_notebook
def test_a_notebook_can_be_given_its_parameters(path):
    assert parameters.read(path).keys() >= {"output_dir", "data_dir"}


@numbered_notebook
def test_a_notebook_has_a_title_and_ends_with_its_checks_and_what_it_was_run_with(path):
    first = nbformat.read(path, as_version=4).cells[0]
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    assert headings(path)[-2:] == ["## Checks", "## About"]


def quick_run(build):
    """Run all notebooks from the command line, with the quick profile; give what was written."""
    command = [sys.executable, "-m", "robsmooth.cli", "figures", "--profile", "quick"]
    run = subprocess.run(
        [*command, "--build", build], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return run, build / "quick"


@pytest.fixture(scope="module")
def first_run(tmp_path_factory):
    run, places = quick_run(tmp_path_factory.mktemp("first"))
    assert run.returncode == 0, run.stderr
    return places


def test_all_notebooks_run_with_the_quick_profile(first_run):
    owners = {}
    for path in NUMBERED:
        about = json.loads((first_run / "figures" / f"{path.stem}.provenance.json").read_text())
        assert about["profile"] == "quick"
        for file in about["files"]:
            assert owners.setdefault(file, path.stem) == path.stem, f"two notebooks write {file}"
    run, _ = quick_run(first_run.parent)
    assert run.stdout.count(": fresh\n") == len(NUMBERED)


def test_results_are_byte_identical_when_regenerated(first_run, tmp_path):
    run, again = quick_run(tmp_path)
    assert run.returncode == 0, run.stderr
    results = [
        path.relative_to(first_run)
        for folder in ("figures", "data")
        for path in sorted((first_run / folder).iterdir())
        if not path.name.endswith(".provenance.json")  # it holds date and run time
    ]
    assert {path.suffix for path in results} == {
        *(".pdf", ".svg", ".png"),
        *(".md", ".csv", ".tex", ".json"),
    }
    for result in results:
        old, new = (places / result for places in (first_run, again))
        assert old.read_bytes() == new.read_bytes(), f"{result} differs from run to run"
