"""Build the site: stage its sources beside executed notebooks and results, and run Sphinx on them.

The staged tree has the project's layout, so that the relative links of the README, of notebooks and
of the verdicts lead to the same things on the site.
"""

import re
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path

import nbformat
from sphinx.cmd.build import build_main

from docs import citation, results
from robsmooth.workbench.parameters import SET_BY_PIPELINE, PipelineError
from robsmooth.workbench.runner import Request, Task, plan

SOURCE = Path(__file__).resolve().parent / "source"
DOCUMENTS = (
    *("README.md", "environment.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"),
    "SUPPORT.md",
    *("CITATION.cff", "LICENSE"),
)
RESULTS = (".png", ".pdf", ".svg", ".csv", ".json")
_PRINTED_TABLE = re.compile(r"^```text\n(\|.*?)^```\n", re.DOTALL | re.MULTILINE)
_SET_BY_PIPELINE = re.compile(rf"(?:{'|'.join(SET_BY_PIPELINE)}) = ")


def build(root: Path, profile: str, folder: Path | None = None) -> Path | None:
    """Build the site from what `robsmooth figures` has left.

    Parameters
    ----------
    root : Path
        The project.
    profile : {"paper", "quick"}
        Whose notebooks and results to show.
    folder : Path, optional
        Where the run has worked, instead of `root/build`.

    Returns
    -------
    Path or None
        The folder of the site; None where Sphinx has warned, and an earlier site stays.

    Raises
    ------
    PipelineError
        Where a notebook has not been executed to its end.
    """
    run = Request(root, profile=profile, build=folder)
    executed = [_executed(task) for task in sorted(plan(run), key=lambda task: task.name)]
    with tempfile.TemporaryDirectory(dir=run.work, prefix="site.") as work:
        source, html = Path(work) / "source", Path(work) / "html"
        stage(run, source, executed)
        options = ["-q", "-W", "--keep-going", "-d", f"{work}/doctrees", *_options(profile)]
        if build_main([*options, str(source), str(html)]):
            return None
        site = run.work / "site"
        if site.exists():
            site.rename(Path(work) / "earlier")  # and removed with the rest
        html.rename(site)
    return site


def _executed(task: Task) -> Path:
    """Return the path of an executed notebook, after seeing that it ran to its end."""
    path, wanted = task.executed, f"run `make figures PROFILE={task.run.profile}` first"
    if not path.is_file():
        raise PipelineError(f"{path.name} has not been executed with this profile; {wanted}")
    about = nbformat.read(path, as_version=4).metadata.get("papermill", {})
    if about.get("exception") or not about.get("end_time"):
        raise PipelineError(f"{path.name} has not been executed to its end; {wanted}")
    return path


def _options(profile: str) -> list[str]:
    if profile == "paper":
        return []
    words = f"{profile.capitalize()} profile: small simulations."
    return ["-D", f"html_theme_options.announcement={words}"]


def stage(run: Request, source: Path, executed: list[Path]) -> None:
    """Lay out the sources for Sphinx in the folder `source`."""
    root, figures = run.root, run.results / "figures"
    shutil.copytree(SOURCE, source, ignore=shutil.ignore_patterns("__pycache__"))
    mathjax = Path(find_spec("sphinx-mathjax-offline").origin).parent / "static/mathjax"
    _copy([mathjax / "tex-svg-full.js"], source / "_static/mathjax")
    _copy([root / name for name in DOCUMENTS], source)
    for name in (
        "README.md",
        "SUPPORT.md",
        "environment.md",
    ):  # the site's own pages stand beside them
        page = source / name
        text = page.read_text("utf-8").replace("](docs/source/", "](")
        page.write_text(_PRINTED_TABLE.sub(r"\1", text), encoding="utf-8")
    _copy((root / "benchmarks").glob("*.*"), source / "benchmarks", (*RESULTS, ".md"))
    _copy([root / "data/published.toml", *(run.results / "data").glob("*.json")], source / "data")
    _copy(figures.iterdir(), source / "figures", RESULTS)
    report = (figures / "reproduction.md").read_text(encoding="utf-8")
    (source / "figures/reproduction.md").write_text(results.narrower(report), encoding="utf-8")
    (source / "notebooks").mkdir()
    for path in executed:
        nbformat.write(shown(path), source / "notebooks" / path.name)
    runs = results.runs(root, figures, source / "notebooks", run.profile)
    for name, text in (
        ("results", results.index(runs)),
        ("tables", results.tables(runs)),
        ("gallery", results.gallery(runs)),
        ("print", results.print_size(runs, source)),
        ("cite", citation.page(root)),
    ):
        (source / f"{name}.md").write_text(text, encoding="utf-8")


def _copy(paths: Iterable[Path], folder: Path, suffixes: Sequence[str] = ()) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        if not suffixes or path.suffix in suffixes:
            shutil.copy2(path, folder)


def shown(path: Path) -> nbformat.NotebookNode:
    """Return an executed notebook without the folders that it ran in, and with links."""
    notebook = nbformat.read(path, as_version=4)
    notebook.metadata.pop("papermill", None)
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = cell.source.replace("](../docs/source/", "](../")
        if "injected-parameters" in cell.metadata.get("tags", []):
            lines = cell.source.splitlines()
            cell.source = "\n".join(line for line in lines if not _SET_BY_PIPELINE.match(line))
    notebook.cells = [cell for cell in notebook.cells if cell.source != "# Parameters"]
    results.name_images(notebook.cells)
    links = f"[Inputs and results](../results.md), [the notebook as executed](path:{path.name})"
    notebook.cells.insert(1, nbformat.v4.new_markdown_cell(links, id="site-links"))
    return notebook
