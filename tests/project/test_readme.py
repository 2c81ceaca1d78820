"""What a newcomer reads first: the example runs as printed, the links lead somewhere."""

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_examples_on_ones_own_system_run_as_printed(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    samples = np.random.default_rng(0).standard_normal((100, 2))
    np.savetxt("record.csv", samples, header="y,reference", comments="", delimiter=",")
    examples = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    assert len(examples) == 2
    exec(compile("\n".join(examples), "README.md", "exec"), {})
    (printed,) = re.findall(r"```text\n(.*?)```", TEXT, flags=re.DOTALL)
    assert capsys.readouterr().out == printed
    assert np.load("smoothed.npy").shape == (100, 1)


@pytest.mark.parametrize("page", ["data.md", "csv.md", "frame.md"])
def test_the_example_of_a_page_runs_as_printed(page, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "source" / page).read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    exec(compile(example, page, "exec"), {})
    (printed,) = re.findall(r"```text\n(.*?)```", text, flags=re.DOTALL)
    assert capsys.readouterr().out == printed


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_links_and_images_lead_to_files_of_the_project(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    targets = re.findall(r"\]\((?!https://|#)([^)]+)\)", text)
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target
