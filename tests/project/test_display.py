"""What objects show of themselves: short, whatever their size, and well formed."""

import inspect
import math
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robsmooth as rs
from robsmooth import homodyne
from robsmooth._numerics.riccati import solve_riccati
from robsmooth._support import notation
from robsmooth._support.tables import Table
from robsmooth.paper.verdicts import Verdict, Verdicts
from tests.helpers.loops import two_channels
from tests.helpers.strategies import designs, plants, random_system, seeds

PAPER = homodyne.PAPER
LONGEST = 400  # characters of a repr


@cache
def smoother(order=2):
    plant = rs.augment(PAPER.uncertain_system(), 3.1e-6, order)
    return rs.design_smoother(plant, 1.1e-6, [1.0, 0.499, 1e-3, 1e-3])


@cache
def large_system(n=100, channels=9):
    """A system of many states, with more channels than are shown."""
    chain = np.diag(np.full(n - 1, 1.0), 1) - 2.0 * np.eye(n)
    first, last = np.eye(n)[:, :1], np.eye(n)[-1:]
    none = np.zeros((1, 1))
    return rs.UncertainSystem(
        A=chain,
        B1=np.hstack([first, 0 * first]),
        C0=last,
        C2=last,
        D21=[[0.0, 0.1]],
        uncertainties=[
            rs.Uncertainty(first, 0.1 * last, none),
            rs.Uncertainty(0 * first, 0 * last, [[0.1]]),
            *(rs.Uncertainty(first, 0.01 * last, none) for _ in range(channels - 2)),
        ],
        nonlinearities=[rs.Nonlinearity(first, last, none, 0.1, np.tanh)] * channels,
    )


@cache
def linear_loop():
    """A design whose loop can be simulated in no time."""
    system = replace(PAPER.uncertain_system(), nonlinearities=())
    channel = rs.Uncertainty([[0.0]], [[0.0]], system.D21[:, 1:])
    system = replace(system, uncertainties=(*system.uncertainties, channel))
    return rs.design_smoother(rs.augment(system, 3.1e-6, 1), 1e-6, [0.9, 0.9])


def study():
    return rs.parameter_study(PAPER, [1e-6, 3e-6], [1], [0.4], [1.0], runs=128)


# Every public class: how to come by one, and what its repr must tell.
OBJECTS = {
    "AnalysisBound": (lambda: rs.analysis_bound(smoother()), ["mean_square=0.2", "fraction=1"]),
    "AugmentedSystem": (lambda: smoother().plant, ["delay=3.1e-06 s", "order=2", "n=3 states"]),
    "Choice": (lambda: rs.best_smoother(smoother().plant), ["against='admissible'", "nominal=0.0"]),
    "ConstantMinimaxSmoother": (
        lambda: rs.constant_minimax_smoother(smoother().plant),
        ["worst_constant=0.083", "cost='smoothed'", "order=2"],
    ),
    "DiscreteSmoother": (
        lambda: rs.baselines.kalman_bucy(PAPER.uncertain_system()).discretize(1e-7),
        ["dt=1e-07 s", "delay=0 s", "1 states"],
    ),
    "Estimator": (
        lambda: rs.baselines.fixed_lag_smoother(PAPER.uncertain_system(), 3.1e-6, 2),
        ["3 states", "delay=3.1e-06 s", "order=2", "1 copies"],
    ),
    "InadmissibleWarning": (lambda: rs.InadmissibleWarning("outside"), ["outside"]),
    "InfeasibleDesignError": (
        lambda: rs.InfeasibleDesignError("Assumption 2", "no noise"),
        ["Assumption 2", "no noise"],
    ),
    "Judgement": (
        lambda: rs.judge(smoother(), "filtered"),
        ["nominal=0.08", "worst_constant=0.1", "certified=0.1"],
    ),
    "LagChoice": (
        lambda: rs.choose_lag(PAPER.uncertain_system(), fraction=0.8),
        ["lag=1.8", "order=1", "error=0.05", "target=0.05"],
    ),
    "LagSweep": (
        lambda: rs.lag_sweep(PAPER.uncertain_system(), [1e-6, 2e-6], [1, 2]),
        ["2 orders x 2 lags", "error 0.0496"],
    ),
    "CoarseDelayWarning": (lambda: rs.CoarseDelayWarning("coarse"), ["coarse"]),
    "LongStepWarning": (lambda: rs.LongStepWarning("long"), ["long"]),
    "LossOfLockWarning": (lambda: rs.LossOfLockWarning("slipped"), ["slipped"]),
    "MeanSquare": (lambda: rs.MeanSquare(0.0517, 0.0003), ["0.0517", "0.0003"]),
    "MinimaxSmoother": (
        lambda: rs.minimax_smoother(smoother().plant),
        ["certified=0.0886", "cost='smoothed'", "delay=3.1e-06 s"],
    ),
    "MonteCarloResult": (
        lambda: rs.monte_carlo(PAPER, smoother(), runs=128),
        ["smoothed 0.05", "filtered 0.08", "rad^2", "128 runs"],
    ),
    "Nonlinearity": (
        lambda: PAPER.uncertain_system().nonlinearities[0],
        ["C=[[929.6]]", "lipschitz=1", "function=HomodyneParameters.channel"],
    ),
    "RecordCheck": (
        lambda: rs.check_record(
            rs.baselines.kalman_bucy(PAPER.uncertain_system()).discretize(1e-7), np.zeros((30, 1))
        ),
        ["mean_square=0", "p_white="],
    ),
    "RobustSmoother": (smoother, ["bound=0.12", "cost='filtered'", "delay=3.1e-06 s"]),
    "SamplePaths": (
        lambda: rs.sample_paths(linear_loop(), runs=2, duration=1e-5),
        ["2 paths", "lag=3.1e-06 s", "1 outputs"],
    ),
    "Sector": (lambda: rs.sector(np.sin, 1.2), ["sin", "reach=1.2", "upper=1.0"]),
    "SimulationResult": (
        lambda: rs.simulate(linear_loop(), runs=16, duration=1e-5),
        ["smoothed 0.0", "constraints used", "16 runs"],
    ),
    "StationaryErrors": (
        lambda: rs.stationary_errors(PAPER, smoother()),
        ["smoothed 0.05", "rad^2", "degree"],
    ),
    "Study": (study, ["1 gammas x 1 noises x 1 orders x 2 lags", "2 designs"]),
    "UncertainSystem": (PAPER.uncertain_system, ["n=1 states", "k=1 uncertainties"]),
    "Uncertainty": (lambda: PAPER.uncertain_system().uncertainties[0], ["B=[[200]]", "D=[[0]]"]),
    "UnstableLoopError": (lambda: rs.UnstableLoopError("not stable"), ["not stable"]),
    "WorstCase": (
        lambda: rs.worst_case(smoother(), "filtered"),
        ["mean_square=0.2", "nominal=0.1"],
    ),
    # public by the modules of the package, or what functions return
    "HomodyneParameters": (lambda: PAPER, ["lam=9140.0", "gamma=0.4"]),
    "RiccatiSolution": (lambda: smoother().certificates["Y"], ["residual=", "error="]),
    "Verdicts": (lambda: rs.verdicts(kinds=("model",)), ["reproduced", "3 not reproduced"]),
}


@cache
def example(name):
    return OBJECTS[name][0]()


class Outline(HTMLParser):
    """The open elements, and the tables of a text: it fails where a tag does not match."""

    def __init__(self, text):
        super().__init__()
        self.open, self.seen, self.words = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def check_latex(text):
    """Check that delimiters, braces and environments match."""
    assert re.fullmatch(r"\$\$?[^$]+\$\$?", text), text
    check_mathematics(text.strip("$"))


def check_mathematics(text):
    depth = 0
    for brace in re.findall(r"(?<!\\)[{}]", text):
        depth += 1 if brace == "{" else -1
        assert depth >= 0
    assert depth == 0
    assert text.count(r"\left[") == text.count(r"\right]")
    assert sorted(re.findall(r"\\begin{(\w+)}", text)) == sorted(re.findall(r"\\end{(\w+)}", text))


def check_display(shown):
    """Check all that an object shows of itself; return it, by its kind."""
    found = {"text": repr(shown)}
    assert len(found["text"]) <= LONGEST
    assert found["text"].count("\n") < 4
    if hasattr(shown, "_repr_html_"):
        found["html"] = text = shown._repr_html_()
        outline = Outline(text)
        assert text.startswith('<div style="overflow-x: auto">\n<table '), "it scrolls by itself"
        assert {"caption", "thead", "tbody"} <= set(outline.seen)
        assert outline.seen.count("td") % outline.seen.count("th") == 0
        for formula in re.findall(r"\\\((.*?)\\\)", "".join(outline.words), re.DOTALL):
            check_mathematics(formula)
    if hasattr(shown, "_repr_latex_"):
        found["latex"] = shown._repr_latex_()
        check_latex(found["latex"])
    return found


def test_every_public_class_is_here():
    public = {name for name in rs.__all__ if inspect.isclass(getattr(rs, name))}
    assert public <= OBJECTS.keys()


@pytest.mark.parametrize("name", sorted(OBJECTS))
def test_an_object_says_what_it_is(name):
    shown = example(name)
    assert type(shown).__name__ == name
    found = check_display(shown)
    for part in OBJECTS[name][1]:
        assert part in found["text"]
    # html wins over LaTeX in JupyterLab: one of them is enough
    assert not {"html", "latex"} <= found.keys()


RICH = {
    "Choice": ["certified worst", "classical", "best"],
    "HomodyneParameters": [r"\(\kappa\)", "rad²/s", "40000"],
    "Verdicts": ["relative difference", "A_p[0, 0]", "zeros"],
}


@pytest.mark.parametrize("name", sorted(RICH))
def test_a_notebook_shows_key_figures(name):
    text = example(name)._repr_html_()
    for part in RICH[name]:
        assert part in text


def test_a_loop_that_slips_shows_the_errors_of_paths_in_lock():
    with pytest.warns(rs.LossOfLockWarning):
        result = rs.monte_carlo(
            replace(PAPER, kappa=1.5e6), rs.baselines.kalman_bucy(PAPER.uncertain_system()), runs=64
        )
    found = check_display(result)
    assert f"{result.slips} slips in {result.slipped_paths} of 64 paths" in found["text"]
    assert f"in lock {result.smoothed_in_lock} and {result.filtered_in_lock} rad^2" in found["text"]


def test_a_system_is_shown_as_its_equations():
    text = PAPER.uncertain_system()._repr_latex_()
    assert r"dx &= \left[-9140\,x + 200\,\xi_{1}\right]dt + \begin{bmatrix}200 & 0\end" in text
    assert r"dy &= \left[x + 0.0004303\,\mu_{1}\right]dt" in text
    assert r"w &= x \\" in text
    assert r"\mu_{1} &= \psi_{1}(\nu_{1} - r_{1}),\quad \nu_{1} = 929.6\,x,\quad L_{1} = 1" in text
    assert r"L_{1} = 1,\quad r_{1}\text{ the filtered estimate of }\nu_{1} \\" in text
    assert r"\lVert\xi_{1}\rVert &\le \lVert\zeta_{1}\rVert,\quad \zeta_{1} = 0" in text


def test_what_is_zero_is_left_out_of_the_equations():
    system = rs.UncertainSystem([[0.0]], [[0.0]], [[0.0]], [[-1.0]], [[0.5]])
    text = system._repr_latex_()
    assert "dx &= 0" in text and "w &= 0" in text
    assert r"dy &= \left[-x\right]dt + 0.5\,dW" in text


def test_a_large_system_stays_short():
    system = large_system()
    plant = rs.augment(system, 1.0, 4)
    estimator = rs.baselines.kalman_bucy(replace(system, nonlinearities=()))
    channel = system.uncertainties[0]
    for shown in (system, plant, estimator):
        check_display(shown)
    text = system._repr_latex_()
    assert r"\ddots" in text and r"\cdots" in text
    assert len(text) < 6000
    assert text.count(r"\psi_") == text.count(r"\zeta_") // 2 == 4  # of nine
    assert repr(channel) == "Uncertainty(B=<100 x 1>, C=<1 x 100>, D=[[0]])"


@given(plants(), seeds)
@settings(max_examples=15)
def test_systems_of_any_size_show_themselves(plant, seed):
    system = plant.system
    estimator = rs.baselines.fixed_lag_smoother(system, plant.delay, plant.order)
    wide = random_system(np.random.default_rng(seed), n=7, m=2, measurements=2, g=5)
    for shown in (
        *(system, plant, estimator, wide),
        *(*system.uncertainties, *system.nonlinearities, *wide.nonlinearities),
    ):
        check_display(shown)


@given(designs())
@settings(max_examples=10)
def test_designs_of_any_size_show_themselves(design):
    for shown in (design, design.certificates["Y"], rs.worst_case(design)):
        check_display(shown)


def test_a_loop_without_a_bound_shows_itself():
    """Infinite errors, no multipliers, no guarantee."""
    estimator = rs.baselines.kalman_bucy(two_channels(2.0, C2=0.0))
    bound, worst = rs.analysis_bound(estimator, "filtered"), rs.worst_case(estimator, "filtered")
    assert math.isinf(bound.mean_square) and math.isinf(worst.mean_square)
    for shown in (bound, worst):
        assert "mean_square=inf" in check_display(shown)["text"]


def test_a_single_path_shows_a_mean_without_an_error():
    single = rs.MeanSquare(0.05, math.nan)
    assert str(single) == "0.05 +- nan"


def test_a_study_without_a_design_shows_itself():
    empty = {name: np.full((1, 1, 1, 1), np.nan) for name in ("bound", "smoothed", "filtered")}
    none = rs.Study((0.4,), (1.0,), (1,), (1e-6,), empty, {(0.4, 1.0): "no"})
    assert "0 designs, 1 columns without" in check_display(none)["text"]


# --- verdicts -------------------------------------------------------------------------------------


def test_verdicts_are_a_list():
    found = example("Verdicts")
    assert isinstance(found, list) and all(isinstance(verdict, Verdict) for verdict in found)
    assert repr(Verdicts()) == "Verdicts(none)"
    check_display(Verdicts())


def test_words_that_html_would_misread_are_escaped():
    verdict = Verdict("a<b", "&", "<script>", None, None, "reproduced", "x & y")
    text = Verdicts([verdict])._repr_html_()
    assert "a&lt;b" in text and "&lt;script&gt;" in text and "x &amp; y" in text
    assert "script" not in Outline(text).seen


# --- notation -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (-0.0, "0"),
        (5.9e4, r"5.9\times10^{4}"),
        (1e-6, "10^{-6}"),
        (-1e20, "-10^{20}"),
        (9140.0, "9140"),
        (-0.25, "-0.25"),
        (math.inf, r"\infty"),
        (-math.inf, r"-\infty"),
        (math.nan, r"\mathrm{nan}"),
    ],
)
def test_numbers(value, text):
    assert notation.number(value) == text


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_is_what_it_says(value):
    text = notation.number(value)
    text = text.replace(r"\times10^{", "e").replace("10^{", "1e").replace("}", "")
    # 4 digits, and denormal numbers have fewer
    assert float(text) == pytest.approx(value, rel=5.1e-4, abs=1e-320)


def test_matrices_are_elided_in_the_middle():
    whole = np.arange(1.0, 101.0).reshape(10, 10)
    text = notation.matrix(whole)
    rows = text.removeprefix(r"\begin{bmatrix}").removesuffix(r"\end{bmatrix}").split(r" \\ ")
    assert rows[0] == r"1 & 2 & 3 & 4 & \cdots & 10"
    assert rows[4] == r"\vdots & \vdots & \vdots & \vdots & \ddots & \vdots"
    assert rows[5] == r"91 & 92 & 93 & 94 & \cdots & 100"
    assert notation.matrix(np.zeros((0, 3))) == r"0_{0\times3}"
    assert notation.matrix([[2.5]]) == "2.5"


def test_rounding_noise_is_shown_as_zero_whatever_the_units():
    noisy = np.array([[1.0, 1e-18], [2.0, 3.0]])
    for unit in (1e-9, 1.0, 1e9):
        assert "& 0 " in notation.matrix(unit * noisy)
    # an entry that is alone in its column has a unit of its own
    assert "10^{-18}" in notation.matrix([[1.0, 1e-18]])


def test_sums_leave_out_what_is_zero():
    products = [notation.product(factor, "x") for factor in ([[0.0]], [[2.0]], [[-3.0]], [[1.0]])]
    assert notation.total(products) == r"2\,x - 3\,x + x"
    assert notation.total(["", ""]) == "0"


def test_arrays_are_elided():
    assert notation.array(range(9)) == "[0, 1, 2, 3, ..., 8]"
    assert notation.array(np.eye(2)) == "[[1, 0], [0, 1]]"
    assert notation.array(np.eye(3)) == "<3 x 3>"


def test_a_solution_says_its_certificate():
    solution = solve_riccati(-np.eye(2), np.eye(2), np.eye(2))
    assert re.fullmatch(r"RiccatiSolution\(residual=.*, error=.*\)", repr(solution))


def test_a_table_shows_itself_in_a_terminal_as_markdown():
    table = Table(("a",), [(1.5,)], "Caption.")
    assert repr(table) == str(table) == table.markdown()
