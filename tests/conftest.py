"""What tests share: reproducible property tests, one BLAS thread, and a run of all notebooks."""

import signal
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits

from tests.helpers.runs import once, quick

TESTS = Path(__file__).parent
# A shell that starts the tests in the background ignores Ctrl-C for them, and for all they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
settings.register_profile(
    "robsmooth",
    deadline=None,  # the first call of a solver pays for its import
    derandomize=True,
    max_examples=30,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)
settings.load_profile("robsmooth")

# Files that take longest. They begin first, so that no worker ends with one of them. The notebooks
# compile in a new clone what others use: while they run, the files after them compile nothing.
LONGEST = [
    "project/test_notebooks.py",
    "estimators/test_constant.py",
    "analysis/test_choice.py",
    "estimators/test_tuned.py",
    "project/test_benchmarks.py",
    "workbench/test_runner.py",
    "explorer/test_explorer.py",
    "workbench/test_kills.py",
    "estimators/test_minimax_properties.py",
    "support/test_cluster.py",
    "support/test_kernels.py",
    "homodyne/test_trust.py",
    "project/test_wheel.py",
    "homodyne/test_ergodic.py",
    "homodyne/test_moments.py",
    "project/test_readme.py",
]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest; all else stays in its order."""
    ranks = {TESTS / name: rank for rank, name in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))


@pytest.fixture
def terminal(capsys, monkeypatch):
    """What is written where stderr is a terminal, which shows progress bars."""
    for name in ("CI", "TQDM_DISABLE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda _: True)
    return capsys


@pytest.fixture(autouse=True, scope="session")
def one_blas_thread():
    """More threads than one make the small problems here five times slower."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def first_run(tmp_path_factory):
    """Results of all notebooks with the quick profile."""

    def run_notebooks(build):
        run = quick("robsmooth", "figures", build=build)
        assert run.returncode == 0, run.stderr

    return once(tmp_path_factory.getbasetemp(), "first", run_notebooks) / "quick"


@pytest.fixture(scope="session")
def site_folder(first_run, tmp_path_factory):
    """The site of these results, built without a warning."""

    def build_site(_):
        run = quick("docs", build=first_run.parent)
        assert run.stderr == ""
        assert run.stdout == f"open {first_run}/site/index.html in a browser; it needs no network\n"

    once(tmp_path_factory.getbasetemp(), "site", build_site)
    return first_run / "site"
