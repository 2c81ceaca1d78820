"""What all tests share: reproducible property tests, and one BLAS thread for small matrices."""

import pytest
from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits

settings.register_profile(
    "robsmooth",
    deadline=None,  # the first call of a solver pays for its import
    derandomize=True,
    max_examples=30,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)
settings.load_profile("robsmooth")


@pytest.fixture
def terminal(capsys, monkeypatch):
    """What is written where stderr is a terminal, which shows progress bars."""
    for name in ("CI", "TQDM_DISABLE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("robsmooth.progress._in_terminal", lambda: True)
    return capsys


@pytest.fixture(autouse=True, scope="session")
def one_blas_thread():
    """More threads than one make the small problems here five times slower."""
    with threadpool_limits(1):
        yield
