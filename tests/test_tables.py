"""Tables in their three formats."""

import csv
import io

from robsmooth.tables import Table

TABLE = Table(
    columns=("what", "$x_1$ | y"),
    rows=[("a_b & 5%", 0.123456789), ("± 1 < 2", None), ("many", 50_000)],
    caption="A caption with 100% & more.",
    digits=3,
)


def test_markdown_keeps_its_columns_whatever_the_cells_hold():
    lines = TABLE.markdown().splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert len(rows) == 2 + len(TABLE.rows)
    assert {row.replace(r"\|", "").count("|") for row in rows} == {3}
    assert "0.123" in rows[2] and "0.1234" not in rows[2]
    assert lines[-1] == "*A caption with 100% & more.*"


def test_latex_escapes_text_and_leaves_mathematics_alone():
    text = TABLE.latex()
    assert r"a\_b \& 5\%" in text
    assert "$x_1$" in text
    assert r"$\pm$ 1 $<$ 2" in text
    body = text[text.index(r"\midrule") : text.index(r"\bottomrule")]
    assert body.count(r" \\") == len(TABLE.rows)


def test_csv_holds_twelve_digits():
    rows = list(csv.reader(io.StringIO(TABLE.csv())))
    assert rows[0] == list(TABLE.columns)
    assert float(rows[1][1]) == 0.123456789
    assert rows[2][1] == ""


def test_saving_writes_the_three_formats(tmp_path):
    TABLE.save(tmp_path, "table")
    found = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert found == {
        "table.md": TABLE.markdown(),
        "table.csv": TABLE.csv(),
        "table.tex": TABLE.latex(),
    }


def test_a_notebook_shows_the_table_as_markdown():
    assert TABLE._repr_markdown_() == TABLE.markdown()
