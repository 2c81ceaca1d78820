"""Run as a program: all notebooks with the quick profile, in one process and without a kernel."""

import os
import sys
import tomllib
from pathlib import Path

import nbformat
from IPython.core.interactiveshell import InteractiveShell
from matplotlib import pyplot as plt

from robsmooth.paper import report

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"


def replay(shell: InteractiveShell, name: str, values: dict[str, object]) -> None:
    """Run the cells of a notebook, with these values of its parameters."""
    shell.reset()
    for cell in nbformat.read(FOLDER / f"{name}.ipynb", as_version=4).cells:
        if cell.cell_type == "code":
            shell.run_cell(cell.source).raise_error()
            plt.close("all")  # as a kernel does
        if "parameters" in cell.metadata.get("tags", []):
            shell.push(values)


def main(results: Path) -> None:
    """Write figures/ and data/ of all notebooks to a folder, and the report on them."""
    profiles = tomllib.loads((FOLDER / "profiles.toml").read_text(encoding="utf-8"))
    figures, data = results / "figures", results / "data"
    for place in (figures, data):
        place.mkdir()
    os.chdir(FOLDER)
    places = {"output_dir": str(figures), "data_dir": str(data)}
    for name in profiles["notebooks"]:
        replay(InteractiveShell.instance(), name, places | profiles["quick"].get(name, {}))
    report.write(figures, data)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
