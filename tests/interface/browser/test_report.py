"""The report's pages, opened from the disk with the network cut."""

import pytest
from playwright.sync_api import Page, expect

from tests.interface.browser.faults import faults, in_each_font


@pytest.fixture
def report(browser, request):
    """The folder of the report, made only where there is a browser to read it."""
    return request.getfixturevalue("site_folder")  # as an argument it would come before the browser


@pytest.fixture
def offline(page: Page, complaints: list[str]) -> Page:
    """A tab without a network, where asking for anything but files is a complaint."""
    page.context.set_offline(True)
    local = ("file:", "data:", "blob:")
    page.on("request", lambda it: it.url.startswith(local) or complaints.append(it.url))
    return page


def test_every_page_shows_its_mathematics_and_images(report, offline, complaints, screenshot):
    pages = [path for path in sorted(report.rglob("*.html")) if "_static" not in path.parts]
    for path in pages:
        name = path.relative_to(report).with_suffix("").as_posix()
        offline.goto(path.as_uri())
        for fonts in in_each_font(offline):
            found = faults(offline, "body")
            screenshot(f"{name.replace('/', '-')}-{fonts}", whole="/" not in name)
            assert found == [], (name, fonts)
        assert complaints == [], name
    offline.goto((report / "theory.html").as_uri())
    expect(offline.locator("mjx-container svg").first).to_be_visible()


def test_the_report_can_be_read_and_searched(report, offline, complaints):
    offline.goto((report / "index.html").as_uri())
    sidebar = offline.locator(".sidebar-tree")
    sidebar.get_by_role("link", name="3. How does the error grow with the uncertainty?").click()
    expect(offline.locator("h1")).to_contain_text(
        "3. How does the error grow with the uncertainty?"
    )
    search = offline.locator(".sidebar-search")
    search.fill("delta_sweep")
    search.press("Enter")
    pages = offline.locator("#search-results li")
    expect(pages.filter(has=offline.locator(".context")).first).to_contain_text("delta_sweep")
    found = offline.locator("#search-results li a", has_text="robsmooth.delta_sweep")
    found.first.click()
    expect(offline.locator("[id='robsmooth.delta_sweep']")).to_be_in_viewport()
    assert complaints == []


def test_print_sizes_can_be_seen_in_grey(report, offline):
    offline.goto((report / "print.html").as_uri())
    figure = offline.locator("figure.print-size img").first
    expect(figure).to_have_css("filter", "none")
    offline.locator("#grey").check()
    expect(figure).to_have_css("filter", "grayscale(1)")
