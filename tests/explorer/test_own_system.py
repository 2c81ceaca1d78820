"""The page for a system of one's own: its examples, its code, and what it refuses."""

from html import escape

import numpy as np
import pytest

import robsmooth as rs
from robsmooth.explorer.own_system import EXAMPLES, OwnSystem, code_of

FIELDS = ("A", "B1", "C0", "C2", "D21", "uncertain", "delay")
SIGNAL = ("-1", "1 0", "1", "1", "0 0.1", "A[0,0] 10%\nC2[0,0] 5%", 0.2)
TYPED = dict(zip(FIELDS, SIGNAL, strict=True), order=2)


def run(code):
    names = {"print": lambda *_: None}
    exec(code.replace("rs.best_smoother(plant)", "None").replace("choice.table", "None"), names)
    return names


@pytest.mark.parametrize("example", EXAMPLES)
def test_code_of_an_example_makes_its_system(example):
    names = run(code_of(dict(zip(FIELDS, EXAMPLES[example], strict=True), order=3)))
    for uncertainty, channel in zip(
        names["uncertainties"], names["system"].uncertainties, strict=False
    ):
        assert np.array_equal(uncertainty.C, channel.C)
    assert names["plant"].order == 3


def test_the_mirror_is_that_of_the_library():
    (mirror,) = [text for name, text in EXAMPLES.items() if "mirror" in name]
    found = run(code_of(dict(zip(FIELDS, mirror, strict=True), order=2)))["system"]
    library = rs.examples.resonant_phase()
    for name in ("A", "B1", "C0", "C2", "D21"):
        assert np.allclose(getattr(found, name), getattr(library, name), rtol=1e-3), name
    effects = [np.abs(u.B @ u.C) for u in (found.uncertainties[0], library.uncertainties[0])]
    assert np.allclose(*effects, rtol=1e-3)


def test_uncertain_entries_are_shares_of_the_numbers():
    text = TYPED | {"A": "-1 3; 0 -2", "B1": "1 0 0; 0 1 0", "C0": "1 0", "C2": "1 4"}
    text |= {"D21": "0 0 0.1", "uncertain": "A[0,1] 10%\n\n C2[0, 1]  25 %"}
    rate, gain = run(code_of(text))["uncertainties"]
    assert np.allclose(rate.B @ rate.C, [[0.0, 0.3], [0.0, 0.0]])
    assert not rate.D.any()
    assert np.allclose(gain.D @ gain.C, [[0.0, 1.0]])
    assert not gain.B.any()


@pytest.mark.parametrize(
    ("field", "typed", "sentence"),
    [
        ("A", "1 2\n3", r"A must be rows of as many numbers each, .* got '1 2\\n3'"),
        ("B1", "one", "B1 must be rows of as many numbers each"),
        ("uncertain", "A[0,0]", r"an uncertain entry must be A\[row,column\] .* got 'A\[0,0\]'"),
        ("uncertain", "D21[0,0] 5%", "an uncertain entry must be"),
        ("A", "nan", "A must be rows of as many numbers each, .* got 'nan'"),
        (
            "uncertain",
            "A[0,1] 5%",
            r"must be an entry of A, of shape \(1, 1\), .* got 'A\[0,1\] 5%'",
        ),
        ("uncertain", "C2[1,0] 5%", r"must be an entry of C2, of shape \(1, 1\)"),
    ],
)
def test_what_cannot_be_read_is_named(field, typed, sentence):
    with pytest.raises(ValueError, match=sentence):
        run(code_of(TYPED | {field: typed}))


def test_an_entry_of_zero_has_no_per_cent():
    with pytest.raises(ValueError, match=r"an entry of A, .* that is not zero, got"):
        code_of(TYPED | {"A": "0", "uncertain": "A[0,0] 5%"})


def test_the_page_answers_with_the_librarys_sentence_and_table():
    page, answers = OwnSystem(), []
    page.answer.observe(lambda change: answers.append(change["new"]), "value")
    page.example.label = next(name for name in EXAMPLES if "clock" in name)
    page.fields["order"].value = 2
    page.button.click()
    assert "fa-spinner" in answers[0]
    plant = rs.augment(run(page.code.value)["system"], delay=3.0, order=2)
    choice = rs.best_smoother(plant)
    assert choice.sentence in page.answer.value
    assert all(escape(name) in page.answer.value for name in choice.candidates)
    page.example.index = 0
    assert page.answer.value == page.code.value == ""


@pytest.mark.parametrize(
    ("field", "typed"), [("C2", "1 2 3"), ("delay", -1.0), ("D21", "0 <b>"), ("D21", "0 0")]
)
def test_the_page_says_why_there_is_no_answer(field, typed):
    page = OwnSystem()
    page.fields[field].value = typed
    page.compare()
    assert page.answer.value.startswith("<p>There is no answer: ")
    assert "<b>" not in page.answer.value
