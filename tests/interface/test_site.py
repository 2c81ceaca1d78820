"""The site: how it is put together. What it holds is tested with test_notebooks' own run."""

import re
import subprocess
import sys
from importlib import metadata
from itertools import pairwise
from pathlib import Path

import nbformat
import pytest

import docs.__main__
import robsmooth as rs
from docs import build, citation, references, results
from robsmooth.workbench.parameters import PipelineError

ROOT = Path(__file__).resolve().parents[2]
THEORY = (build.SOURCE / "theory.md").read_text(encoding="utf-8")


def notebook(source="", **papermill):
    cells = [nbformat.v4.new_code_cell(source)] if source else []
    return nbformat.v4.new_notebook(cells=cells, metadata={"papermill": papermill})


def report(folder):
    command = [sys.executable, "-m", "docs", "--build", folder]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_a_notebook_that_was_not_executed_is_asked_for_in_a_sentence(tmp_path):
    run = report(tmp_path)
    assert run.returncode == 2
    assert run.stderr == (
        "robsmooth: 01_uncertainty_modelling.ipynb has not been executed with this profile; "
        "run `make figures PROFILE=paper` first\n"
    )
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    "about", [{}, {"end_time": None}, {"end_time": "now", "exception": True}], ids=str
)
def test_a_notebook_that_was_not_executed_to_its_end_is_refused(tmp_path, about):
    path = tmp_path / "quick/notebooks/01_uncertainty_modelling.ipynb"
    path.parent.mkdir(parents=True)
    nbformat.write(notebook(**about), path)
    with pytest.raises(PipelineError, match="has not been executed to its end; run `make figures"):
        build.build(ROOT, "quick", tmp_path)


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A build without notebooks, in which Sphinx is what the test says."""

    def run(sphinx):
        monkeypatch.setattr(build, "plan", lambda *_: [])
        monkeypatch.setattr(build, "stage", lambda *_: None)
        monkeypatch.setattr(build, "build_main", sphinx)
        (tmp_path / "quick").mkdir(exist_ok=True)
        return build.build(ROOT, "quick", tmp_path)

    return run


def test_a_new_site_takes_the_place_of_the_earlier_one_when_it_is_whole(stub, tmp_path):
    def sphinx(name):
        def write(options):
            assert not (tmp_path / "quick/site" / name).exists()
            Path(options[-1]).mkdir()
            (Path(options[-1]) / name).touch()
            return 0

        return write

    for name in ("one.html", "other.html"):
        assert stub(sphinx(name)) == tmp_path / "quick/site"
        assert [path.name for path in (tmp_path / "quick/site").iterdir()] == [name]
    assert stub(lambda options: 1) is None
    assert (tmp_path / "quick/site/other.html").exists()
    assert [path.name for path in (tmp_path / "quick").iterdir()] == ["site"]


def test_the_folders_of_a_run_are_not_shown(tmp_path):
    path = tmp_path / "some.ipynb"
    for source, shown in (
        ('# Parameters\npoints = 21\noutput_dir = "/home/me"', ["# Parameters\npoints = 21"]),
        ('# Parameters\noutput_dir = "/home/me"\ndata_dir = "/home/me"', []),
    ):
        executed = notebook(source, input_path="/home/me/some.ipynb")
        executed.cells[0].metadata.tags = ["injected-parameters"]
        nbformat.write(executed, path)
        notebook_shown = build.shown(path)
        cells = [cell for cell in notebook_shown.cells if cell.cell_type == "code"]
        assert [cell.source for cell in cells] == shown
        assert "/home/me" not in nbformat.writes(notebook_shown)


def quoted_equations():
    paths = [
        *ROOT.glob("robsmooth/**/*.py"),
        *(ROOT / "data/published.toml", ROOT / "figures/reproduction.md", ROOT / "README.md"),
        *ROOT.glob("notebooks/*.ipynb"),
    ]
    return {
        found[1]
        for path in paths
        for found in references.QUOTED.finditer(path.read_text(encoding="utf-8"))
        if found[1]
    }


def test_every_equation_that_is_quoted_is_on_the_page_of_equations():
    assert quoted_equations() <= references.equation_numbers(THEORY).keys()
    assert len(quoted_equations()) > 10


def test_the_equations_have_rising_numbers():
    numbers = [int(number) for number in re.findall(r"\\tag\{(\d+)\}", THEORY)]
    assert numbers == sorted(set(numbers))
    labels = re.findall(r"^\((eq\w+)\)=$", THEORY, flags=re.MULTILINE)
    assert list(references.equation_numbers(THEORY)) == labels


def test_the_page_of_equations_quotes_the_errors_of_the_example():
    paper = rs.homodyne.PAPER
    system = paper.uncertain_system()
    filtered = rs.stationary_errors(paper, rs.baselines.ngcf(system)).filtered
    phase = paper.kappa / (2 * paper.lam)
    assert f"$Ee^2$ is {filtered:.3f} rad²" in THEORY
    assert f"$E\\phi^2 = \\kappa/2\\lambda_\\phi$ is {phase:.2f} rad²" in THEORY
    least = rs.minimize_bound(rs.augment(system, 3.1e-6, 2), "filtered")
    assert (least.multipliers[2:] < 1e-3).all()


def test_every_page_that_docstrings_name_is_one_on_the_methods():
    named = {
        found[0]
        for path in ROOT.glob("robsmooth/**/*.py")
        for found in re.finditer(r"docs/source/\w+\.md", path.read_text(encoding="utf-8"))
    }
    assert len(named) == 4
    assert all(references.METHODS.fullmatch(name) and (ROOT / name).is_file() for name in named)


def test_what_only_looks_like_a_quoted_equation_is_left_alone():
    assert not references.QUOTED.search("solve(equations), (equation), assumptions")
    assert references.QUOTED.findall("(eqbound) by Assumption 3.2") == [("eqbound", ""), ("", "3")]


def test_the_gallery_has_each_figure_with_its_caption_and_its_notebook():
    files = ("fig1", ("png", "svg"), "A loop.", ""), ("table_1", ("md", "csv"), "Values.", "| a |")
    made = tuple(results.Result(*file) for file in files)
    runs = [
        results.Run("How?", "notebooks/01_how.ipynb", "make", {}, {}, made),
        results.Run("Verdicts", "figures/reproduction.md", "make", {}, {}, made[1:]),
    ]
    _, title, figure = results.gallery(runs).split("\n\n", 3)[1:]
    assert title == "## How?"
    head = ":::{figure} fig1.png\n:alt: A loop.\n:target: notebooks/01_how.html\n"
    assert figure.startswith(head)
    assert "A loop. [Where it is made](notebooks/01_how.ipynb)" in results.gallery(runs)
    assert "Verdicts" not in results.gallery(runs) and "Values" not in results.gallery(runs)


@pytest.mark.parametrize(
    ("caption", "words"),
    [
        (
            "Fig. 4. *Error* of the [NGCF](x.md).",
            "Fig. 4. Error of the NGCF.",
        ),
        (r"Where $\Delta_2 = -1$ the `edge` is.", "Where Delta_2 = -1 the edge is."),
        (r"Here $\hat\phi \ge 0$.", "Here hat phi ≥ 0."),
        (f"First. {'Much ' * 60}later. Last.", "First."),
    ],
)
def test_an_image_is_told_in_the_first_words_of_its_caption(caption, words):
    assert results.alternative(caption) == words


def saved_figures():
    """The cells that save a figure, and the cells below them."""
    for path in sorted(ROOT.glob("notebooks/[0-9][0-9]_*.ipynb")):
        cells = nbformat.read(path, as_version=4).cells
        results.name_images(cells)
        for cell, below in pairwise(cells):
            if cell.cell_type == "code" and "save_figure(" in cell.source:
                yield pytest.param(cell, below, id=re.search(r'"(\w+)"\)', cell.source)[1])


@pytest.mark.parametrize(("cell", "below"), [*saved_figures()])
def test_each_figure_of_a_notebook_has_words_that_say_what_it_shows(cell, below):
    words = cell.metadata["mystnb"]["image"]["alt"]
    assert 20 < len(words) < 500
    assert below.source.startswith("*" + words[:3]) or below.source.startswith("*$")
    assert not set("$*\\{}\n") & set(words)


def test_the_images_of_the_pages_have_words_that_say_what_they_show():
    pages = [ROOT / "README.md", ROOT / "benchmarks/results.md", *build.SOURCE.rglob("*.md")]
    texts = [path.read_text(encoding="utf-8") for path in pages]
    images = re.findall(r"!\[(.*?)\]\(([^)]*)\)", "\n".join(texts))
    assert len(images) >= 2
    for words, file in images:
        assert len(words.split()) > 8, file


def test_the_citation_has_what_the_file_says():
    page = citation.page(ROOT)
    assert "@misc{robsmooth,\n  title = {{robsmooth: robust" in page
    assert "  author = {Rehman, Obaid Ur and Petersen, Ian R.},\n" in page
    assert "  author = {{the robsmooth developers}},\n" in page
    assert f"  version = {{{metadata.version('robsmooth')}}},\n" in page


def test_a_work_with_a_journal_is_an_article():
    work = {
        "title": "On Lags",
        "authors": [{"family-names": "Doe", "given-names": "Jo"}],
        "journal": "Automatica",
        "year": 1974,
        "doi": "10.1/2",
    }
    assert citation.reference(work) == "Jo Doe, *On Lags*, Automatica, 1974, 10.1/2."
    assert citation.bibtex("doe", work) == (
        "@article{doe,\n"
        "  title = {{On Lags}},\n"
        "  author = {Doe, Jo},\n"
        "  journal = {Automatica},\n"
        "  year = {1974},\n"
        "  doi = {10.1/2},\n"
        "}"
    )


def test_warnings_of_sphinx_fail_the_command(monkeypatch, capsys):
    monkeypatch.setattr(docs.__main__, "build", lambda *_: None)
    assert docs.__main__.main([]) == 1
    assert capsys.readouterr().err.startswith("robsmooth: no new site was made")


def test_a_verdict_that_all_rows_share_is_left_out_and_differences_are_rounded():
    report = (
        "# Verdicts\n\n"
        "| what | printed | relative difference | verdict | why |\n"
        "| --- | --- | --- | --- | --- |\n"
        "| V | 0.15 | -0.132711 | not reproduced | \\|f\\| is large |\n"
        "| tau | 1.13e-6 s |  | not reproduced |  |\n\n"
        "*Some.*\n\n"
        "| what | relative difference | verdict |\n| --- | --- | --- |\n"
        "| V | 1.23e-05 | reproduced |\n| tau | -1 | not reproduced |\n"
    )
    assert results.narrower(report) == (
        "# Verdicts\n\n"
        "| what | printed | relative difference | why |\n"
        "| --- | --- | --- | --- |\n"
        "| V | 0.15 | -0.13 | \\|f\\| is large |\n"
        "| tau | 1.13e-6 s |  |  |\n\n"
        "*Some.*\n\n"
        "| what | relative difference | verdict |\n| --- | --- | --- |\n"
        "| V | 1.2e-05 | reproduced |\n| tau | -1 | not reproduced |\n"
    )


def test_the_report_keeps_its_printed_numbers_on_the_site():
    report = (ROOT / "figures/reproduction.md").read_text(encoding="utf-8")
    shown = results.narrower(report)
    assert len(shown) < len(report)
    for line, ours in zip(report.splitlines(), shown.splitlines(), strict=True):
        assert line.split(" | ")[:4] == ours.split(" | ")[:4]
