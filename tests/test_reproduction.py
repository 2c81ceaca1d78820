"""The verdicts on what the paper prints, and the results on disk that they need."""

import json

import numpy as np
import pytest

from robsmooth import published, reproduction, simulations


@pytest.fixture(scope="module")
def verdicts():
    return {verdict.name: verdict for verdict in reproduction.verdicts()}


@pytest.mark.parametrize(
    ("text", "value", "agrees"),
    [
        ("1.13e-6", 1.13e-6, True),
        ("1.13e-6", 1.1349e-6, True),  # rounds to it
        ("1.13e-6", 1.1251e-6, True),
        ("1.13e-6", 1.1399e-6, True),  # is cut off to it
        ("1.13e-6", 1.1401e-6, False),
        ("1.13e-6", 1.1249e-6, False),
        ("-550.1", -550.07, True),
        ("-550.1", -550.19, True),
        ("-550.1", -550.21, False),
        ("-550.1", 550.1, False),
        ("2048", 2048.0, True),
        ("2048", 2049.0, False),
        ("0", 1e-13, True),
        ("0", 1e-3, False),
        ("4.21e-7", 0.0, False),
    ],
)
def test_agreement_is_to_the_printed_digits_rounded_or_cut_off(text, value, agrees):
    assert reproduction._agrees(text, value, value, zero=1e-12) is agrees


def test_an_interval_agrees_when_it_reaches_what_is_printed():
    assert reproduction._agrees("190.97", 190.99, 191.2, 0.0) is False
    assert reproduction._agrees("-190.97", -191.2, -190.96, 0.0) is True


def test_every_printed_matrix_entry_and_statement_has_one_verdict(verdicts):
    content = published.published()
    entries = sum(np.array(entry["printed"]).size for entry in content["quantity"])
    assert len(reproduction.verdicts()) == len(verdicts) == entries + len(content["statement"])


def test_verdicts_are_of_the_four_kinds_and_say_why(verdicts):
    for verdict in verdicts.values():
        assert verdict.verdict in {
            reproduction.REPRODUCED,
            reproduction.WITH_FLIPPED_SIGN,
            reproduction.NOT_REPRODUCED,
            reproduction.NOT_CHECKABLE,
        }
        if verdict.verdict in (reproduction.NOT_REPRODUCED, reproduction.NOT_CHECKABLE):
            assert verdict.reason
        if isinstance(verdict.value, float) and verdict.relative_difference is not None:
            number = float(verdict.printed.split(" ")[0])
            change = verdict.relative_difference * abs(number)
            assert verdict.value == pytest.approx(number + change, rel=1e-9, abs=1e-9 * abs(number))


@pytest.mark.parametrize(
    ("name", "outcome"),
    [
        ("A_p[1, 2]", reproduction.REPRODUCED),
        ("Cbar_p1,1[0, 0]", reproduction.REPRODUCED),
        ("B_c[0, 0]", reproduction.WITH_FLIPPED_SIGN),
        ("A_c[0, 2]", reproduction.NOT_REPRODUCED),
        ("C_c[1, 2]", reproduction.NOT_REPRODUCED),
        ("V at the printed tau, lambda", reproduction.NOT_REPRODUCED),
        ("lambda_1", reproduction.NOT_REPRODUCED),
        ("largest d_0", reproduction.NOT_REPRODUCED),
        ("error covariance, smoother", reproduction.NOT_REPRODUCED),
        ("error covariance, NGCF", reproduction.NOT_REPRODUCED),
        ("41%", reproduction.NOT_REPRODUCED),
        ("less sensitive", reproduction.REPRODUCED),
        ("inverse of M", reproduction.REPRODUCED),
        ("kappa", reproduction.NOT_CHECKABLE),
    ],
)
def test_verdicts_that_the_project_states_in_words(verdicts, name, outcome):
    assert verdicts[name].verdict == outcome


def test_less_sensitive_says_that_it_holds_in_absolute_terms_only(verdicts):
    assert "absolute" in verdicts["less sensitive"].reason


def test_a_kind_can_be_asked_for_without_simulation_results(tmp_path):
    model = reproduction.verdicts(tmp_path, kinds=("model",))
    assert {"J[0, 0]", "inverse of M"} <= {verdict.name for verdict in model}
    with pytest.raises(ValueError, match="kinds must be one of"):
        reproduction.verdicts(kinds=("modle",))


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"mean_square":', '"mean":', 1),
        lambda text: "[]",
        lambda text: text.replace('"NGCF"', '"NGCG"'),
        lambda text: json.dumps({"cases": dict.fromkeys(simulations.NEEDED)}),
        lambda text: "",
    ],
)
def test_corrupt_simulation_results_are_one_clear_error(tmp_path, damage):
    text = (published.data_folder() / "monte_carlo.json").read_text()
    (tmp_path / "monte_carlo.json").write_text(damage(text))
    with pytest.raises(ValueError, match=r"monte_carlo\.json in .* cannot be used .* ONLY=04"):
        reproduction.verdicts(tmp_path)


def test_missing_simulation_results_are_one_clear_error(tmp_path):
    with pytest.raises(ValueError, match="cannot be used"):
        reproduction.verdicts(tmp_path)
