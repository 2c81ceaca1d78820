"""To wait for what Playwright has no words for: its wait_for_function takes a promise for true."""

import time
from collections.abc import Callable

from playwright.sync_api import Page

from tests.helpers.waiting import PATIENCE


def eventually(page: Page, look: Callable, wanted: object) -> object:
    """Look until what is wanted is there, or patience ends; give what was seen last."""
    deadline = time.monotonic() + PATIENCE
    while (seen := look()) != wanted and time.monotonic() < deadline:
        page.wait_for_timeout(50)  # lets the page go on
    return seen
