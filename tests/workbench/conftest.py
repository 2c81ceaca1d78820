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
