"""The wheel, installed into an environment of the core dependencies and nothing else."""

import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import robsmooth

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
UV = ROOT / ".uv" / "bin" / "uv"


def core(name):
    """Names of the distributions that one needs, itself included, none of them for an extra."""
    found = {name}
    for text in metadata.requires(name) or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            found |= core(requirement.name)
    return found


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    """Folder of programs of an environment with the wheel, built here, and its dependencies.

    These are the very files of the running environment, so nothing is fetched.
    """
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    home = folder / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", home], check=True)
    python = home / "bin" / "python"
    (packages,) = home.glob("lib/python*/site-packages")
    for name in core("robsmooth") - {"robsmooth"}:
        distribution = metadata.distribution(name)
        for top in {file.parts[0] for file in distribution.files} - {".."}:
            source = Path(distribution.locate_file(top))
            if top.endswith(".dist-info"):  # uv wants a folder of its own
                shutil.copytree(source, packages / top)
            else:
                (packages / top).symlink_to(source)
    if UV.exists():
        install = [UV, "pip", "install", "--offline", "--python", python, wheel]
    else:
        install = [sys.executable, "-m", "pip", "--python", python, "install", "--no-index", wheel]
    subprocess.run(install, check=True, capture_output=True)
    return home / "bin"


@pytest.fixture
def run(light, tmp_path, monkeypatch):
    """Run a program of the environment somewhere else, as `folder` says."""
    for name in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"):
        monkeypatch.delenv(name, raising=False)

    def run(*command, folder=tmp_path):
        program, *arguments = command
        return subprocess.run(
            [light / program, *arguments], cwd=folder, capture_output=True, text=True, check=False
        )

    return run


def test_nothing_but_the_core_is_installed(run):
    names = "import importlib.metadata as m; print(*{d.name for d in m.distributions()})"
    found = set(run("python", "-c", names).stdout.split())
    assert found == core("robsmooth")
    numerics = {"numpy", "scipy", "numba", "llvmlite", "threadpoolctl"}
    convex = {"cvxpy-base", "clarabel", "qdldl", "sparsediffpy", "cffi", "pycparser"}
    assert found == {"robsmooth", "tqdm"} | numerics | convex


def test_the_readmes_example_runs_as_printed(run, tmp_path):
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    (printed,) = re.findall(r"```text\n(.*?)```", README, flags=re.DOTALL)
    ended = run("python", "-c", f"{example}\nrs.save(smoother, 'smoother.toml')")
    assert (ended.stdout, ended.stderr) == (printed, "")
    assert robsmooth.load(tmp_path / "smoother.toml").plant.delay == 0.5


def test_the_verdicts_are_those_of_the_readme(run):
    counted = re.findall(r"(\d+) ((?:not )?(?:reproduced|checkable)[a-z ]*)", README)
    ended = run("robsmooth", "verdicts")
    rows = re.findall(r"^\| ([a-z ]+) \| (\d+) \| (\d+) \|$", ended.stdout, flags=re.MULTILINE)
    *rows, total = rows[:5]
    found = [(row[kind], row[0]) for kind in (1, 2) for row in rows if row[kind] != "0"]
    assert counted == found
    assert all(f"Of {number} " in README for number in total[1:])
    assert ended.stderr == ""
    counted = run("python", "-c", "import robsmooth as rs; print(len(rs.verdicts()))").stdout
    assert int(counted) == sum(map(int, total[1:]))


def test_the_command_knows_its_version(run):
    assert run("robsmooth", "--version").stdout == f"robsmooth {robsmooth.__version__}\n"
    assert robsmooth.__version__ == metadata.version("robsmooth")


@pytest.mark.parametrize("command", ["figures", "bench"])
def test_what_needs_a_checkout_says_so(run, command):
    ended = run("robsmooth", command)
    assert ended.returncode == 2
    assert ended.stderr.startswith("robsmooth: there is no notebooks/profiles.toml here or above")
    assert "in a checkout of the project" in ended.stderr


def test_in_a_checkout_the_command_says_what_is_not_installed(run):
    ended = run("robsmooth", "figures", folder=ROOT)
    said = (
        "robsmooth: a run of the notebooks needs the package ipykernel: pip install "
        "'robsmooth[notebooks]'\n"
    )
    assert (ended.returncode, ended.stderr) == (2, said)


NEEDS = {
    "import robsmooth.explorer": "the explorer needs the package ipywidgets: [notebooks]",
    "import robsmooth.paper.figures": "a figure needs the package matplotlib: [plot]",
    "rs.UncertainSystem.from_plant(None, 1.0, 1.0)": (
        "a python-control system needs the package control: [control]"
    ),
    "system.to_statespace()": "to_statespace needs the package control: [control]",
    "sweep.plot()": "a plot needs the package matplotlib: [plot]",
    "sweep.to_frame()": "a data frame needs the package pandas: [frames]",
    "open('y.csv', 'w').close(); rs.smooth_record(kalman.discretize(1e-7), 'y.csv', 'w.npy')": (
        "a data frame, CSV or Parquet needs the package pyarrow: [records]"
    ),
    "from robsmooth.workbench import connect; connect('tcp://127.0.0.1:8786').__enter__()": (
        "a cluster needs the package distributed: [cluster]"
    ),
}


def test_what_needs_an_extra_says_which(run, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")  # what is compiled has no part in it
    program = f"""
import traceback
import robsmooth as rs
system = rs.homodyne.PAPER.uncertain_system()
kalman = rs.baselines.kalman_bucy(system)
sweep = rs.delta_sweep(kalman, [0.0])
for each in {list(NEEDS)}:
    try:
        exec(each)
    except Exception:
        print(traceback.format_exc().splitlines()[-1])
    else:
        print("nothing")
"""
    ended = run("python", "-c", program)
    wanted = [
        "robsmooth._support.extras.MissingExtraError: "
        + re.sub(r"\[(\w+)\]", r"pip install 'robsmooth[\1]'", said)
        for said in NEEDS.values()
    ]
    assert ended.stdout.splitlines() == wanted, ended.stderr


def test_without_a_terminal_or_jupyter_nothing_of_them_is_asked_for(run):
    program = """
import robsmooth as rs
sweep = rs.lag_sweep(rs.homodyne.PAPER.uncertain_system(), [1e-6], [2], progress=True)
print(rs.homodyne.PAPER._repr_html_()[:6])
"""
    ended = run("python", "-c", program)
    assert ended.stderr == ""
