"""What a newcomer reads first: its pages run as printed, its links lead somewhere.

The examples of the README are run by `test_wheel`.
"""

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


@pytest.mark.parametrize("name", ["data.md", "csv.md", "frame.md", "live.md", "to_c.md"])
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


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_links_and_images_lead_to_files_of_the_project(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    targets = re.findall(r"\]\((?!https://|#)([^)]+)\)", text)
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target
