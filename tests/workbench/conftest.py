import signal

import pytest

from robsmooth.workbench import runner
from tests.helpers.projects import Project


@pytest.fixture
def project(tmp_path, monkeypatch):
    package = tmp_path / "package" / "robsmooth"
    package.mkdir(parents=True)
    (package / "model.py").touch()
    monkeypatch.setattr(runner, "PACKAGE", package)
    return Project(tmp_path)


@pytest.fixture(autouse=True)
def handlers():
    """What the command does to the handlers of signals is undone."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
