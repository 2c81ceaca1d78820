"""Pages on what was regenerated: the index of every result, tables, a gallery, print size."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import nbformat

from robsmooth._support.tables import Table
from robsmooth.workbench import parameters as parameters_cell
from robsmooth.workbench.parameters import SET_BY_PIPELINE

_SAVED = re.compile(r"""save_figure\([^"']*["'](\w+)["']\)""")
_IMAGE = re.compile(r"!\[(.+?)\]\((\w+)\.png\)")
_TABLE = re.compile(r"(?:^\|.*\n)+", flags=re.MULTILINE)
_WIDTH = re.compile(r'<svg[^>]*?\swidth="([\d.]+)pt"')
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_ALTERNATIVE = 240  # characters that a reader of a screen hears before the caption itself
_POINTS = 72  # to the inch
_COLUMN = 3.4  # inches


@dataclass(frozen=True)
class Result:
    """A figure, table or data file in all its formats.

    Attributes
    ----------
    name : str
        Its path from the project's folder, without suffix.
    suffixes : tuple of str
        Of its files, without the dot.
    caption : str
        What the figure shows, in Markdown; else what the table does.
    table : str
        The table in Markdown; empty where it is none.
    """

    name: str
    suffixes: tuple[str, ...]
    caption: str
    table: str

    @property
    def stem(self) -> str:
        """Its name without the folder."""
        return self.name.rpartition("/")[2]

    @property
    def is_figure(self) -> bool:
        """Whether it has an image."""
        return "png" in self.suffixes


@dataclass(frozen=True)
class Run:
    """What one run has made, and its provenance.

    Attributes
    ----------
    title : str
        What ran.
    page : str
        Where the site shows it.
    command : str
        What runs it anew.
    parameters : mapping
        Values that its notebook ran with.
    about : mapping
        The provenance.
    results : tuple of Result
    """

    title: str
    page: str
    command: str
    parameters: Mapping[str, object]
    about: Mapping
    results: tuple[Result, ...]


def runs(root: Path, figures: Path, notebooks: Path, profile: str) -> list[Run]:
    """Return all runs: of each notebook, of the verdicts, and of the benchmark.

    Parameters
    ----------
    root : Path
        The project.
    figures, notebooks : Path
        Folders with the results of the profile, and with the executed notebooks.
    profile : str
    """
    of_profile = "" if profile == "paper" else f" PROFILE={profile}"
    found = []
    for path in sorted(notebooks.glob("*.ipynb")):
        about = _read(figures / f"{path.stem}.provenance.json")
        cells = nbformat.read(path, as_version=4).cells
        only = path.name[:2] if path.name[:2].isdigit() else path.stem
        found.append(
            Run(
                title=cells[0].source.splitlines()[0].lstrip("# "),
                page=f"notebooks/{path.name}",
                command=f"make figures ONLY={only}{of_profile}",
                parameters=_parameters(root / "notebooks" / path.name, about),
                about=about,
                results=_results(about["files"], figures, dict(_captions(cells))),
            )
        )
    verdicts = Run(
        title="Verdicts",
        page="figures/reproduction.md",
        command=f"make figures{of_profile}",
        parameters={},
        about=_read(figures / "reproduction.provenance.json"),
        results=_results(["figures/reproduction.md", "figures/reproduction.csv"], figures, {}),
    )
    benchmarks = root / "benchmarks"
    names = [path.name for name in ("scaling", "results") for path in benchmarks.glob(f"{name}.*")]
    images = _IMAGE.findall((benchmarks / "results.md").read_text(encoding="utf-8"))
    captions = {name: f"{words}." for words, name in images}
    speed = Run(
        title="Speed",
        page="benchmarks/results.md",
        command="make bench",
        parameters={},
        about=_read(benchmarks / "results.json")["about"],
        results=_results([f"benchmarks/{name}" for name in sorted(names)], figures, captions),
    )
    return [*found, verdicts, speed]


def _read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def _parameters(notebook: Path, about: Mapping) -> dict[str, object]:
    """Values of a run: those that were given, and the notebook's own for the others."""
    return {
        name: about["parameters"].get(name, parameter.default)
        for name, parameter in parameters_cell.read(notebook).items()
        if name not in SET_BY_PIPELINE
    }


def _captions(cells: Sequence[nbformat.NotebookNode]) -> Iterator[tuple[str, str]]:
    """Find the figures that a notebook saves, and the paragraph in italics below each."""
    for cell, below in pairwise(cells):
        if cell.cell_type == "code" and below.source.startswith("*"):
            caption = below.source.split("\n\n")[0].strip("*").replace("\n", " ")
            for name in _SAVED.findall(cell.source):
                yield name, caption


def alternative(caption: str) -> str:
    """Return the first sentences of a caption, as the text for who cannot see the figure."""
    words = _LINK.sub(r"\1", caption).replace("\n", " ")
    words = words.replace(r"\ge", "≥").replace(r"\le", "≤").replace(r"\mathrm", "")
    words = re.sub(r"[$*`{}\\]", "", re.sub(r"(?<=[A-Za-z])\\", " ", words))
    first, *others = re.split(r"(?<=[.!?]) (?=[A-Z])", words)
    if re.fullmatch(r"Fig\. *", first) and others:
        first += f" {others.pop(0)}"
    for sentence in others:
        if len(first) + len(sentence) > _ALTERNATIVE:
            break
        first += f" {sentence}"
    return first.strip()


def name_images(cells: Sequence[nbformat.NotebookNode]) -> None:
    """Give the image of each cell the text of the caption below it, for the site."""
    for cell, below in pairwise(cells):
        if cell.cell_type == "code" and below.source.startswith("*"):
            caption = below.source.split("\n\n")[0].strip("*")
            cell.metadata.setdefault("mystnb", {})["image"] = {"alt": alternative(caption)}


def _results(
    files: Iterable[str], figures: Path, captions: Mapping[str, str]
) -> tuple[Result, ...]:
    """Gather the files of each result."""
    suffixes: dict[str, list[str]] = {}
    for file in files:
        if not file.endswith(".provenance.json"):
            name, _, suffix = file.rpartition(".")
            suffixes.setdefault(name, []).append(suffix)
    results = []
    for name, each in suffixes.items():
        stem = name.rpartition("/")[2]
        is_table = {"md", "csv"} <= {*each} and stem != "reproduction"  # that is a page
        table = (figures / f"{stem}.md").read_text(encoding="utf-8") if is_table else ""
        caption = table.strip().rpartition("\n")[2].strip("*")
        if "png" in each:
            caption = captions.get(stem, caption)
        results.append(Result(name, tuple(each), caption, table))
    return tuple(results)


def narrower(report: str) -> str:
    """Return the report of the verdicts with tables that are as wide as a page.

    A verdict that all rows of a table share is in its heading; a difference has two digits.
    """
    return _TABLE.sub(lambda found: _narrower(found[0]), report)


def _narrower(table: str) -> str:
    lines = (line.removeprefix("| ").removesuffix(" |") for line in table.splitlines())
    rows = [line.split(" | ") for line in lines]
    columns = list(zip(*rows, strict=True))
    for header, _, *cells in list(columns):
        if header == "verdict" and len({*cells}) == 1:
            columns = [column for column in columns if column[0] != header]
    rounded = [
        (*column[:2], *(f"{float(cell):.2g}" if cell else "" for cell in column[2:]))
        if column[0] == "relative difference"
        else column
        for column in columns
    ]
    return "".join(f"| {' | '.join(row)} |\n" for row in zip(*rounded, strict=True))


def index(found: Iterable[Run]) -> str:
    """Return the page that says of every result how it came about."""
    parts = [
        "# Figure index",
        "Every figure, table and data file, with what made it: this is the provenance that is "
        "written beside each result. The same inputs give the same bytes. Common inputs of all "
        "notebooks are `data/published.toml`, which holds what the paper prints, the least errors "
        "with the sine in `data/nonlinear_floor.json`, and the locked environment.",
    ]
    for run in found:
        parts += [f"## {run.title}", _facts(run), _files(run.results)]
    return "\n\n".join(parts) + "\n"


def _facts(run: Run) -> str:
    about, machine, revision = run.about, run.about["machine"], run.about["revision"]
    given = ", ".join(f"`{name} = {value!r}`" for name, value in run.parameters.items())
    changed = ", with changes" if revision and revision["dirty"] else ""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    rows = (
        ("page", f"[{run.page}]({run.page})"),
        ("command", f"`{run.command}`"),
        ("parameters", given or "none"),
        ("seed", "none" if about["seed"] is None else str(about["seed"])),
        ("run time", f"{about['run_time_seconds']:.1f} s, on {about['written'][:10]}"),
        ("machine", f"{machine['processor']}, {machine['cores']} cores, {machine['platform']}"),
        ("revision", f"`{revision['commit'][:12]}`{changed}" if revision else "none"),
        ("lock", f"`{(about['lock_sha256'] or 'none')[:12]}`"),
        ("versions", versions),
    )
    return Table(("inputs", ""), rows, "").markdown()


def _files(results: Iterable[Result]) -> str:
    rows = []
    for result in results:
        words = alternative(result.caption) if result.is_figure else ""
        seen = [f"![{words}]({result.name}.png){{width=9em}}"] if words else []
        seen += [f"[table](#table-{result.stem})"] if result.table else []
        links = [
            f"[{suffix}]({result.name}.{suffix})"
            for suffix in result.suffixes
            if not (result.table and suffix == "md")  # it is on the page of all tables
        ]
        rows.append((f"`{result.stem}`", " ".join(seen), result.caption, " ".join(links)))
    return Table(("result", "", "what it shows", "files"), rows, "").markdown()


def tables(found: Iterable[Run]) -> str:
    """Return the page with all tables, by their notebooks."""
    parts = ["# Tables"]
    for run in found:
        chosen = [result for result in run.results if result.table]
        parts += [f"## {run.title}"] if chosen else []
        for result in chosen:
            link = f"[CSV]({result.name}.csv)"
            parts.append(f"(table-{result.stem})=\n### `{result.stem}`")
            parts.append(f"{result.table.strip()}\n\n{link}")
    return "\n\n".join(parts) + "\n"


def gallery(found: Iterable[Run]) -> str:
    """Return the page with all figures as small images, which lead to what makes them."""
    parts = [
        "# Gallery",
        "Every figure and what it shows. An image leads to the page that makes it.",
    ]
    for run in found:
        figures = [result for result in run.results if result.is_figure]
        parts += [f"## {run.title}"] if figures else []
        for result in figures:
            options = {"target": f"{run.page.rpartition('.')[0]}.html", "figclass": "thumbnail"}
            caption = f"{result.caption} [Where it is made]({run.page})"
            parts.append(_figure(result, options, caption))
    return "\n\n".join(parts) + "\n"


def print_size(found: Iterable[Run], source: Path) -> str:
    """Return the page with all figures at the width that they have in print."""
    parts = [
        "# Figures at print size",
        "As wide as in print, where a column is 3.4 inches: text must be legible at this size.",
        '<label><input type="checkbox" id="grey"> in grey, as a printer without colours has '
        "them</label>",
    ]
    for run in found:
        for result in run.results:
            if result.is_figure and (source / f"{result.name}.svg").is_file():
                width = _inches(source / f"{result.name}.svg")
                wide = " wide" if round(width, 2) > _COLUMN else ""
                options = {"width": f"{width:.4g}in", "figclass": f"print-size{wide}"}
                caption = f"{result.caption} `{result.stem}`, {width:.2g} in"
                parts.append(_figure(result, options, caption))
    return "\n\n".join(parts) + "\n"


def _figure(result: Result, options: Mapping[str, str], caption: str) -> str:
    given = {"alt": alternative(result.caption), **options}
    lines = (
        f":::{{figure}} {result.name}.png",
        *(f":{name}: {value}" for name, value in given.items()),
        "",
        caption,
        ":::",
    )
    return "\n".join(lines)


def _inches(svg: Path) -> float:
    with open(svg, encoding="utf-8") as file:
        return float(_WIDTH.search(file.read(2000))[1]) / _POINTS
