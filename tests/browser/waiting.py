"""To wait for what Playwright has no words for: its wait_for_function takes a promise for true."""

import time
from collections.abc import Callable

from playwright.sync_api import Page


def eventually(page: Page, look: Callable, wanted: object, patience: float = 60.0) -> object:
    """Look until what is wanted is there, or for `patience` seconds; give what was seen last."""
    deadline = time.monotonic() + patience
    while (seen := look()) != wanted and time.monotonic() < deadline:
        page.wait_for_timeout(50)  # lets the page go on
    return seen
