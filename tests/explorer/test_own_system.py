"""The page for a system of one's own: its examples, its code, and what it refuses."""

import re
from html import escape
from pathlib import Path

import numpy as np
import pytest

import robsmooth as rs
from robsmooth.explorer.own_system import EXAMPLES, OwnSystem, code_of


def values(example):
    """The values of the fields at an example."""
    page = OwnSystem()
    page.example.label = example
    return {name: field.value for name, field in page.fields.items()}


FIELDS = ("A", "B1", "C0", "C2", "D21", "uncertain", "against", "delay", "order")
SIGNAL = ("-1", "1 0", "1", "1", "0 0.1", "A[0,0] 10%\nC2[0,0] 5%", "admissible", "0.2", "2")
TYPED = dict(zip(FIELDS, SIGNAL, strict=True))
README = Path(__file__).resolve().parents[2] / "README.md"


def run(code):
    names = {"print": lambda *_: None}
    exec(code.partition("choice =")[0], names)
    return names


@pytest.mark.parametrize("example", EXAMPLES)
def test_code_of_an_example_makes_its_system(example):
    names = run(code_of(values(example) | {"order": 3}))
    for uncertainty, channel in zip(
        names["uncertainties"], names["system"].uncertainties, strict=False
    ):
        assert np.array_equal(uncertainty.C, channel.C)
    assert names["plant"].order == 3


def test_the_mirror_is_that_of_the_library():
    (mirror,) = [name for name in EXAMPLES if "mirror" in name]
    found = run(code_of(values(mirror)))["system"]
    library = rs.examples.resonant_phase()
    for name in ("A", "B1", "C0", "C2", "D21"):
        assert np.allclose(getattr(found, name), getattr(library, name), rtol=1e-3), name
    effects = [np.abs(u.B @ u.C) for u in (found.uncertainties[0], library.uncertainties[0])]
    assert np.allclose(*effects, rtol=1e-3)


def test_the_first_example_is_the_readmes():
    text, found = README.read_text(encoding="utf-8"), {}
    code = re.search(r"```python\n(.*?)```", text[text.index("## Your own system") :], re.DOTALL)[1]
    exec(code.partition("choice =")[0], found)
    first = code_of(values(next(iter(EXAMPLES))))
    ours = run(first)["system"]
    for name in ("A", "B1", "C0", "C2", "D21"):
        assert np.array_equal(getattr(ours, name), getattr(found["system"], name)), name
    for name in ("B", "C", "D"):
        pair = (getattr(each.uncertainties[0], name) for each in (ours, found["system"]))
        assert np.array_equal(*pair)
    call = 'rs.best_smoother(rs.augment(system, delay=0.5, order=4), against="constant")'
    assert call in code
    assert "delay=0.5, order=4)\nchoice = rs.best_smoother(plant, against='constant')" in first


def test_uncertain_entries_are_shares_of_the_numbers():
    text = TYPED | {"A": "-1 3; 0 -2", "B1": "1 0 0; 0 1 0", "C0": "1 0", "C2": "1 4"}
    text |= {"D21": "0 0 0.1", "uncertain": "A[0,1] 10%\n\n c2[0, 1]  25 %, A[1,1] 1%"}
    rate, gain, last = run(code_of(text))["uncertainties"]
    assert np.allclose(rate.B @ rate.C, [[0.0, 0.3], [0.0, 0.0]])
    assert not rate.D.any()
    assert np.allclose(gain.D @ gain.C, [[0.0, 1.0]])
    assert not gain.B.any()
    assert np.allclose(last.B @ last.C, [[0.0, 0.0], [0.0, -0.02]])


def test_numbers_may_be_separated_by_commas_and_rows_by_semicolons():
    plain = code_of(TYPED | {"A": "-1 0\n0 -2", "C0": "1 0", "C2": "1 1"})
    assert code_of(TYPED | {"A": "-1, 0;\n0, -2\n", "C0": "1, 0", "C2": "1 , 1"}) == plain


@pytest.mark.parametrize(
    ("field", "typed", "sentence"),
    [
        ("A", "1 2\n3", "A: row 2 has 1 number, row 1 has 2"),
        ("A", "1\n2 3", "A: row 2 has 2 numbers, row 1 has 1"),
        ("A", "", "A is empty: type one row per state"),
        ("C2", " \n", "C2 is empty: type one row per sensor"),
        ("A", "nan", "A: 'nan' is no finite number"),
        ("B1", "one", "B1: 'one' is no finite number"),
        ("A", "-1,5", "A: write -1.5 for a number or -1, 5 for two, not -1,5"),
        ("delay", "0,5", "delay must be a number, such as 0.5 or 3, got '0,5'"),
        ("delay", "", "delay must be a number, such as 0.5 or 3, got ''"),
        ("delay", "abc", "delay must be a number, such as 0.5 or 3, got 'abc'"),
        ("uncertain", "A[0,1] 5%", "A has no entry [0,1]; the last is [0,0]"),
        ("uncertain", "C2[1,0] 5%", "C2 has no entry [1,0]; the last is [0,0]"),
    ],
)
def test_what_cannot_be_read_is_named(field, typed, sentence):
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        code_of(TYPED | {field: typed})


@pytest.mark.parametrize("typed", ["A[0,0]", "D21[0,0] 5%", "A[0,0] 5", "A 5%"])
def test_an_uncertain_entry_that_cannot_be_read_is_named(typed):
    sentence = re.escape("an uncertain entry must be A[row,column] or C2[row,column]")
    with pytest.raises(ValueError, match=rf"^{sentence}.* got {re.escape(repr(typed))}$"):
        code_of(TYPED | {"uncertain": typed})


def test_an_entry_of_zero_has_no_per_cent():
    with pytest.raises(ValueError, match=r"^A\[0,0\] is zero: a per cent of it is nothing$"):
        code_of(TYPED | {"A": "0", "uncertain": "A[0,0] 5%"})


@pytest.mark.parametrize("change", [{"B1": "0 0"}, {"C0": "0"}])
def test_nothing_to_estimate_is_said(change):
    with pytest.raises(ArithmeticError, match=r"^nothing to estimate: no noise of B1"):
        code_of(TYPED | change)


def test_the_page_answers_with_the_librarys_sentence_and_table():
    page, answers = OwnSystem(), []
    page.answer.observe(lambda change: answers.append(change["new"]), "value")
    page.example.label = next(name for name in EXAMPLES if "clock" in name)
    page.fields["order"].value = 2
    page.button.click()
    assert "Designing the smoothers" in answers[0]
    plant = rs.augment(run(page.code.value)["system"], delay=3.0, order=2)
    choice = rs.best_smoother(plant)
    assert choice.sentence in page.answer.value
    assert all(escape(name) in page.answer.value for name in choice.candidates)
    page.example.index = 0
    assert page.answer.value == page.code.value == ""
    assert page.code.layout.display == "none"


@pytest.mark.parametrize(
    ("field", "typed"), [("C2", "1 2 3"), ("delay", "-1"), ("D21", "0 <b>"), ("D21", "0 0")]
)
def test_the_page_says_why_there_is_no_answer(field, typed):
    page = OwnSystem()
    page.fields[field].value = typed
    page.compare()
    assert page.answer.value.startswith("<p>There is no answer: ")
    assert "<b>" not in page.answer.value
    assert page.code.layout.display == "none"


def test_a_model_of_the_delay_that_is_too_coarse_is_said_first():
    page = OwnSystem()
    coarse = {"order": 1, "delay": "5", "uncertain": "A[0,0] 10%"}
    for name, value in (TYPED | coarse).items():
        page.fields[name].value = value
    page.compare()
    assert page.answer.value.startswith("<p>Take care: the smoothed error")
    assert "too coarse" in page.answer.value


@pytest.fixture(scope="module")
def compared():
    """A page after its first example was compared; it is read only."""
    page = OwnSystem()
    page.compare()
    return page


def test_uncertain_numbers_that_are_constant_are_designed_for(compared):
    assert compared.fields["against"].label == "are constant"
    assert "worst constant error falls" in compared.answer.value
    assert "against='constant'" in compared.code.value


def test_reset_brings_an_edited_example_back():
    page = OwnSystem()
    page.example.index = 1
    before = {name: field.value for name, field in page.fields.items()}
    for field in (page.fields["A"], page.fields["delay"]):
        field.value = "7"
    page.fields["against"].label = "are constant"
    page.reset.click()
    assert {name: field.value for name, field in page.fields.items()} == before


def test_digits_are_padded(compared):
    assert ">0.5270<" in compared.answer.value
