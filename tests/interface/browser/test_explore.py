"""The explorer by one command, as a person uses it: sliders, own system, on a phone, too."""

import pytest
from playwright.sync_api import expect

from tests.helpers.explorers import running_explorer
from tests.interface.browser.panels import Panels
from tests.interface.browser.waiting import eventually

PHONE = {"width": 390, "height": 844}
ARROW = "select => getComputedStyle(select).backgroundImage"
COLOURS = """() => {
    const colour = (where, which) => getComputedStyle(document.querySelector(where))[which];
    const found = [colour("body", "backgroundColor"), colour(".robsmooth-verdict p", "color")];
    return found.map(it => it.match(/[0-9]+/g).map(Number));
}"""


def ours(complaints):
    """Without those of Voila's MathJax, which comes from the network, if there is one."""
    return [each for each in complaints if "Failed to load resource" not in each]


def tab(page, title):
    return page.locator(".lm-TabBar-tabLabel", has_text=title)


@pytest.fixture(scope="module")
def address(browser, tmp_path_factory):
    with running_explorer(tmp_path_factory.mktemp("explorer")) as (url, _):
        yield url


def test_the_sliders_are_there_at_once(address, page, complaints, screenshot, record_property):
    page.goto(address)
    panels = Panels(page)
    for name in ("reset", "delay", "gamma", "verdict", "panels"):
        expect(page.locator(f".robsmooth-{name}").first).to_be_in_viewport()
    expect(page.get_by_text("from robsmooth.explorer")).to_have_count(0)  # no code
    first, said = panels.picture(), panels.verdict.inner_text()
    screenshot("start", whole=True)
    delays = [panels.press(".robsmooth-delay .noUi-handle", "ArrowRight") for _ in range(10)]
    record_property("from a key to all pictures, ms", sorted(round(delay) for delay in delays))
    number = page.locator(".robsmooth-gamma .widget-readout")
    number.fill("0.6")
    number.press("Enter")
    eventually(page, lambda: panels.picture() != first, True)
    panels.wait()
    assert panels.verdict.inner_text() != said
    number.fill("0,5")  # with a comma, and left without Enter
    page.locator(".robsmooth-delay .widget-readout").click()
    expect(number).to_have_text("0.50")
    assert eventually(page, lambda: "gamma=0.5\n" in panels.code.input_value(), True)
    screenshot("typed", whole=True)
    page.locator(".robsmooth-reset").click()
    assert eventually(page, panels.picture, first) == first
    tab(page, "For theorists").click()
    for image in page.locator(".robsmooth-theory img").all():
        expect(image).to_be_visible()
    screenshot("theory")
    assert ours(complaints) == []


def test_a_system_of_ones_own_is_judged(address, page, complaints, screenshot):
    page.goto(address)
    Panels(page)
    tab(page, "Your own system").click()
    expect(page.locator(".robsmooth-delay").first).to_be_hidden()
    page.get_by_label("example").select_option(label="a clock, which drifts")
    page.locator(".robsmooth-own-compare").click()
    answer = page.locator(".robsmooth-own-answer")
    expect(answer).to_contain_text("Designing the smoothers")
    expect(answer).to_contain_text("use it.")
    code = page.locator(".robsmooth-own-code textarea").input_value()
    assert "rs.best_smoother(plant, against='admissible')" in code
    screenshot("clock", whole=True)
    page.locator(".robsmooth-own-B1 textarea").fill("soon")
    page.locator(".robsmooth-own-compare").click()
    expect(answer).to_contain_text("B1: 'soon' is no finite number")
    expect(page.locator(".robsmooth-own-code")).to_be_hidden()
    page.locator(".robsmooth-own-reset").click()
    expect(page.locator(".robsmooth-own-B1 textarea")).to_have_value("1 0 0\n0 0.1 0")
    assert ours(complaints) == []


def test_all_of_it_fits_a_phone(address, page, screenshot):
    page.set_viewport_size(PHONE)
    page.goto(address)
    Panels(page)
    page.evaluate("window.scrollTo(0, 0)")
    expect(page.locator(".robsmooth-reset")).to_be_in_viewport()
    expect(page.locator(".robsmooth-delay").first).to_be_in_viewport()
    screenshot("start", whole=True)
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= PHONE["width"]
    tab(page, "Your own system").click()
    page.locator(".robsmooth-own-compare").click()
    answer = page.locator(".robsmooth-own-answer")
    table = answer.locator("table")
    expect(table).to_be_visible()
    screenshot("own-system", whole=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    box = answer.locator("p").first.bounding_box()  # its sentence is read without scrolling
    assert box["x"] + box["width"] <= PHONE["width"]
    for cell in table.locator("td:last-child").filter(visible=True).all():  # best, refused
        box = cell.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= PHONE["width"]


def test_the_help_explains_the_words(address, page, screenshot):
    page.goto(address)
    Panels(page)
    tab(page, "Help").click()
    shown = page.locator(".robsmooth-help")
    for word in ("minimax", "certified worst", "sector", "What to try", "a path and its estimates"):
        expect(shown).to_contain_text(word)
    expect(shown.locator("table")).to_have_count(3)
    assert "$" not in shown.inner_text()
    screenshot("help", whole=True)


def test_where_dark_is_preferred_the_page_is_dark(address, page, screenshot):
    page.emulate_media(color_scheme="dark")
    page.goto(address)
    Panels(page)
    colours = page.evaluate(COLOURS)
    background, text = (sum(colour[:3]) for colour in colours)
    assert background < 200 < 500 < text
    arrow = page.get_by_label("design").evaluate(ARROW)
    assert "fill='%23ddd'" in arrow  # as light as the text
    screenshot("dark", whole=True)
