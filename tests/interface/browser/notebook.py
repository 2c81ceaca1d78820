"""A notebook in JupyterLab, used with mouse and keyboard."""

import re

from playwright.sync_api import Page, expect

from tests.helpers.labs import Lab

# In the status bar, for the toolbar's mark is idle before the kernel has answered.
IDLE = "() => document.querySelector('#jp-main-statusbar')?.innerText.includes('| Idle')"
PROMPTS = ".jp-Notebook .jp-CodeCell .jp-InputPrompt"
DONE = """selector => {
    const prompts = [...document.querySelectorAll(selector)].map(prompt => prompt.textContent);
    return !prompts.includes("[*]:") && prompts.some(prompt => /[0-9]/.test(prompt));
}"""

BELOW = """() => {
    const panel = document.querySelector(".jp-WindowedPanel-outer");
    const last = [...panel.querySelectorAll(".jp-Cell")].at(-1);
    panel.scrollTop = 0;
    const edge = panel.getBoundingClientRect();
    return Math.ceil(last.getBoundingClientRect().bottom - edge.bottom);
}"""


def open_notebook(page: Page, lab: Lab, name: str) -> None:
    """Open a notebook in a new layout, and wait for its kernel."""
    page.goto(f"{lab.url}/lab/tree/{name}.ipynb?reset&token={lab.token}")
    page.locator(".jp-Notebook .jp-Cell").first.wait_for()
    page.wait_for_function(IDLE)


def start_all(page: Page) -> None:
    """Choose Run All Cells in the menu."""
    page.get_by_role("menuitem", name="Run", exact=True).click()
    page.get_by_role("menuitem", name="Run All Cells", exact=True).click()


def wait_until_done(page: Page) -> None:
    """Wait until no cell is to be run and the kernel has nothing to do."""
    page.wait_for_function(DONE, arg=PROMPTS)
    page.wait_for_function(IDLE)


def run_first(page: Page) -> None:
    """Run the first code cell by the keyboard."""
    prompt = page.locator(PROMPTS).first
    before = prompt.text_content()
    page.locator(".jp-CodeCell .jp-InputArea-editor").first.click()
    page.keyboard.press("Shift+Enter")
    expect(prompt).not_to_have_text(before)
    expect(prompt).to_have_text(re.compile(r"\[\d+\]:"))


def show_all(page: Page) -> None:
    """Make the window so high that all cells are drawn, the first at its top."""
    for _ in range(10):  # a cell's height is a guess before it has been in sight
        missing = page.evaluate(BELOW)
        if missing <= 0:
            break
        size = page.viewport_size
        page.set_viewport_size({"width": size["width"], "height": size["height"] + missing})
        page.wait_for_function(
            "height => window.innerHeight === height", arg=page.viewport_size["height"]
        )
    page.locator(".jp-Notebook .jp-Cell").first.scroll_into_view_if_needed()


def errors(page: Page) -> list[str]:
    """Tracebacks, and what was written to stderr."""
    kinds = ("application/vnd.jupyter.error", "application/vnd.jupyter.stderr")
    boxes = ", ".join(f'.jp-OutputArea-output[data-mime-type="{kind}"]' for kind in kinds)
    return page.locator(boxes).all_inner_texts()


def prompts(page: Page) -> list[str]:
    """In what order the cells were run: "[1]:", ..."""
    return page.locator(PROMPTS).all_text_contents()
