"""The verdicts on what the paper prints, and the results on disk that they need."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robsmooth import homodyne
from robsmooth.paper import published, statements
from robsmooth.paper import verdicts as reproduction

PLANT = published.paper_plant()
SIMULATION = published.read_simulation(published.data_folder())
# What the model, the sweep, the simulation or, as texts and what is printed in their place, the
# paper would have to say for the verdict on each statement to be the other one.
OTHERWISE = {
    "smoothing improves the Kalman-Bucy filter": lambda: statements.smoothing_improves(lag=0.0),
    "robust filter against Kalman filter": lambda: statements.robust_against_kalman(
        simulated(**{"NGCF, time averages": 0.08})
    ),
    "bound on the smoothed error": lambda: statements.bounds_the_smoothed("smoothed"),
    "sector": lambda: statements.sector(replace(homodyne.PAPER, beta=0.6)),
    "scaled nonlinearity": ('power_of_gamma = "1"', 'power_of_gamma = "-1"'),
    "inverse of M": lambda: statements.inverse_of_M(
        SimpleNamespace(M=lambda multipliers: PLANT.M(multipliers)[::-1])
    ),
    "constraints on lambda": lambda: statements.constraints(
        SimpleNamespace(M=PLANT.M, J=0.5 * PLANT.J)
    ),
    "printed lambda satisfies the constraints": ('"0.4831"', '"0.5831"'),
    "Assumption 3 at the printed design": ('"0.0015"', '"0.0003"', '"0.0014"', '"0.0003"'),
    "error grows with the uncertainty": lambda: statements.grows(*swept([0.3, 0.2])),
    "smoother much below NGCF": lambda: statements.below(*swept([0.07, 0.3])),
    "less sensitive": lambda: statements.less_sensitive(*swept([0.2, 0.21])),
    "41%": ('percent = "41"', 'percent = "70"'),
    "significant improvement": lambda: statements.significant(0.0548, 0.05),
}


def simulated(**filtered):
    """Results of a simulation with other filtered errors."""
    return SIMULATION | {
        name: SIMULATION[name] | {"filtered": replace(SIMULATION[name]["filtered"], mean_square=x)}
        for name, x in filtered.items()
    }


def swept(ngcf):
    """A sweep of the smoother's and other errors of the NGCF, at Delta_2 of 0 and -1."""
    return np.array([0.08, 0.1]), np.array(ngcf)


@pytest.fixture
def reprint(tmp_path, monkeypatch):
    """Have the paper print something else: published.toml with some texts replaced."""

    def change(*changes):
        text = (published.data_folder() / "published.toml").read_text()
        for old, new in zip(changes[::2], changes[1::2], strict=True):
            assert text.count(old) == 1
            text = text.replace(old, new)
        (tmp_path / "published.toml").write_text(text)
        monkeypatch.setattr(published, "data_folder", lambda: tmp_path)
        published.published.cache_clear()

    yield change
    monkeypatch.undo()
    published.published.cache_clear()


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
    assert published.agrees(text, value, value, zero=1e-12) is agrees


def test_an_interval_agrees_when_it_reaches_what_is_printed():
    assert published.agrees("190.97", 190.99, 191.2, 0.0) is False
    assert published.agrees("-190.97", -191.2, -190.96, 0.0) is True


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
        ("bound on the smoothed error", reproduction.NOT_REPRODUCED),
        ("41%", reproduction.NOT_REPRODUCED),
        ("less sensitive", reproduction.REPRODUCED),
        ("inverse of M", reproduction.REPRODUCED),
        ("kappa", reproduction.NOT_CHECKABLE),
    ],
)
def test_verdicts_that_the_project_states_in_words(verdicts, name, outcome):
    assert verdicts[name].verdict == outcome


def test_every_statement_is_tried_with_the_other_verdict():
    assert list(OTHERWISE) == [entry["id"] for entry in published.published()["statement"]]


@pytest.mark.parametrize("name", OTHERWISE)
def test_verdict_on_a_statement_follows_from_what_it_claims(name, reprint):
    holds, *words = statements.checks(SIMULATION)[name]()
    otherwise = OTHERWISE[name]
    if not callable(otherwise):
        reprint(*otherwise)
        otherwise = statements.checks(SIMULATION)[name]
    verdict, *other_words = otherwise()
    assert verdict is not holds
    assert other_words != words


def test_words_about_printed_numbers_have_what_is_printed(reprint):
    reprint('"0.0605"', '"0.0731"')
    _, value, reason = statements.checks(SIMULATION)["41%"]()
    assert "the printed 0.1031 is 41% larger than 0.0731; ours: 70% larger" in value
    assert "printed 29.1%, ours 41.2%" in reason


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
        lambda text: json.dumps(
            {"cases": dict.fromkeys([*published.LITERAL, *published.AVERAGED])}
        ),
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
