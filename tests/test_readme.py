"""The README: its example runs, its links lead somewhere."""

import re
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_examples_on_ones_own_system_run_as_printed(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    samples = np.random.default_rng(0).standard_normal((100, 1))
    np.savetxt("record.csv", samples, header="y", comments="")
    examples = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    assert len(examples) == 2
    exec(compile("\n".join(examples), "README.md", "exec"), {})
    assert "RobustSmoother(bound=" in capsys.readouterr().out
    assert np.load("smoothed.npy").shape == samples.shape


def test_links_and_images_lead_to_files_of_the_project():
    targets = [t for t in re.findall(r"\]\(([^)]+)\)", TEXT) if not t.startswith("https://")]
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target
