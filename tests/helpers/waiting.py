"""To wait for a condition, on a machine of any speed."""

import time
from collections.abc import Callable

PATIENCE = 600.0  # s: what takes longer hangs


def wait_until(condition: Callable[[], object]) -> None:
    """Look again and again until the condition holds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
