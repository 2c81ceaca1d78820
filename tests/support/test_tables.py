"""Tables in their formats."""

import csv
import io
import math
from dataclasses import replace
from html.parser import HTMLParser

from robsmooth._support.tables import Table

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


def test_records_make_a_row_each_under_the_columns_of_the_fullest():
    records = [{"a": 1, "c": "last"}, {"a": 2, "b": 0.5, "c": ""}, {"d": 3}]
    table = Table.of_records(iter(records), "A caption.", digits=3)
    assert table.columns == ("a", "b", "c", "d")
    assert table.rows == [(1, None, "last", None), (2, 0.5, "", None), (None, None, None, 3)]
    assert (table.caption, table.digits) == ("A caption.", 3)


def test_csv_holds_twelve_digits():
    rows = list(csv.reader(io.StringIO(TABLE.csv())))
    assert rows[0] == list(TABLE.columns)
    assert float(rows[1][1]) == 0.123456789
    assert rows[2][1] == ""


def test_without_a_caption_none_is_written():
    bare = replace(TABLE, caption="")
    assert TABLE.markdown() == f"{bare.markdown()}\n*{TABLE.caption}*\n"
    assert "caption" in TABLE.html()
    assert "caption" not in bare.html()


def test_saving_writes_both_formats(tmp_path):
    TABLE.save(tmp_path, "table")
    found = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert found == {
        "table.md": TABLE.markdown(),
        "table.csv": TABLE.csv(),
    }


def test_a_notebook_shows_the_table_as_html():
    assert TABLE._repr_html_() == TABLE.html()


class Cells(HTMLParser):
    """Rows of (tag, alignment, words), and the caption."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.caption, self.inside = [], "", None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.inside = tag if tag != "sup" else self.inside
        if tag == "tr":
            self.rows.append([])
        elif tag in ("th", "td"):
            style = dict(attributes).get("style", "")
            self.rows[-1].append([tag, style.removeprefix("text-align: "), ""])

    def handle_endtag(self, tag):
        self.inside = None if tag not in ("sup", "sub") else self.inside

    def handle_data(self, data):
        if self.inside == "caption":
            self.caption += data
        elif self.inside in ("th", "td"):
            self.rows[-1][-1][2] += data


def test_html_has_the_cells_of_the_table_and_escapes_their_text():
    cells = Cells(TABLE.html())
    assert cells.caption == TABLE.caption
    assert [[cell[2] for cell in row] for row in cells.rows] == [
        ["what", r"\(x_1\) | y"],
        ["a_b & 5%", "0.123"],
        ["± 1 < 2", ""],
        ["many", "50000"],
    ]
    assert [cell[0] for cell in cells.rows[0]] == ["th", "th"]
    assert "a_b &amp; 5%" in TABLE.html() and "± 1 &lt; 2" in TABLE.html()


def test_html_scrolls_in_a_box_of_its_own():
    text = TABLE.html()
    assert text.startswith('<div style="overflow-x: auto">\n<table ')
    assert text.endswith("</table>\n</div>\n")


def test_numbers_are_aligned_right_and_words_left():
    table = Table(
        columns=("name", "float", "count", "share", "mixed", "empty", "infinite"),
        rows=[
            ("a", 1.5e-7, 3, "41%", 1.0, None, math.inf),
            ("b", -2.0, 4, "0.06 ± 0.01", "none", None, math.nan),
        ],
        caption="",
    )
    header, first, _ = Cells(table.html()).rows
    sides = ["left", "right", "right", "right", "left", "left", "right"]
    assert [cell[1] for cell in header] == [cell[1] for cell in first] == sides
    assert "1.5×10<sup>-7</sup>" in table.html()


def test_mathematics_is_marked_and_a_lone_dollar_sign_is_none():
    table = Table(
        ("a",), [(r"$\begin{bmatrix}1 & 2\end{bmatrix}$",), ("5 $",), ("$a$ or 1 $",)], ""
    )
    text = table.html()
    assert r"\(\begin{bmatrix}1 &amp; 2\end{bmatrix}\)" in text
    assert ">5 $<" in text
    assert r"\(a\) or 1 $" in text


def test_a_table_without_rows_has_its_header():
    assert [[cell[2] for cell in row] for row in Cells(Table(("a", "b"), [], "").html()).rows] == [
        ["a", "b"]
    ]
