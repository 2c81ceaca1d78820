"""What a notebook depends on, found in the code: an edit runs again what it can change, no more."""

import shutil
from pathlib import Path

import nbformat
import pytest

import robsmooth
from robsmooth.workbench import dependencies, runner

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = {path.stem: path for path in ROOT.glob("notebooks/*.ipynb")}
MODULES = dependencies.modules_in(Path(robsmooth.__file__).parent)


def found(code):
    return dependencies.dependencies(code, MODULES)


@pytest.fixture
def keys(tmp_path, monkeypatch):
    """A function that edits a module of a copy of the package, and tells which keys change."""
    package = tmp_path / "robsmooth"
    shutil.copytree(ROOT / "robsmooth", package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(runner, "PACKAGE", package)

    def plan():
        return {task.name: task.key for task in runner.plan(runner.Request(ROOT))}

    def changed(module):
        before, path = plan(), package / module
        path.write_text(path.read_text() + "\n")
        after = plan()
        return {name for name in before if before[name] != after[name]}

    return changed


def test_an_edit_runs_only_the_notebooks_that_import_it_again(keys):
    assert keys("explorer/panels.py") == {"explore"}
    simulated = keys("homodyne/montecarlo/splitting.py")
    assert {"04_nonlinear_monte_carlo", "07_where_smoothing_pays"} <= simulated
    assert not simulated & {"01_uncertainty_modelling", "02_smoother_design", "03_delta_sweep"}
    assert not simulated & {"05_which_smoother", "06_your_own_system"}
    for module in ("_support/validation.py", "__init__.py", "workbench/execution.py"):
        assert keys(module) == {*NOTEBOOKS}


@pytest.mark.parametrize(
    "code, module",
    [
        ("import robsmooth.io.records", "robsmooth.io.records"),
        ("from robsmooth.analysis import lag", "robsmooth.analysis.lag"),
        ("from robsmooth.analysis.lag import best_lag", "robsmooth.analysis.lag"),
        ("import robsmooth as x\nx.best_lag", "robsmooth.analysis.lag"),
        ("import robsmooth\nrobsmooth.baselines.ngcf", "robsmooth.estimators.baselines"),
        ("from robsmooth import monte_carlo", "robsmooth.homodyne.montecarlo.run"),
        ("def f():\n    from robsmooth import workbench", "robsmooth._support.cluster"),
    ],
)
def test_each_form_of_import_is_followed(code, module):
    assert module in found(code)
    assert "robsmooth.explorer" not in found(code)
    while module != "robsmooth":
        module = module.rpartition(".")[0]
        assert module in found(code), "a package is imported before what is in it"


@pytest.mark.parametrize(
    "code",
    [
        "%run other.py",
        "import robsmooth as rs\ngetattr(rs, name)",
        "from robsmooth import *",
        "import robsmooth as rs\nrs.nothing",
        "import importlib\nimportlib.import_module(name)",
        "from robsmooth.analysis import lag\nexec(code)",
    ],
)
def test_what_cannot_be_told_counts_as_everything(code):
    assert found(code) == {*MODULES}


def test_code_without_the_package_depends_on_its_root_alone():
    assert found("import numpy as np\nnp.linalg.norm([1.0])") == {"robsmooth"}


@pytest.mark.parametrize("name", sorted(NOTEBOOKS))
def test_what_a_notebook_says_it_imports_is_found(name):
    cells = nbformat.read(NOTEBOOKS[name], as_version=4).cells
    code = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    assert {"robsmooth.paper.report", "robsmooth._support.tables"} <= found(code)
