"""A browser for the tests of this folder, and a screenshot of how each of them ends."""

import contextlib
import os
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Error, Page, expect, sync_playwright

from tests.helpers.waiting import PATIENCE
from tests.interface.browser import chromium

SCREENSHOTS = Path(__file__).resolve().parents[3] / "build" / "browser"
QUIET = [
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-gpu",
    "--disable-quic",
    "--disable-sync",
    "--no-first-run",
]


@pytest.fixture(scope="module")  # until it ends, this thread has a running event loop
def browser():
    """Chromium with a profile of its own, or a skip that says what is missing."""
    try:
        path = chromium.find()
    except chromium.NoChromium as missing:
        pytest.skip(str(missing))
    root = ["--no-sandbox"] if os.geteuid() == 0 else []  # chromium refuses root otherwise
    expect.set_options(timeout=1000 * PATIENCE)
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(
            executable_path=path, args=QUIET + root, timeout=1000 * PATIENCE
        )
        yield running
        running.close()


@pytest.fixture
def complaints() -> list[str]:
    """What the test's page wrote to its console as an error, or raised."""
    return []


@pytest.fixture
def page(browser: Browser, complaints: list[str]):
    """A tab that no other test has used."""
    with browser.new_context(viewport={"width": 1280, "height": 900}) as context:
        context.set_default_timeout(1000 * PATIENCE)
        page = context.new_page()
        page.on("console", lambda it: it.type == "error" and complaints.append(it.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        yield page


@pytest.fixture
def screenshot(page: Page, request: pytest.FixtureRequest):
    """Take a picture of the window or of the whole page, named after the test and a word."""

    def take(word: str, whole: bool = False) -> None:
        page.screenshot(path=_picture(request.node, word), full_page=whole)

    return take


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo):
    """Take the screenshot, and name it where the test has failed."""
    report = yield
    page = getattr(item, "funcargs", {}).get("page")
    if call.when == "call" and isinstance(page, Page):
        picture = _picture(item, "end")
        with contextlib.suppress(Error):  # of a page that was never opened there is none
            page.screenshot(path=picture)
            if report.failed:
                report.sections.append(("Screenshot", str(picture)))
    return report


def _picture(test: pytest.Item, word: str) -> Path:
    name = test.name.removeprefix("test_").translate(str.maketrans("[", "-", "]"))
    return SCREENSHOTS / f"{name}-{word}.png"


def pytest_terminal_summary(terminalreporter):
    """Say where the screenshots are, and what was measured."""
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            terminalreporter.write_line(f"{report.nodeid}: {name} {value}")
    if SCREENSHOTS.is_dir():
        terminalreporter.write_line(f"screenshots are in {os.path.relpath(SCREENSHOTS)}")
