"""The printed values and the designs that they make."""

import re

import numpy as np
import pytest

from robsmooth import homodyne
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.analysis.covariance import error_covariance
from robsmooth.estimators.smoother import design_equations, design_smoother
from robsmooth.paper import published
from robsmooth.systems.delay import pade_delay
from tests.helpers.printed import printed_estimator


def test_the_example_has_the_printed_inputs():
    names = {"lam": "lambda"}
    for field, value in vars(homodyne.PAPER).items():
        assert value == published.printed(names.get(field, field))
    assert published.printed("delta") == published.DELAY
    assert published.printed("Pade order") == published.ORDER


def test_numbers_of_a_statement_are_in_its_words():
    (statement,) = (s for s in published.published()["statement"] if "percent" in s)
    assert f"{published.stated('41%', 'percent')}% larger" in statement["text"]


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


def discriminant(tau, multipliers):
    """Of the X equation, a quadratic for a single number in the example."""
    equations = design_equations(published.paper_plant(), tau, multipliers)
    quadratic, constant = equations.worst_noise[0, 0] / tau, equations.Q_X[0, 0]
    return (2 * homodyne.PAPER.lam) ** 2 - 4 * quadratic * constant


def test_no_rounding_of_the_printed_values_admits_the_design_as_the_theory_has_it():
    for tau, multipliers in published.rounding_box():
        with pytest.raises(InfeasibleDesignError, match=r"3\.2"):
            design_smoother(published.paper_plant(), tau, multipliers)
        assert discriminant(tau, multipliers) < 0


def test_the_discriminant_is_that_of_the_quadratic_written_out():
    tau, (l1, l2, l3, l4) = 1e-6, (0.9, 0.4, 1e-4, 2e-4)
    paper = homodyne.PAPER
    slope = 2 * paper.alpha * paper.gamma
    q = tau * slope**2 * (l2 + l3 - l2**2 / (l2 + l4))
    expected = (2 * paper.lam) ** 2 - 4 * paper.kappa / (tau * l1) * q
    assert discriminant(tau, np.array([l1, l2, l3, l4])) == pytest.approx(expected, rel=1e-6)


def test_the_printed_estimator_performs_like_the_recomputed_one():
    delta = published.paper_plant().structured_delta()
    for output in ("filtered", "smoothed"):
        digits = error_covariance(printed_estimator(), delta, output)[0, 0]
        computed = error_covariance(published.recomputed_estimator(), delta, output)[0, 0]
        assert digits == pytest.approx(computed, rel=0.01)


def test_every_entry_has_its_fields_and_its_numbers_are_texts_with_their_digits():
    digits = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")
    for entry in published.published()["quantity"]:
        assert {"id", "place", "kind"} <= entry.keys()
        for text in np.array(entry["printed"], dtype=object).flat:
            assert digits.fullmatch(text), entry["id"]
    for entry in published.published()["statement"]:
        for name in entry.keys() - {"id", "place", "kind", "text"}:
            assert digits.fullmatch(entry[name]), entry["id"]
        assert {"id", "place", "kind", "text"} <= entry.keys()


def test_a_quantity_that_the_paper_does_not_print_is_named():
    with pytest.raises(KeyError, match="prints no 'A_q'"):
        published.printed("A_q")
