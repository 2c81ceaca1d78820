"""What a newcomer reads first: its pages run as printed, its links lead somewhere.

The example of the README is run by `test_wheel`.
"""

import csv
import re
import subprocess
from pathlib import Path

import pytest

from tests.helpers.compilers import STRICT, compile_c

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def page(name, language):
    """The blocks of a language on one of the site's own pages, as one text."""
    text = (ROOT / "docs" / "source" / name).read_text(encoding="utf-8")
    blocks = re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)
    assert blocks
    return "".join(blocks)


PAGES = sorted((ROOT / "docs" / "source").glob("*.md"))
WITH_EXAMPLES = [path.name for path in PAGES if "```python" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_examples_of_a_page_run_as_printed(name, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(page(name, "python"), name, "exec"), {})
    assert capsys.readouterr().out == page(name, "text")


def test_the_c_of_the_page_compiles_and_its_commands_find_it_right(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(compile(page("to_c.md", "python"), "to_c.md", "exec"), {})
    (tmp_path / "loop.c").write_text(page("to_c.md", "c"))
    compile_c("loop.c", "loop.o", *STRICT, "-c")
    commands = ["sh", "-e", "-c", page("to_c.md", "sh")]
    ended = subprocess.run(commands, capture_output=True, text=True, check=True)
    assert float(ended.stdout) < 1e-6


@pytest.mark.parametrize(
    "path",
    [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "environment.md")),
        *ROOT.glob("notebooks/*.ipynb"),
    ],
    ids=lambda path: path.name,
)
def test_links_and_images_lead_to_files_of_the_project(path):
    targets = re.findall(r"\]\((?!https://|#)([^)#\\]+)", path.read_text(encoding="utf-8"))
    assert targets or path.suffix == ".ipynb"
    for target in targets:
        assert (path.parent / target).exists(), target


def errors(name, **which):
    """The certified errors of the classical and of the best smoother, as a committed table says."""
    with (ROOT / "figures" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if which.items() <= row.items()]
    (column,) = [column for column in rows[0] if column.startswith("certified")]
    certified = {row["smoother"]: float(row[column]) for row in rows if row[column]}
    return [f"{value:.4g}" for value in (certified["classical"], min(certified.values()))]


def test_the_page_on_what_pays_quotes_the_committed_tables():
    text = (ROOT / "docs/source/does_it_pay.md").read_text(encoding="utf-8")
    section = text.split("## When it pays")[1].split("\n\n")[1]
    quoted = [
        [f"{float(cell.split()[0]):.4g}" for cell in line.strip("| ").split(" | ")[1:]]
        for line in section.splitlines()[2:]
    ]
    assert quoted == [
        errors("candidates_difference"),
        errors("candidates_gain"),
        errors("candidates_readme"),
        errors("candidates"),
        errors("own_systems_judged", system="mirror"),
        errors("own_systems_judged", system="pendulum"),
    ]


def test_the_readme_says_of_smoothing_what_the_committed_table_says():
    with (ROOT / "figures/what_the_sector_costs.csv").open(encoding="utf-8", newline="") as file:
        _, (_, saved), *_ = [row for row in csv.reader(file)][1:]
    assert f"it takes {saved} off the mean square error" in " ".join(TEXT.split())
