"""The explorer by one command, as a person uses it: sliders, own system, on a phone, too."""

import pytest
from playwright.sync_api import expect

from tests.helpers.explorers import running_explorer
from tests.interface.browser.panels import Panels
from tests.interface.browser.waiting import eventually

PHONE = {"width": 390, "height": 844}


def ours(complaints):
    """Without those of Voila's MathJax, which comes from the network, if there is one."""
    return [each for each in complaints if "Failed to load resource" not in each]


@pytest.fixture(scope="module")
def address(browser, tmp_path_factory):
    with running_explorer(tmp_path_factory.mktemp("explorer")) as (url, _):
        yield url


def test_the_sliders_are_there_at_once(address, page, complaints, screenshot, record_property):
    page.goto(address)
    panels = Panels(page)
    for name in ("reset", "lag", "gamma", "verdict", "panels"):
        expect(page.locator(f".robsmooth-{name}").first).to_be_in_viewport()
    expect(page.get_by_text("from robsmooth.explorer")).to_have_count(0)  # no code
    first, said = panels.picture(), panels.verdict.inner_text()
    screenshot("start", whole=True)
    delays = [panels.press(".robsmooth-lag .noUi-handle", "ArrowRight") for _ in range(10)]
    record_property("from a key to another picture, ms", sorted(round(delay) for delay in delays))
    number = page.locator(".robsmooth-gamma .widget-readout")
    number.fill("0.6")
    number.press("Enter")
    eventually(page, lambda: panels.picture() != first, True)
    panels.wait()
    assert panels.verdict.inner_text() != said
    screenshot("typed", whole=True)
    page.locator(".robsmooth-reset").click()
    assert eventually(page, panels.picture, first) == first
    page.get_by_text("For theorists").click()
    expect(page.locator("img.robsmooth-theory")).to_be_visible()
    screenshot("theory")
    assert ours(complaints) == []


def test_a_system_of_ones_own_is_judged(address, page, complaints, screenshot):
    page.goto(address)
    Panels(page)
    page.get_by_text("Your own system").click()
    expect(page.locator(".robsmooth-lag").first).to_be_hidden()
    page.get_by_label("example").select_option(label="a clock, which drifts")
    page.locator(".robsmooth-own-compare").click()
    answer = page.locator(".robsmooth-own-answer")
    expect(answer).to_contain_text("designed")
    expect(answer).to_contain_text("use it.")
    code = page.locator(".robsmooth-own-code textarea").input_value()
    assert "rs.best_smoother(plant)" in code
    screenshot("clock", whole=True)
    page.locator(".robsmooth-own-B1 textarea").fill("soon")
    page.locator(".robsmooth-own-compare").click()
    expect(answer).to_contain_text("B1 must be rows of as many numbers each")
    assert ours(complaints) == []


def test_all_of_it_fits_a_phone(address, page, screenshot):
    page.set_viewport_size(PHONE)
    page.goto(address)
    Panels(page)
    page.evaluate("window.scrollTo(0, 0)")
    expect(page.locator(".robsmooth-reset")).to_be_in_viewport()
    expect(page.locator(".robsmooth-lag").first).to_be_in_viewport()
    screenshot("start", whole=True)
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= PHONE["width"]
    page.get_by_text("Your own").click()
    screenshot("own-system", whole=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
