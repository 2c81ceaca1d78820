"""The printed values, what is recomputed for them, and the verdicts."""

import json

import numpy as np
import pytest

from robsmooth import homodyne, published
from robsmooth.covariance import error_covariance
from robsmooth.delay import pade_delay
from robsmooth.errors import InfeasibleDesignError
from robsmooth.smoother import design_smoother


@pytest.fixture(scope="module")
def verdicts():
    return {verdict.name: verdict for verdict in published.verdicts()}


def test_the_paper_coordinates_realise_the_pade_model():
    omega = np.geomspace(1e3, 1e8, 50)
    ours = pade_delay(published.DELAY, published.ORDER).response(omega)
    paper = published.paper_plant().delay_model.response(omega)
    assert np.allclose(paper, ours, rtol=0, atol=1e-12)


# Section IV-B. A unit in the last printed digit, or what the rounding of tau and lambda allows.
@pytest.mark.parametrize(
    ("name", "index", "value", "slack"),
    [
        ("A_c", (0, 0), -4.58e5, 0.01e5),
        ("A_c", (1, 0), 1.93e3, 0.01e3),
        ("A_c", (1, 1), -1.93e6, 0.01e6),
        ("A_c", (1, 2), -1.19e6, 0.01e6),
        ("A_c", (2, 0), -550.1, 0.1),
        ("A_c", (2, 1), 1.0486e6, 0.0001e6),
        ("B_c", (0, 0), 4.45e5, 0.01e5),
        ("B_c", (0, 1), -190.97, 0.03),
        ("B_c", (1, 0), 120.98, 0.02),
        ("B_c", (2, 0), 545.41, 0.03),
        ("C_c", (0, 0), 1.02, 0.01),
        ("C_c", (1, 0), 944.68, 0.15),
    ],
)
def test_printed_gains_follow_with_the_sign_flipped(name, index, value, slack):
    assert published.printed(name)[index] == value
    assert getattr(published.recomputed_estimator(), name)[index] == pytest.approx(value, abs=slack)


def test_no_rounding_of_the_printed_values_admits_the_design_as_the_theory_has_it():
    for tau, multipliers in published._rounding_box():
        with pytest.raises(InfeasibleDesignError, match=r"3\.2"):
            design_smoother(published.paper_plant(), tau, multipliers)
        assert published.x_discriminant(tau, multipliers) < 0


def test_the_discriminant_is_that_of_the_quadratic_written_out():
    tau, (l1, l2, l3, l4) = 1e-6, (0.9, 0.4, 1e-4, 2e-4)
    paper = homodyne.PAPER
    slope = 2 * paper.alpha * paper.gamma
    q = tau * slope**2 * (l2 + l3 - l2**2 / (l2 + l4))
    expected = (2 * paper.lam) ** 2 - 4 * paper.kappa / (tau * l1) * q
    found = published.x_discriminant(tau, np.array([l1, l2, l3, l4])) * (2 * paper.lam) ** 2
    assert found == pytest.approx(expected, rel=1e-6)


def test_the_printed_estimator_performs_like_the_recomputed_one():
    delta = published.paper_plant().structured_delta()
    for output in ("filtered", "smoothed"):
        digits = error_covariance(published.printed_estimator(), delta, output)[0, 0]
        computed = error_covariance(published.recomputed_estimator(), delta, output)[0, 0]
        assert digits == pytest.approx(computed, rel=0.01)


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
    assert published._agrees(text, value, value, zero=1e-12) is agrees


def test_an_interval_agrees_when_it_reaches_what_is_printed():
    assert published._agrees("190.97", 190.99, 191.2, 0.0) is False
    assert published._agrees("-190.97", -191.2, -190.96, 0.0) is True


def test_every_printed_matrix_entry_and_statement_has_one_verdict(verdicts):
    content = published.published()
    entries = sum(np.array(entry["printed"]).size for entry in content["quantity"])
    assert len(published.verdicts()) == len(verdicts) == entries + len(content["statement"])


def test_verdicts_are_of_the_four_kinds_and_say_why(verdicts):
    for verdict in verdicts.values():
        assert verdict.verdict in {
            published.REPRODUCED,
            published.WITH_FLIPPED_SIGN,
            published.NOT_REPRODUCED,
            published.NOT_CHECKABLE,
        }
        if verdict.verdict in (published.NOT_REPRODUCED, published.NOT_CHECKABLE):
            assert verdict.reason
        if isinstance(verdict.value, float) and verdict.relative_difference is not None:
            number = float(verdict.printed.split(" ")[0])
            change = verdict.relative_difference * abs(number)
            assert verdict.value == pytest.approx(number + change, rel=1e-9, abs=1e-9 * abs(number))


@pytest.mark.parametrize(
    ("name", "outcome"),
    [
        ("A_p[1, 2]", published.REPRODUCED),
        ("Cbar_p1,1[0, 0]", published.REPRODUCED),
        ("B_c[0, 0]", published.WITH_FLIPPED_SIGN),
        ("A_c[0, 2]", published.NOT_REPRODUCED),
        ("C_c[1, 2]", published.NOT_REPRODUCED),
        ("V at the printed tau, lambda", published.NOT_REPRODUCED),
        ("lambda_1", published.NOT_REPRODUCED),
        ("largest d_0", published.NOT_REPRODUCED),
        ("error covariance, smoother", published.NOT_REPRODUCED),
        ("error covariance, NGCF", published.NOT_REPRODUCED),
        ("41%", published.NOT_REPRODUCED),
        ("less sensitive", published.REPRODUCED),
        ("inverse of M", published.REPRODUCED),
        ("kappa", published.NOT_CHECKABLE),
    ],
)
def test_verdicts_that_the_project_states_in_words(verdicts, name, outcome):
    assert verdicts[name].verdict == outcome


def test_less_sensitive_says_that_it_holds_in_absolute_terms_only(verdicts):
    assert "absolute" in verdicts["less sensitive"].reason


def test_a_kind_can_be_asked_for_without_simulation_results(tmp_path):
    model = published.verdicts(tmp_path, kinds=("model",))
    assert {"J[0, 0]", "inverse of M"} <= {verdict.name for verdict in model}
    with pytest.raises(ValueError, match="kinds must be one of"):
        published.verdicts(kinds=("modle",))


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"mean_square":', '"mean":', 1),
        lambda text: "[]",
        lambda text: json.dumps({"cases": {"NGCF": None}}),
        lambda text: "",
    ],
)
def test_corrupt_simulation_results_are_one_clear_error(tmp_path, damage):
    text = (published.data_folder() / "monte_carlo.json").read_text()
    (tmp_path / "monte_carlo.json").write_text(damage(text))
    with pytest.raises(ValueError, match=r"monte_carlo\.json in .* cannot be used .* ONLY=04"):
        published.verdicts(tmp_path)


def test_missing_simulation_results_are_one_clear_error(tmp_path):
    with pytest.raises(ValueError, match="cannot be used"):
        published.verdicts(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text + "\n[[", "cannot be read"),
        (lambda text: "", r"has no \[\[quantity\]\]"),
        (lambda text: text.replace('kind = "model"\n', "", 1), "lacks 'kind'"),
        (lambda text: text.replace('printed = "1162"', 'printed = "many"'), "must be a number"),
    ],
)
def test_a_corrupt_file_of_published_values_is_one_clear_error(tmp_path, change, message):
    text = (published.data_folder() / "published.toml").read_text()
    path = tmp_path / "published.toml"
    path.write_text(change(text))
    with pytest.raises(ValueError, match=message) as caught:
        published.read_published(path)
    assert "published.toml" in str(caught.value)


def test_a_quantity_that_the_paper_does_not_print_is_named():
    with pytest.raises(KeyError, match="prints no 'A_q'"):
        published.printed("A_q")
