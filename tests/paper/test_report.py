"""The report of the reproduction, and what is committed of it."""

import csv
from collections import Counter
from pathlib import Path

import pytest

from robsmooth.paper import report, tables
from robsmooth.paper import verdicts as reproduction
from robsmooth.paper.verdicts import Verdict
from robsmooth.simulation.statistics import MeanSquare

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def verdicts():
    return reproduction.verdicts()


def zero(name):
    return Verdict(name, "IV-B", "0", 0.0, None, reproduction.REPRODUCED, "")


def test_the_scorecard_counts_every_verdict_once(verdicts):
    rows = report.scorecard(verdicts).rows
    assert rows[-1][1] + rows[-1][2] == len(verdicts)
    assert sum(row[1] + row[2] for row in rows[:-1]) == len(verdicts)
    counted = Counter(verdict.verdict for verdict in verdicts)
    assert {row[0]: row[1] + row[2] for row in rows[:-1]} == counted


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.0884870123, 0.00000384, "0.0884870 ± 0.0000038"),
        (0.5, 0.0996, "0.50 ± 0.10"),
        (47.69, 12.4, "48 ± 12"),
        (3000.4, 123.0, "3000 ± 123"),
        (0.05, 0.0, "0.05"),
        (0.05, float("nan"), "0.05"),
        (float("nan"), float("nan"), "none"),
    ],
)
def test_an_estimate_has_the_digits_that_its_error_leaves(value, error, text):
    assert tables.estimate(MeanSquare(value, error)) == text


def test_reproduced_zeros_share_a_row_and_nothing_else_does():
    number = Verdict("A[0, 1]", "IV-B", "2", 2.0, 0.0, reproduction.REPRODUCED, "")
    noise = Verdict("A[1, 1]", "IV-B", "0.1", 0.0, -1.0, reproduction.NOT_REPRODUCED, "noise")
    given = [zero("A[0, 0]"), number, zero("A[1, 0]"), noise, zero("B[0, 0]")]
    names = [row[0] for row in report.table(given, merge_zeros=True).rows]
    assert names == ["A, 2 zeros", "A[0, 1]", "A[1, 1]", "B[0, 0]"]


def test_writing_gives_report_table_and_provenance(tmp_path, verdicts):
    written = report.write(tmp_path, ROOT / "data")
    assert written == verdicts
    found = {path.name for path in tmp_path.iterdir()}
    assert found == {"reproduction.md", "reproduction.csv", "reproduction.provenance.json"}
    text = (tmp_path / "reproduction.md").read_text()
    for verdict in verdicts:
        if verdict.verdict == reproduction.NOT_REPRODUCED:
            assert verdict.reason.replace("|", r"\|") in text


def test_a_report_is_written_anew_where_it_says_something_else(tmp_path):
    report.write(tmp_path, ROOT / "data")
    about = tmp_path / "reproduction.provenance.json"
    about.write_text("as it was")
    report.write(tmp_path, ROOT / "data")
    assert about.read_text() == "as it was"
    text = (tmp_path / "reproduction.md").read_text()
    (tmp_path / "reproduction.md").write_text(text + "touched up\n")
    report.write(tmp_path, ROOT / "data")
    assert (tmp_path / "reproduction.md").read_text() == text
    assert about.read_text() != "as it was"


def test_the_committed_report_is_what_is_recomputed(verdicts):
    with (ROOT / "figures" / "reproduction.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["what"] for row in rows] == [verdict.name for verdict in verdicts]
    for row, verdict in zip(rows, verdicts, strict=True):
        assert row["verdict"] == verdict.verdict
        if isinstance(verdict.value, float):
            assert float(row["ours"]) == pytest.approx(verdict.value, rel=1e-4, abs=1e-12)


def test_the_readme_shows_the_scorecard_of_the_committed_results(tmp_path, verdicts):
    readme = tmp_path / "README.md"
    readme.write_text((ROOT / "README.md").read_text())
    report.write_scorecard(readme, verdicts)
    assert readme.read_text() == (ROOT / "README.md").read_text()


def test_a_readme_without_the_marks_is_refused(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("# nothing here\n")
    with pytest.raises(ValueError, match=r"README\.md must have the marks"):
        report.write_scorecard(readme, [])
    assert readme.read_text() == "# nothing here\n"


@pytest.mark.parametrize("name", ["fig1", "fig2", "fig3", "fig4", "monte_carlo"])
def test_the_committed_figures_are_there_in_all_formats(name):
    for suffix in ("pdf", "svg", "png"):
        assert (ROOT / "figures" / f"{name}.{suffix}").stat().st_size > 1000


@pytest.mark.parametrize("name", ["table_1", "designs", "monte_carlo"])
def test_the_committed_tables_are_there_in_all_formats(name):
    for suffix in ("md", "csv"):
        assert (ROOT / "figures" / f"{name}.{suffix}").stat().st_size > 100
