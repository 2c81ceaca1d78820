"""The notebooks in JupyterLab, opened and run as a person would, at the scale of the quick profile.

On a copy of the notebooks' folder: what they write is beside it.
"""

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook
from papermill.iorw import load_notebook_node
from papermill.parameterize import parameterize_notebook
from playwright.sync_api import expect

from robsmooth.workbench import runner
from tests.helpers.labs import ROOT, running_lab
from tests.interface.browser import notebook
from tests.interface.browser.faults import faults, in_each_font
from tests.interface.browser.panels import Panels
from tests.interface.browser.waiting import eventually

NUMBERED = sorted(path.stem for path in ROOT.glob("notebooks/[0-9][0-9]_*.ipynb"))

OUTPUT = ".jp-OutputArea-output"

# Half of it is done, and the rest waits for a file.
LONG = """\
import time
from pathlib import Path

import robsmooth as rs


def design(system, lag, order):
    while lag > 1e-6 and not Path("go").exists():
        time.sleep(0.05)
    return rs.baselines.fixed_lag_smoother(system, lag, order, copies=True)


system = rs.homodyne.PAPER.uncertain_system()
swept = rs.lag_sweep(system, [1e-6, 2e-6], (1,), design, progress=True)"""


@pytest.fixture(scope="module")
def lab(browser, tmp_path_factory):
    home = tmp_path_factory.mktemp("home")
    copies = home / "notebooks"
    copies.mkdir()
    for task in runner.plan(runner.Request(ROOT, profile="quick")):
        quick = load_notebook_node(str(task.notebook))
        if task.values:
            quick = parameterize_notebook(quick, task.values)
        nbformat.write(quick, copies / task.notebook.name)
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    nbformat.write(
        new_notebook(metadata=kernel, cells=[new_code_cell(LONG)]), copies / "long.ipynb"
    )
    # its question whether to fetch news would hide a corner of every page
    settings = home / "config/lab/user-settings/@jupyterlab/apputils-extension"
    settings.mkdir(parents=True)
    (settings / "notification.jupyterlab-settings").write_text('{"fetchNews": "false"}')
    with running_lab(home, f"--port=0 {copies}") as running:
        yield running


@pytest.fixture(autouse=True)
def end_kernels(lab):
    yield
    lab.end_kernels()


@pytest.mark.parametrize("name", NUMBERED)
def test_a_notebook_runs_and_shows_its_results(name, lab, page, complaints):
    notebook.open_notebook(page, lab, name)
    notebook.start_all(page)
    cells = nbformat.read(lab.home / f"notebooks/{name}.ipynb", as_version=4).cells
    count = sum(cell.cell_type == "code" for cell in cells)
    in_order = [f"[{number}]:" for number in range(1, count + 1)]

    def seen():
        notebook.show_all(page)
        return notebook.errors(page) or notebook.prompts(page)

    assert eventually(page, seen, in_order) == in_order
    for shown in (f"{OUTPUT} img", f"{OUTPUT} table", ".jp-MarkdownCell mjx-container"):
        expect(page.locator(shown).first).to_be_visible()
    for fonts in in_each_font(page):
        notebook.show_all(page)
        assert faults(page, ".jp-Notebook") == [], fonts
    assert complaints == []


def test_a_long_cell_shows_its_progress(lab, page):
    notebook.open_notebook(page, lab, "long")
    notebook.start_all(page)
    output = page.locator(OUTPUT).first
    expect(output.locator(".jupyter-widgets").first).to_be_visible()
    expect(output).to_contain_text("/2")
    assert notebook.prompts(page) == ["[*]:"]
    (lab.home / "notebooks" / "go").touch()
    notebook.wait_until_done(page)
    expect(output).to_contain_text("2/2")
    assert notebook.errors(page) == []


def test_a_second_lab_in_the_same_browser_leaves_the_first_alone(lab, page, tmp_path, complaints):
    notebook.open_notebook(page, lab, "03_delta_sweep")
    with running_lab(tmp_path, "--port=0") as second:
        other = page.context.new_page()
        notebook.open_notebook(other, second, "03_delta_sweep")
        for each in (page, other):
            notebook.run_first(each)
        other.close()
    notebook.run_first(page)
    unsaved = page.locator(".lm-TabBar-tab.jp-mod-dirty")
    expect(unsaved).to_have_count(1)
    page.keyboard.press("Control+s")
    expect(unsaved).to_have_count(0)
    assert complaints == []


def test_explore_follows_its_settings(lab, page, complaints, screenshot, record_property):
    notebook.open_notebook(page, lab, "explore")
    notebook.start_all(page)
    panels = Panels(page)  # its cells are folded and show no prompts
    assert notebook.errors(page) == []
    first, place, code = panels.picture(), panels.place(), panels.code.input_value()
    assert "lam=9140.0, kappa=40000.0" in code
    assert "delay=3.1e-06" in code
    screenshot("start")

    delays = [panels.press(".robsmooth-delay .noUi-handle", "ArrowRight") for _ in range(10)]
    record_property("from a key to all pictures, ms", sorted(round(delay) for delay in delays))
    expect(panels.code).to_have_value(code.replace("delay=3.1e-06", "delay=4.1e-06"))
    assert panels.picture() != first
    screenshot("delay")

    by_hand = page.locator(".robsmooth-design option", has_text="by hand").inner_text()
    page.locator(".robsmooth-design select").select_option(label=by_hand)
    eventually(page, lambda: panels.picture() != first, True)
    for fonts in in_each_font(page):
        assert faults(page, ".jp-Notebook") == [], fonts
        panels.scroll()
        screenshot(f"by-hand-{fonts}")

    page.locator(".robsmooth-reset").click()
    assert eventually(page, panels.picture, first) == first
    panels.wait()
    expect(panels.code).to_have_value(code)
    assert panels.place() == place
    assert notebook.errors(page) == []
    assert complaints == []
