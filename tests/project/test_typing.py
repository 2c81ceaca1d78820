"""Types of README's examples and of the whole public surface: two checkers, and a run."""

import json
import re
import runpy
import subprocess
import sys
import types
import typing
from pathlib import Path

import numpy as np
import pytest

import robsmooth
from tests.helpers.public import PUBLIC

ROOT = Path(__file__).resolve().parents[2]
SURFACE = ROOT / "tests" / "typing" / "public.py"
WRONG = """\
import robsmooth as rs
rs.minimise_bound  # no such name
rs.augment("system", 0.2, 2)  # no system
rs.Uncertainty(B=None, C=[[1.0]], D=[[0.0]])  # no numbers
rs.homodyne.PAPER.lam = 1.0  # frozen
rs.choose_lag(rs.homodyne.PAPER.uncertain_system(), delay=1.0)  # no such argument
bound: str = rs.minimize_bound(rs.augment(rs.homodyne.PAPER.uncertain_system(), 0.0, 0)).bound
"""


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """A folder with README's examples, a use of the whole surface, and wrong uses."""
    folder = tmp_path_factory.mktemp("typing")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    (folder / "readme.py").write_text("\n".join(examples))
    (folder / "public.py").write_text(SURFACE.read_text())
    (folder / "wrong.py").write_text(WRONG)
    (folder / "pyrightconfig.json").write_text(json.dumps({"typeCheckingMode": "strict"}))
    return folder


@pytest.mark.parametrize(
    "checker",
    [
        ["mypy", "--strict", f"--cache-dir={ROOT}/build/mypy", "--no-error-summary", "."],
        ["basedpyright", "--level=error", f"--pythonpath={sys.executable}"],
    ],
    ids=["mypy", "pyright"],
)
def test_a_type_checker_knows_every_type_and_every_wrong_use(programs, checker):
    run = subprocess.run(
        [sys.executable, "-m", *checker], cwd=programs, capture_output=True, text=True, check=False
    )
    found = re.findall(r"(\w+\.py):(\d+)(?::\d+)?(?: -|:) error", run.stdout)
    lines = range(2, 1 + len(WRONG.splitlines()))
    wanted = {("wrong.py", str(line)) for line in lines}
    assert set(found) == wanted, run.stdout + run.stderr


def test_the_whole_public_surface_is_used():
    text = SURFACE.read_text()
    for name in robsmooth.__all__:
        assert re.search(rf"\brs\.{name}\b", text), name
    for name in PUBLIC:
        assert re.search(rf"\brs(\.baselines|\.homodyne)?\.{name}\b", text), name


def is_of(value, told):
    """Tell whether a value is of the type that a type checker was told."""
    origin, inner = typing.get_origin(told), typing.get_args(told)
    if origin is types.UnionType:
        return any(is_of(value, each) for each in inner)
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype == typing.get_args(inner[1])[0]
    if origin is tuple:
        kinds = inner if Ellipsis not in inner else inner[:1] * len(value)
        return type(value) is tuple and all(map(is_of, value, kinds))
    if origin is dict:
        keys, values = inner
        return all(is_of(k, keys) and is_of(v, values) for k, v in value.items())
    return told is typing.Any or isinstance(value, told)


def test_what_type_checkers_are_told_is_so(monkeypatch, tmp_path):
    seen = []

    def check(value, told):
        seen.append(told)
        assert is_of(value, told), f"{value!r} is not of {told}"
        return value

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(typing, "assert_type", check)
    runpy.run_path(str(SURFACE))
    assert len(seen) > 80


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (np.ones(2, dtype=np.float32), np.typing.NDArray[np.float64]),
        ((1.0, "a"), tuple[float, float]),
        (["a"], tuple[str, ...]),
        ({1: "a"}, dict[int, float]),
        (1.0, str | None),
        (np.int64(1), int),
    ],
)
def test_the_check_of_a_run_can_fail(value, told):
    assert not is_of(value, told)
