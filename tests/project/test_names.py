"""What `import robsmooth` gives: its names, what they cost, and what a wrong one is told."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import robsmooth as rs
from tests.project.test_package import FLOORS, MODULES, room

ROOT = Path(__file__).resolve().parents[2]
# What the extras of pyproject.toml bring, by the names that are imported, and what comes with them.
OF_EXTRAS = {
    "control",
    "distributed",
    "ipykernel",
    "ipywidgets",
    "jupyterlab",
    "matplotlib",
    "nbformat",
    "pandas",
    "papermill",
    "psutil",
    "pyarrow",
    "schemdraw",
    "voila",
}
SIDE_BY_SIDE = {"IPython", "PIL", "cloudpickle", "dask", "jupyter_client", "traitlets"}


def in_a_new_process(program):
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


def test_the_extras_are_those_that_the_library_does_without():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = {
        re.match(r"[\w-]+", entry)[0]
        for entries in extras["optional-dependencies"].values()
        for entry in entries
    }
    assert named - {"robsmooth"} == OF_EXTRAS


def test_the_library_the_command_and_the_verdicts_import_nothing_of_an_extra():
    library = [m for m in MODULES if FLOORS[room(m)] <= 5 and room(m) != "robsmooth.workbench"]
    also = ["robsmooth.cli", "robsmooth.paper.report", "robsmooth.paper.verdicts"]
    in_a_new_process(f"""
import importlib, sys
sys.modules |= dict.fromkeys({sorted(OF_EXTRAS | SIDE_BY_SIDE)})  # an import of these fails
for name in {library + also}:
    importlib.import_module(name)
import robsmooth as rs
for name in rs.__all__:
    getattr(rs, name)
""")


def test_importing_the_package_imports_nothing_else():
    before = "import sys, ast, importlib.util, pkgutil, typing; before = set(sys.modules)\n"
    new = in_a_new_process(before + "import robsmooth; print(*(set(sys.modules) - before))")
    assert new.split() == ["robsmooth"]


def test_a_design_needs_no_compiler():
    program = "import sys, robsmooth as rs; rs.minimize_bound; print('numba' in sys.modules)"
    assert in_a_new_process(program) == "False\n"


def test_type_checkers_are_told_the_names_that_there_are():
    stub = ast.parse(Path(rs.__file__).with_suffix(".pyi").read_text())
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    told = {alias.name: node.module for node in imports for alias in node.names}
    # without `as`, a name is none of the package's to them
    assert all(alias.name == alias.asname for node in imports for alias in node.names)
    assert sorted(told) == rs.__all__ == dir(rs)
    for name, module in told.items():
        member = getattr(rs, name)
        assert member is getattr(importlib.import_module(module), name)


def test_a_name_that_was_asked_for_is_there():
    assert rs.augment is vars(rs)["augment"]
    everything = {}
    exec("from robsmooth import *", everything)
    assert set(rs.__all__) <= set(everything)


@pytest.mark.parametrize(
    ("name", "here"),
    [
        ("minimise_bound", "minimize_bound"),
        ("UncertainSytem", "UncertainSystem"),
        ("error_covarience", "error_covariance"),
    ],
)
def test_python_tells_the_name_that_was_nearly_given(name, here):
    program = [sys.executable, "-c", f"import robsmooth; robsmooth.{name}"]
    ended = subprocess.run(program, capture_output=True, text=True)
    assert ended.stderr.endswith(f"has no attribute {name!r}. Did you mean: {here!r}?\n")


@pytest.mark.parametrize("name", ["xyzzy", "_augment", "__path_of_no_one__"])
def test_a_name_of_nothing_is_told_nothing(name):
    with pytest.raises(AttributeError, match=f"^module 'robsmooth' has no attribute '{name}'$"):
        getattr(rs, name)
    assert not hasattr(rs, name)
