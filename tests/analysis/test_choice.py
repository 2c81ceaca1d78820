"""Which smoother to use: the errors it is chosen by, the choice, and how it is said."""

import math
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import robsmooth as rs
from robsmooth.analysis.choice import Candidate, Choice, Judgement
from tests.helpers.systems import DRIVE, EXAMPLE, cancelling, classical, driven, of_gain

CERTAIN = replace(of_gain(0.0), uncertainties=())
PAPERS = ("paper's V, filtered", "paper's V, smoothed")
REFUSED = "refused: Assumption 1 fails"
SYSTEMS = {
    "cancelling": (cancelling(DRIVE), 1.0, 4),
    "without delay": (cancelling(DRIVE), 0.0, 0),
    "gain": (of_gain(0.2), 0.2, 1),
    "certain": (CERTAIN, 0.2, 4),
    "certain, short model": (CERTAIN, 0.2, 2),
}


@cache
def _made_once(name, against, output):
    return rs.best_smoother(rs.augment(*SYSTEMS[name]), against, output)


def choice(name, against="admissible", output="smoothed"):
    return _made_once(name, against, output)  # a cache tells defaults from what is given


def made(found, name="minimax", against="admissible"):
    """A choice between a classical smoother and another, of which only errors are known."""
    estimator = classical(rs.augment(of_gain(0.2), 0.2, 2), copies=False)
    candidates = {key: Candidate(estimator, Judgement(*errors)) for key, errors in found.items()}
    return Choice(estimator, name, candidates, against, "smoothed")


# --- the three errors -----------------------------------------------------------------------------


@pytest.mark.parametrize("output", ["smoothed", "filtered"])
@pytest.mark.parametrize(
    "make",
    [
        lambda: classical(rs.augment(cancelling(DRIVE), 1.0, 2), copies=False),
        lambda: classical(rs.augment(EXAMPLE, 3.1e-6, 2), copies=True),
        lambda: rs.minimax_smoother(rs.augment(EXAMPLE, 3.1e-6, 2)),
    ],
    ids=["classical", "with its copy", "minimax"],
)
def test_an_estimator_is_judged_in_the_real_loop_by_the_three_errors(make, output):
    estimator = make()
    found = rs.judge(estimator, output)
    nothing = estimator.plant.structured_delta()
    nominal = rs.error_covariance(estimator, nothing, output, loop="real").trace()
    assert_allclose(found.nominal, nominal, rtol=1e-12)
    worst = rs.worst_case(estimator, output, loop="real")
    assert found.worst_constant == worst.mean_square
    under_it = rs.error_covariance(estimator, worst.Delta, output, loop="real").trace()
    assert_allclose(found.worst_constant, under_it, rtol=1e-12)
    assert found.certified == rs.analysis_bound(estimator, output, loop="real").mean_square
    assert found.nominal < found.worst_constant < found.certified * (1.0 + 1e-6)


def test_what_can_grow_without_bound_is_judged_infinite():
    spring = rs.Uncertainty(B=[[0], [1]], C=[[1.0, 0]], D=[[0]])
    system = replace(driven(0.2), nonlinearities=(), uncertainties=[spring])
    found = rs.judge(rs.baselines.kalman_bucy(system), "filtered")
    assert math.isfinite(found.nominal)
    assert math.isinf(found.worst_constant) and math.isinf(found.certified)


def test_a_delay_that_is_too_long_to_certify_is_judged_by_the_other_errors():
    system = rs.UncertainSystem([[-1]], [[1, 0]], [[1]], [[1]], [[0, 1e-4]])
    found = rs.judge(rs.baselines.fixed_lag_smoother(system, 1.0, 10))
    assert math.isfinite(found.worst_constant) and math.isinf(found.certified)


def test_a_judgement_shows_its_errors():
    assert repr(Judgement(1.0, 2.34567, math.inf)) == (
        "Judgement(nominal=1, worst_constant=2.3457, certified=inf)"
    )


# --- the choice -----------------------------------------------------------------------------------

CHOICES = [
    ("cancelling", "admissible", "smoothed"),
    ("cancelling", "constant", "smoothed"),
    ("without delay", "admissible", "filtered"),
    ("gain", "admissible", "smoothed"),
    ("gain", "constant", "smoothed"),
    ("certain", "admissible", "smoothed"),
    ("certain, short model", "constant", "smoothed"),
]


@pytest.mark.parametrize(("name", "against", "output"), CHOICES)
def test_the_best_has_the_least_error_or_is_the_classical_one_within_a_hundredth(
    name, against, output
):
    found = choice(name, against, output)
    error = {"admissible": "certified", "constant": "worst_constant"}[against]
    errors = {
        key: getattr(rs.judge(each.estimator, output), error)
        for key, each in found.candidates.items()
        if each.estimator
    }
    least = min(errors.values())
    as_good = errors["classical"] <= 1.01 * least
    assert found.name == "classical" if as_good else errors[found.name] == least
    assert found.estimator is found.candidates[found.name].estimator
    assert (found.against, found.output) == (against, output)


def test_all_kinds_of_designs_are_candidates():
    kinds = ["classical", "tuned", "minimax", "constant minimax", *PAPERS]
    assert list(choice("gain").candidates) == kinds
    # without a delay there is one error, and one cost
    assert list(choice("without delay", output="filtered").candidates) == kinds[:-1]


def test_the_designs_are_for_the_error_that_was_asked_for():
    filtered, smoothed = (choice("gain", output=o).candidates for o in ("filtered", "smoothed"))
    for name in ("minimax", "constant minimax"):
        assert filtered[name].estimator.cost == "filtered"
        assert smoothed[name].estimator.cost == "smoothed"
    constant = choice("gain", "constant").candidates["tuned"].judgement
    assert constant.worst_constant < smoothed["tuned"].judgement.worst_constant
    assert smoothed["tuned"].judgement.certified < constant.certified


@pytest.mark.parametrize(
    ("against", "output"), [("admissible", "smoothed"), ("constant", "filtered")]
)
def test_copies_are_run_by_the_classical_candidate(against, output):
    found = rs.best_smoother(rs.augment(EXAMPLE, 3.1e-6, 2), against, output)
    with_its_copy = rs.judge(classical(rs.augment(EXAMPLE, 3.1e-6, 2), copies=True), output)
    assert found.candidates["classical"].judgement == with_its_copy


def test_a_design_that_the_papers_theory_refuses_says_so_and_is_no_obstacle():
    found = choice("cancelling")
    for name in PAPERS:
        assert found.candidates[name].estimator is None
        assert "Assumption 1 fails: noise 0 of 2" in found.candidates[name].refused
        assert math.isinf(found.candidates[name].error("constant"))
    rows = {row[0]: row[1:] for row in found.table.rows}
    assert all(rows[name] == (None, None, None, REFUSED) for name in PAPERS)


# --- what is said ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("against", "sentence"),
    [
        (
            "constant",
            "Robustness buys 91% here: the worst constant error falls from 13.22 (classical) "
            "to 1.154 (constant minimax).",
        ),
        (
            "admissible",
            "Robustness buys 99.96% here: the certified worst error falls from 5856 (classical) "
            "to 2.547 (minimax).",
        ),
    ],
)
def test_the_sentence_says_what_robustness_buys(against, sentence):
    found = choice("cancelling", against)
    assert found.sentence == sentence
    assert found.table.caption.endswith(sentence)


@pytest.mark.parametrize("against", ["constant", "admissible"])
def test_without_uncertainty_the_classical_smoother_is_as_good(against):
    found = choice("certain", against)
    assert found.name == "classical"
    kind = {"constant": "worst constant", "admissible": "certified worst"}[against]
    assert found.sentence == (
        f"The classical smoother is as good, with a {kind} error of 0.0508: use it."
    )


def test_what_a_closer_fit_to_the_delay_buys_is_not_robustness():
    found = choice("certain, short model", "constant")
    assert found.name == "constant minimax"
    assert found.sentence == (
        "A closer fit to the delay buys 2.2% here: the worst constant error falls from 0.05236 "
        "(classical) to 0.05121 (constant minimax)."
    )
    # where the nominal error falls by half as much or more, in logarithms
    for worst, subject in ((1.7, "A closer fit to the delay"), (1.6, "Robustness")):
        errors = {"classical": (1.0, 2.0, 2.0), "minimax": (0.9, worst, worst)}
        assert made(errors).sentence.startswith(f"{subject} buys")


@pytest.mark.parametrize(
    ("error", "saved"),
    [
        (0.5, "50%"),
        (0.0123, "99%"),
        (4.36e-4, "99.96%"),
        (4e-6, "99.9996%"),
        (1e-9, "99.9999999%"),
    ],
)
def test_no_saving_is_rounded_to_all(error, saved):
    errors = {"classical": (1e-12, 1.0, 1.0), "minimax": (1e-12, error, error)}
    assert f"buys {saved} here" in made(errors).sentence


def test_where_waiting_makes_the_error_larger_the_sentence_does_not_advise_it():
    errors = {"classical": (1.0, 1.1, 1.2), "minimax": (1.0, 1.1, 1.2)}
    coarse = replace(made(errors, name="classical"), coarse="it is above the filtered one")
    assert coarse.sentence == "Do not smooth with this delay: it is above the filtered one."
    assert "buys" in replace(coarse, name="minimax").sentence


def test_where_the_classical_smoother_has_no_finite_error_the_sentence_gives_no_percentage():
    errors = {"classical": (1.0, math.inf, math.inf), "minimax": (1.5, 2.0, 3.0)}
    assert made(errors).sentence == (
        "Use the minimax smoother: only designs for the uncertainty are safe here."
    )


def test_the_table_has_all_candidates_with_their_errors_and_names_the_best():
    found = choice("cancelling")
    table = found.table
    assert table.columns == ("smoother", "nominal", "worst constant", "certified worst", "")
    rows = {row[0]: row[1:] for row in table.rows}
    assert list(rows) == list(found.candidates)
    for name in ("classical", "tuned", "minimax", "constant minimax"):
        errors = tuple(vars(found.candidates[name].judgement).values())
        assert rows[name] == (*errors, "best" if name == "minimax" else "")
    caption = "Mean square errors of the smoothed estimate, in the squared unit of $w$. "
    assert table.caption == caption + found.sentence


def test_the_table_is_shown_as_text_and_html():
    found = choice("cancelling")
    text = repr(found.table)
    assert "| minimax | 1.209 | 1.736 | 2.547 | best |" in text
    assert f"| {PAPERS[0]} |  |  |  | {REFUSED} |" in text
    html = found._repr_html_()
    assert html == found.table.html()
    assert "Robustness buys 99.96% here" in html and "refused: Assumption 1 fails" in html


def test_a_choice_shows_what_it_is():
    assert repr(choice("cancelling")) == (
        "Choice('minimax', against='admissible', "
        "Judgement(nominal=1.2088, worst_constant=1.7358, certified=2.547))"
    )


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("against", "what"),
    [
        ("admissible", r"no estimator has one; 0\.4\d* of the uncertainty has one"),
        ("constant", "some constant uncertainty destabilises the plant"),
    ],
)
def test_where_no_estimator_has_a_finite_error_there_is_no_choice(against, what):
    spring = rs.Uncertainty(B=[[0], [1]], C=[[1.0, 0]], D=[[0]])
    system = replace(driven(0.2), nonlinearities=(), uncertainties=[spring])
    with pytest.raises(rs.InfeasibleDesignError, match=what):
        rs.best_smoother(rs.augment(system, 0.0, 0), against, "filtered")


def test_a_constant_uncertainty_may_have_a_finite_error_where_a_varying_one_has_none():
    spring = rs.Uncertainty(B=[[0], [1]], C=[[0.6, 0]], D=[[0]])
    system = replace(driven(0.2), nonlinearities=(), uncertainties=[spring])
    plant = rs.augment(system, 0.0, 0)
    found = rs.best_smoother(plant, "constant", "filtered")
    assert math.isfinite(found.candidates[found.name].judgement.worst_constant)
    assert found.candidates["minimax"].estimator is None
    row = dict(zip(found.candidates, found.table.rows, strict=True))["minimax"]
    assert row[-1] == "refused: A finite guarantee fails"


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"D21": [[0.0, 0.0]]}, "measurement 0 has no noise"),
        ({"A": [[0.0]]}, "grows without bound"),
    ],
)
def test_a_plant_for_which_there_is_no_design_is_refused(changes, what):
    plant = rs.augment(replace(of_gain(0.2), **changes), 0.2, 2)
    for against in ("admissible", "constant"):
        with pytest.raises(rs.InfeasibleDesignError, match=what):
            rs.best_smoother(plant, against)


def test_bad_arguments_are_refused_before_any_design(monkeypatch):
    plant = rs.augment(of_gain(0.2), 0.2, 2)
    monkeypatch.setattr("robsmooth.analysis.choice._designs", lambda *_: pytest.fail("designed"))
    with pytest.raises(
        TypeError, match=r"plant must be an AugmentedSystem, got UncertainSystem; a"
    ):
        rs.best_smoother(plant.system)
    with pytest.raises(ValueError, match=r"against must be one of .*, got 'dynamic'"):
        rs.best_smoother(plant, "dynamic")
    with pytest.raises(ValueError, match=r"output must be one of .*, got 'guaranteed'"):
        rs.best_smoother(plant, output="guaranteed")
    with pytest.raises(TypeError, match="progress must be True or False"):
        rs.best_smoother(plant, progress=1)
    with pytest.raises(TypeError, match="estimator must be an Estimator, got AugmentedSystem"):
        rs.judge(plant)
    with pytest.raises(ValueError, match=r"output must be one of .*, got 'guaranteed'"):
        rs.judge(classical(plant, copies=False), "guaranteed")


def test_progress_is_shown_where_it_is_asked_for_and_changes_nothing(terminal):
    plant = rs.augment(CERTAIN, 0.0, 0)
    silent = rs.best_smoother(plant, output="filtered")
    assert terminal.readouterr().err == ""
    shown = rs.best_smoother(plant, output="filtered", progress=True)
    assert "5/5" in terminal.readouterr().err
    assert repr(shown) == repr(silent)
    np.testing.assert_array_equal(shown.estimator.A_c, silent.estimator.A_c)


def test_waiting_that_makes_the_error_larger_is_warned_of():
    with pytest.warns(rs.CoarseDelayWarning, match=r"0\.6484, is above the filtered one, 0\.02662"):
        rs.best_smoother(rs.augment(cancelling(), 1.0, 2))
    with warnings.catch_warnings(action="error"):
        rs.best_smoother(rs.augment(cancelling(), 1.0, 2), output="filtered")
        rs.best_smoother(rs.augment(of_gain(0.2), 0.2, 2))


@pytest.mark.parametrize(("B1", "C0"), [([[1, 0]], [[0]]), ([[0, 0]], [[1]])])
def test_an_error_that_nothing_drives_is_zero(B1, C0):
    gain = rs.Uncertainty([[0]], [[0.1]], [[1]])
    system = rs.UncertainSystem([[-1]], B1, C0, [[1]], [[0, 0.1]], [gain])
    judged = rs.judge(rs.baselines.fixed_lag_smoother(system, 0.1, 2))
    assert vars(judged) == {"nominal": 0.0, "worst_constant": 0.0, "certified": 0.0}
