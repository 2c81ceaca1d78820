"""The notebooks: how they are committed, what each must hold, and that all run, twice alike."""

import inspect
import json
import os
import subprocess
import sys
from functools import cached_property
from pathlib import Path

import nbformat
import pytest

import robsmooth as rs
from robsmooth.workbench import parameters
from tests.helpers.public import PUBLIC
from tests.helpers.runs import quick
from tests.helpers.site import read_pages

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))
NUMBERED = sorted(ROOT.glob("notebooks/[0-9][0-9]_*.ipynb"))
OF_THE_PAPER = {
    "01_uncertainty_modelling",
    "02_smoother_design",
    "03_delta_sweep",
    "04_nonlinear_monte_carlo",
}

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


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


@every_notebook
def test_a_notebook_can_be_given_its_parameters(path):
    assert parameters.read(path).keys() >= {"output_dir", "data_dir"}


@every_notebook
def test_a_notebook_has_a_title_and_ends_with_its_checks_and_what_it_was_run_with(path):
    first = nbformat.read(path, as_version=4).cells[0]
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    assert headings(path)[-2:] == ["## Checks", "## About"]


def test_all_notebooks_run_with_the_quick_profile(first_run):
    owners = {}
    for path in NOTEBOOKS:
        about = json.loads((first_run / "figures" / f"{path.stem}.provenance.json").read_text())
        assert about["profile"] == "quick"
        for file in about["files"]:
            assert owners.setdefault(file, path.stem) == path.stem, f"two notebooks write {file}"
    run = quick("robsmooth", "figures", build=first_run.parent)
    assert run.stdout.count(": fresh\n") == len(NOTEBOOKS)


def test_results_print_as_tables_and_not_as_dumps(first_run):
    for path in NOTEBOOKS:
        for cell in cells(first_run / "notebooks" / path.name, "code"):
            for output in cell.outputs:
                where = f"{path.stem}, {cell.id}"
                if output.output_type == "stream":
                    assert output.name == "stdout", f"{where}: a warning or a progress bar"
                elif output.data.keys() == {"text/plain"}:
                    text = output.data["text/plain"]
                    assert len(text) < 400 and "array(" not in text, where


def test_the_explorer_is_an_image_where_nobody_could_move_its_sliders(first_run):
    executed = first_run / "notebooks" / "explore.ipynb"
    (output,) = next(cell for cell in cells(executed, "code") if "Explorer(" in cell.source).outputs
    assert output.data.keys() == {"image/png", "text/plain"}
    assert "widgets" not in nbformat.read(executed, as_version=4).metadata


def test_results_are_byte_identical_when_regenerated_in_other_processes(first_run, tmp_path):
    """All in one process, without kernels, and with other hashes: sets have another order."""
    environment = os.environ | {"MPLBACKEND": "agg", "IPYTHONDIR": str(tmp_path / "ipython")}
    environment |= {"OPENBLAS_NUM_THREADS": "1", "TQDM_DISABLE": "1", "PYTHONHASHSEED": "1"}
    again = tmp_path / "again"
    again.mkdir()
    command = [sys.executable, "-m", "tests.helpers.replay", again]
    how = {"capture_output": True, "text": True, "check": False}
    run = subprocess.run(command, cwd=ROOT, env=environment, **how)
    assert run.returncode == 0, run.stderr
    results = [
        path.relative_to(first_run)
        for folder in ("figures", "data")
        for path in sorted((first_run / folder).iterdir())
        if not path.name.endswith(".provenance.json")  # it holds date and run time
    ]
    assert {path.suffix for path in results} == {
        *(".pdf", ".svg", ".png"),
        *(".md", ".csv", ".json"),
    }
    for result in results:
        old, new = (places / result for places in (first_run, again))
        assert old.read_bytes() == new.read_bytes(), f"{result} differs from run to run"


# --- the site, from the same run -----------------------------------------------------------------


@pytest.fixture(scope="module")
def site(site_folder):
    """The pages of the site."""
    return read_pages(site_folder)


def test_the_site_shows_every_notebook_and_loads_files_of_its_own_only(site, first_run):
    assert site.keys() >= {f"notebooks/{path.stem}.html" for path in NOTEBOOKS}
    for name, page in site.items():
        assert page.loaded
        for address in page.loaded:
            file, _ = page.target(address)
            assert file.is_relative_to(first_run.resolve() / "site"), f"{name} loads {address}"
            assert file.is_file(), f"{name} loads {address}"


def test_every_image_of_the_site_has_words_that_say_what_it_shows(site):
    images = [image for page in site.values() for image in page.images]
    assert len(images) > 30
    for source, words in images:
        assert len(words.split()) > 3 and "_images" not in words, source


def test_the_site_does_not_say_where_it_was_made(site, first_run):
    for path in first_run.joinpath("site").rglob("*"):
        if path.suffix in {".html", ".ipynb", ".json", ".js"}:
            text = path.read_text(encoding="utf-8")
            assert str(first_run.parent) not in text, path
            assert f"{ROOT}/" not in text, path


def test_every_link_of_the_site_leads_somewhere(site):
    anchors = {page.path: {*page.anchors, ""} for page in site.values()}
    for name, page in site.items():
        for address in page.links:
            if address.startswith("https://"):
                continue
            file, anchor = page.target(address)
            assert file.is_file(), f"{name} leads to {address}"
            assert anchor in anchors.get(file, {anchor}), f"{name} leads to {address}"


def test_every_public_name_and_method_has_one_entry_in_the_api(site):
    entries = [a for name, page in site.items() if name.startswith("api/") for a in page.anchors]
    for name, member in PUBLIC.items():
        homodyne = member.__module__.startswith("robsmooth.homodyne")
        module = "robsmooth.homodyne" if homodyne else member.__module__
        entry = f"{'robsmooth' if name in rs.__all__ else module}.{name}"
        assert entries.count(entry) == 1, entry
        for method, value in vars(member).items() if inspect.isclass(member) else ():
            described = inspect.isroutine(value) or isinstance(value, property | cached_property)
            if described and not method.startswith("_"):
                assert entries.count(f"{entry}.{method}") == 1, f"{entry}.{method}"


def test_every_result_is_in_the_index_with_what_made_it(site, first_run):
    index, print_size = site["results.html"], site["print.html"]
    words = " ".join("".join(index.words).split())
    linked = {Path(link).name for link in index.links}
    shown = {Path(image).name for image in print_size.loaded}
    small = {Path(image).name for image in site["gallery.html"].loaded}
    for path in NOTEBOOKS:
        about = json.loads((first_run / "figures" / f"{path.stem}.provenance.json").read_text())
        only = path.stem[:2] if path in NUMBERED else path.stem
        assert f"make figures ONLY={only} PROFILE=quick" in words
        assert f"{about['run_time_seconds']:.1f} s, on {about['written'][:10]}" in words
        files = {Path(file).name for file in about["files"]}
        assert {file for file in files if not file.endswith((".md", "provenance.json"))} <= linked
        assert {file for file in files if file.endswith(".png")} <= shown & small
        tables = {file.removesuffix(".md") for file in files if file.endswith(".md")}
        assert {f"table-{name.replace('_', '-')}" for name in tables} <= {
            *site["tables.html"].anchors
        }


def test_what_docstrings_and_verdicts_quote_leads_to_the_equations(site):
    for name, anchor in (
        ("api/design.html", "eqbound"),
        ("api/design.html", "assumption-2"),
        ("api/systems.html", "eqcsystem"),
        ("figures/reproduction.html", "eqbound"),
    ):
        assert any(link.endswith(f"theory.html#{anchor}") for link in site[name].links)
