"""Projects of notebooks, for the tests of what runs them."""

import json
import shutil
from pathlib import Path

import nbformat

from robsmooth.workbench import parameters, runner
from robsmooth.workbench.runner import Request

FIXTURES = Path(__file__).parents[1] / "workbench" / "notebooks"


class Project:
    """A project folder with some of the fixture notebooks, listed in its profiles.toml."""

    def __init__(self, root):
        self.root = root
        self.profiles = ""
        (root / "notebooks").mkdir()

    def add(self, *fixtures):
        for fixture in fixtures:
            number = 1 + len(list(self.root.glob("notebooks/*.ipynb")))
            shutil.copy(FIXTURES / f"{fixture}.ipynb", self.path(f"{number:02}_{fixture}"))
        self.write_profiles()
        return self

    def write_profiles(self, text=""):
        names = sorted(path.stem for path in self.root.glob("notebooks/*.ipynb"))
        listed = f"notebooks = {json.dumps(names)}\n"
        (self.root / "notebooks" / "profiles.toml").write_text(listed + text)

    def path(self, name):
        return self.root / "notebooks" / f"{name}.ipynb"

    def edit(self, name, old, new):
        source = self.path(name).read_text()
        assert old in source
        self.path(name).write_text(source.replace(old, new))

    def edit_code(self, name, old, new):
        """Replace in the code of a notebook, written as it stands in a cell."""
        notebook = nbformat.read(self.path(name), as_version=4)
        cells = [cell for cell in notebook.cells if old in cell.source]
        assert len(cells) == 1
        cells[0].source = cells[0].source.replace(old, new)
        nbformat.write(notebook, self.path(name))

    def add_optional(self, name):
        """Give a notebook the parameters that the pipeline sets where they are there."""
        defaults = {"str": '""', "bool": "False"}
        lines = [
            f"{each}: {kind} = {defaults[kind]}  # may be there"
            for each, kind in parameters.OPTIONAL.items()
        ]
        self.edit_code(name, "scale: str", "\n".join([*lines, "scale: str"]))

    def run(self, **options):
        request = Request(self.root, **options)
        results = runner.run_notebooks(request, runner.plan(request))
        return sorted(results, key=lambda result: result.task.name)

    def key(self, **options):
        return self.plan(**options)[0].key

    def plan(self, **options):
        return runner.plan(Request(self.root, **options))

    def results(self):
        """Every file in the places of the paper's results, with its content."""
        folders = [self.root / "figures", self.root / "data"]
        files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
        return {path.relative_to(self.root).as_posix(): path.read_bytes() for path in files}
