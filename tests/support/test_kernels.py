"""What numba compiles: kept where there is a place, made anew when it must be, done without."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import robsmooth

PACKAGE = Path(robsmooth.__file__).parent

KERNEL = """
import sys
from robsmooth._support.kernels import kept
SOURCES = sys.argv[1]

@kept(nogil=True)
def double(value, sources=SOURCES):
    return 2 * value

assert double(2.0) == 4.0
print(sum(double.stats.cache_hits.values()))
"""


def run(program, *arguments, check=True, **environment):
    """Run Python with warnings as they come by default, and some variables of its own."""
    command = [sys.executable, *arguments] if program is None else [sys.executable, "-c", program]
    inherited = {name: value for name, value in os.environ.items() if "NUMBA" not in name}
    environment = inherited | {name: str(value) for name, value in environment.items()}
    return subprocess.run(
        command, cwd=os.sep, env=environment, capture_output=True, text=True, check=check
    )


def test_kept_code_is_loaded_and_compiled_anew_for_another_default(tmp_path):
    kernel = tmp_path / "kernel.py"
    kernel.write_text(KERNEL)
    hits = [run(None, kernel, sources).stdout.strip() for sources in ("a", "a", "b", "a")]
    assert hits == ["0", "1", "0", "1"]


@pytest.fixture
def read_only(tmp_path):
    """A copy of the package beside which nothing can be written, by root neither."""
    copy = tmp_path / "sources" / "robsmooth"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for source in list(copy.rglob("*.py")):
        (source.parent / "__pycache__").touch()  # a file is in the place of the folder
    return copy.parent


def test_where_nothing_can_be_written_all_works_and_one_sentence_says_why_it_is_slow(read_only):
    program = """
import sys
sys.modules |= dict.fromkeys(["control", "distributed", "matplotlib", "pandas", "pyarrow"])
import robsmooth as rs  # without its extras, as above
for name in dir(rs):
    getattr(rs, name)
plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 1)
smoother = rs.baselines.fixed_lag_smoother(plant.system, 3.1e-6, 1).discretize(1e-7)
assert smoother.compiled
print(rs.__file__, smoother.run([[1.0]]).shape)
"""
    nowhere = {"HOME": os.devnull, "XDG_CACHE_HOME": f"{os.devnull}/cache"}
    ended = run(program, PYTHONPATH=read_only, NUMBA_OPT=0, **nowhere)  # compiles sooner
    assert ended.stdout == f"{read_only / 'robsmooth' / '__init__.py'} (1, 1)\n"
    (said, _) = ended.stderr.splitlines()  # and the line that it is from
    assert "RuntimeWarning: numba may write neither beside robsmooth's sources nor in" in said
    assert said.endswith("set NUMBA_CACHE_DIR to a folder that can be written")


def test_a_folder_that_is_named_is_used_where_nothing_else_can_be_written(read_only, tmp_path):
    folder = tmp_path / "kept"
    nowhere = {"HOME": os.devnull, "XDG_CACHE_HOME": f"{os.devnull}/cache"}
    program = "import robsmooth as rs; rs.DiscreteSmoother"
    ended = run(program, PYTHONPATH=read_only, NUMBA_CACHE_DIR=folder, **nowhere)
    assert ended.stderr == ""
    assert any(folder.iterdir())


def test_without_numbas_compiler_records_are_smoothed_and_a_monte_carlo_is_refused():
    program = """
import robsmooth as rs
for name in dir(rs):
    getattr(rs, name)
system = rs.homodyne.PAPER.uncertain_system()
kalman, linear = (rs.baselines.kalman_bucy(system, copies) for copies in (True, False))
for estimator in (linear, kalman):
    smoother = estimator.discretize(1e-7)
    print(smoother.compiled, float(smoother.run([[1e5], [2e5]])[-1, 0]).hex())
rs.monte_carlo(rs.homodyne.PAPER, kalman)
"""
    without = run(program, check=False, NUMBA_DISABLE_JIT=1)
    error = "a simulation needs numba's compiler: unset NUMBA_DISABLE_JIT"
    assert without.stderr.splitlines()[-1] == f"RuntimeError: {error}"
    before, _, _ = program.rpartition("rs.monte_carlo")
    interpreted, compiled = (
        [line.split() for line in out.stdout.splitlines()] for out in (without, run(before))
    )
    assert [how for how, _ in interpreted] == ["False", "False"]
    assert [how for how, _ in compiled] == ["True", "True"]
    np.testing.assert_allclose(
        [float.fromhex(value) for _, value in interpreted],
        [float.fromhex(value) for _, value in compiled],
        rtol=1e-12,
    )
