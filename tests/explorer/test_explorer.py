"""The explorer: its numbers are the library's, every setting gives panels or a sentence."""

import asyncio
import base64
import io
import threading
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib as mpl
import matplotlib.image
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robsmooth as rs
from robsmooth.explorer import Explorer, Settings, explorer, panels
from robsmooth.explorer.explorer import JUDGING, summary
from robsmooth.explorer.snapshot import DESIGNS, SLIDERS, STEP, take_snapshot
from robsmooth.paper.figures import use_style
from robsmooth.workbench import parameters
from tests.helpers import looks
from tests.helpers.waiting import PATIENCE

NOTEBOOK = Path(__file__).resolve().parents[2] / "notebooks" / "explore.ipynb"
PAPER = Settings()
ON_ITS_FACE = {"design": "by hand", "lambda1": 1.0, "lambda2": 0.5, "lambda3": 0.0, "lambda4": 0.0}
INFEASIBLE = replace(PAPER, design="by hand")
DESIGNED = {
    "paper": PAPER,
    "smoothed cost": Settings(cost="smoothed", lag=8e-6, gamma=0.3),
    "by hand": Settings(**ON_ITS_FACE, tau=1.3e-6, order=1),
    "other light": Settings(noise=0.5, lam=2e4, kappa=1e5, order=1),
    "classical": Settings(design="classical", kappa=2e4),
    "minimax": Settings(design="minimax", cost="smoothed"),
    "tuned": Settings(design="tuned classical", lag=2e-6, gamma=0.6),
}


def pixels(png):
    return matplotlib.image.imread(io.BytesIO(png))


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SLIDERS)
def test_a_slider_can_stand_at_its_default(name):
    allowed = SLIDERS[name]
    steps = (allowed.shown(getattr(PAPER, name)) - allowed.low) / allowed.step
    assert steps == pytest.approx(round(steps), abs=1e-9)
    assert allowed.si(allowed.shown(getattr(PAPER, name))) == getattr(PAPER, name)


def test_the_defaults_are_the_paper():
    assert PAPER.parameters == rs.homodyne.PAPER


def test_noise_is_that_of_a_weaker_beam():
    noisier = Settings(noise=4.0).parameters
    assert noisier == replace(rs.homodyne.PAPER, alpha=rs.homodyne.PAPER.alpha / 2)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"lag": 1.0}, r"lag must be finite and in \[2e-07, 1.5e-05\], got 1.0"),
        ({"order": 2.5}, "order must be a whole number, got 2.5"),
        ({"cost": "low"}, "cost must be one of 'filtered', 'smoothed', got 'low'"),
        (
            {"design": "good"},
            "design must be one of 'robust', 'minimax', 'classical', .* got 'good'",
        ),
    ],
    ids=lambda given: "-".join(given) if isinstance(given, dict) else "",
)
def test_bad_settings_are_refused_with_a_sentence(wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        Settings(**wrong)


def test_the_notebook_allows_what_the_sliders_do():
    given = parameters.read(NOTEBOOK)
    for name in given.keys() & SLIDERS.keys():
        allowed, interval = SLIDERS[name], given[name].interval
        limits = {"low": allowed.si(allowed.low), "high": allowed.si(allowed.high)}
        assert interval == {**limits, "without": []}
    for name in given.keys() & asdict(PAPER).keys():
        assert given[name].default == getattr(PAPER, name)


# --- what is shown --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DESIGNED)
def test_the_code_finds_the_numbers_of_the_panels(name):
    own = take_snapshot(DESIGNED[name]).own
    found = {"print": lambda *_, **__: None}
    exec(DESIGNED[name].code(), found)
    assert np.array_equal(found["filtered"], own.filtered)
    assert np.array_equal(found["smoothed"], own.smoothed)
    assert found["with_sine"] == own.with_sine
    assert found["judged"] == own.judged
    for matrix in ("A_c", "B_c", "C_c"):
        assert np.array_equal(getattr(found["smoother"], matrix), getattr(own.estimator, matrix))


def test_where_there_is_no_design_the_code_raises_what_is_said():
    with pytest.raises(rs.InfeasibleDesignError) as refusal:
        exec(INFEASIBLE.code(), {})
    assert f"{refusal.value}." == take_snapshot(INFEASIBLE)
    assert f"{refusal.value}." in summary(take_snapshot(INFEASIBLE))


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
@pytest.mark.parametrize("change", [{}, {"gamma": 0.7, "lag": 1e-6}, {"noise": 3.0, "order": 1}])
def test_the_robust_design_has_the_least_bound(cost, change):
    design = Settings(**change, cost=cost).estimator()
    least = rs.minimize_bound(design.plant, cost)
    assert design.bound == pytest.approx(least.bound_infimum, rel=1e-6)


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
@pytest.mark.parametrize("design", ["robust", "minimax", "classical", "tuned classical"])
def test_the_three_errors_are_in_their_order_and_below_the_papers_bound(cost, design):
    chosen = Settings(cost=cost, design=design)
    snapshot = take_snapshot(chosen)
    own = snapshot.own.judged
    assert own.nominal < own.worst_constant < own.certified * (1 + 1e-6)
    assert own.nominal == pytest.approx(getattr(snapshot.own, cost)[-1], rel=1e-9)
    assert own.worst_constant == pytest.approx(getattr(snapshot.own, cost)[0], rel=1e-3)
    if design == "robust":
        assert own.certified < snapshot.own.estimator.mean_square_bound
    classical = take_snapshot(replace(chosen, design="classical")).own
    assert snapshot.classical.judged == classical.judged
    assert np.array_equal(snapshot.classical.smoothed, classical.smoothed)


def test_the_new_designs_are_ahead_in_what_they_are_for():
    judged = {
        design: take_snapshot(Settings(cost="smoothed", design=design)).own.judged
        for design in DESIGNS[:4]
    }
    certified = {design: found.certified for design, found in judged.items()}
    constant = {design: found.worst_constant for design, found in judged.items()}
    assert min(certified, key=certified.get) == "minimax"
    assert min(constant, key=constant.get) == "tuned classical"


def test_what_is_judged_at_once_stays_nearly_as_it_is_when_the_certificate_is_there():
    quick, whole = take_snapshot(PAPER, certified=False), take_snapshot(PAPER)
    for name in ("own", "classical"):
        before, after = getattr(quick, name).judged, getattr(whole, name).judged
        assert np.isnan(before.certified)
        assert np.isfinite(after.certified)
        assert before.nominal == pytest.approx(after.nominal, rel=1e-9)
        assert before.worst_constant == pytest.approx(after.worst_constant, rel=1e-3)
    assert JUDGING in summary(quick)
    assert JUDGING not in summary(whole)


def test_references_are_the_best_that_there_are():
    classical = take_snapshot(Settings(design="classical", order=5))
    assert classical.filtering == pytest.approx(classical.own.filtered[-1], rel=1e-6)
    assert classical.optimum == pytest.approx(classical.own.smoothed[-1], rel=2e-3)
    assert classical.optimum < classical.own.smoothed[-1]


@pytest.mark.parametrize("name", ["paper", "other light", "minimax"])
def test_the_errors_with_the_sine_are_those_of_its_stationary_density(name):
    snapshot = take_snapshot(DESIGNED[name])
    for found in (snapshot.own, snapshot.classical):
        exact = rs.stationary_errors(DESIGNED[name].parameters, found.estimator)
        assert found.with_sine.filtered == pytest.approx(exact.filtered, rel=0.01)
        assert found.with_sine.smoothed == pytest.approx(exact.smoothed, rel=0.01)


def test_the_path_is_one_of_the_loop():
    """Averaged over time, its errors are those of the simulation, as far as chance lets them."""
    phase, filtered, smoothed = take_snapshot(PAPER).path
    steps = np.arange(len(phase))
    then = steps - PAPER.lag / STEP
    delayed = np.interp(then, steps, phase)
    late = np.mean((delayed - smoothed)[then > 0.0] ** 2)
    assert 0.03 < late < np.mean((phase - filtered) ** 2) < 0.2
    moved = take_snapshot(replace(PAPER, lag=3.2e-6, order=3)).path
    assert np.allclose(moved[0], phase, rtol=1e-9, atol=1e-9)
    assert np.abs(moved[2] - smoothed).max() < 0.2


def positions(slider):
    """What a slider can be at."""
    steps = round((slider.high - slider.low) / slider.step)
    return st.integers(0, steps).map(lambda k: slider.si(slider.low + k * slider.step))


all_settings = st.builds(
    Settings,
    **{name: positions(slider) for name, slider in SLIDERS.items()},
    cost=st.sampled_from(["filtered", "smoothed"]),
    design=st.sampled_from(DESIGNS),
)


@settings(max_examples=40)
@given(all_settings)
def test_every_setting_gives_panels_or_a_sentence(chosen):
    found = take_snapshot(chosen)
    assert pixels(panels.png(found)).shape[:2] == (585, 910)
    assert summary(found).endswith(".")


def test_too_long_a_lag_is_said_to_be_worse_than_none():
    found = take_snapshot(Settings(lag=15e-6, order=1))
    assert found.own.with_sine.smoothed > found.own.with_sine.filtered
    assert "above the filter's" in summary(found)


# --- the figure -----------------------------------------------------------------------------------


def test_the_figure_fits_a_page_and_nothing_is_in_the_way_of_its_words():
    with mpl.rc_context():
        use_style()
        figure = panels.draw(take_snapshot(PAPER))
        assert figure.get_figwidth() <= 7.0
        assert looks.flaws(figure) == []


def test_a_figure_depends_on_the_settings_alone():
    first = panels.png(take_snapshot(PAPER))
    assert panels.png(take_snapshot(replace(PAPER, gamma=0.5))) != first
    with mpl.rc_context({"axes.prop_cycle": mpl.cycler(color=["k"]), "font.size": 20}):
        assert panels.png(take_snapshot(PAPER)) == first


def test_an_error_that_is_infinite_is_absent_and_the_others_are_drawn():
    found = take_snapshot(PAPER)
    judged = replace(found.own.judged, certified=np.inf)
    figure = panels.draw(replace(found, own=replace(found.own, judged=judged)))
    drawn = {
        line.get_label(): np.isfinite(line.get_ydata()).tolist() for line in figure.axes[2].lines
    }
    assert drawn["this design"] == [True, True, False, True]
    assert drawn["classical smoother"] == [True] * 4


def test_where_there_is_no_design_the_sentence_takes_the_place_of_the_panels():
    sentence = take_snapshot(INFEASIBLE)
    figure = panels.draw(sentence)
    assert not figure.axes
    assert [text.get_text().replace("\n", " ") for text in figure.texts] == [sentence]


# --- controls, and what is drawn when -------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch):
    """The settings that were drawn, in order."""
    seen = []

    def take(chosen, certified=True):
        seen.append(chosen)
        return take_snapshot(chosen, certified)

    monkeypatch.setattr(explorer, "take_snapshot", take)
    return seen


def values(shown):
    """What the picture, the summary and the code are."""
    shown.widget  # noqa: B018 - they are made with it
    return shown._image.value, shown._summary.value, shown._code.value


async def until(condition):
    """Wait for something."""
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.001)


def test_a_slider_changes_the_panels_and_reset_brings_them_back(drawn):
    async def use():
        shown = Explorer(replace(PAPER, lag=2e-6))
        first = values(shown)
        assert all(first)
        shown.inputs["lag"].value = 4.0
        assert shown.settings == replace(PAPER, lag=4e-6)
        await until(lambda: values(shown)[0] != first[0])
        for old, new in zip(first, values(shown), strict=True):
            assert old != new
        shown.inputs["gamma"].value = 0.5
        del drawn[:]
        (reset,) = [
            each for each in shown.widget.children if isinstance(each, explorer.widgets.Button)
        ]
        reset.click()
        await until(lambda: values(shown) == first)
        assert set(drawn) == {replace(PAPER, lag=2e-6)}  # it is one change

    asyncio.run(use())


def test_only_controls_that_matter_are_there():
    async def use():
        shown = Explorer()
        *always, by_hand = shown.widget.children[0].children
        assert shown.inputs["tau"] in by_hand.children[1].children
        for design in ("classical", "by hand", "robust"):
            shown.inputs["design"].value = design
            hidden = "flex" if design == "by hand" else "none"
            await until(lambda hidden=hidden: by_hand.layout.display == hidden)
            assert all(column.layout.display != "none" for column in always)

    asyncio.run(use())


def test_without_a_design_the_reason_is_said_and_escaped():
    assert "Assumption 3.2 (Riccati equation for X) fails" in values(Explorer(INFEASIBLE))[1]
    refused = values(Explorer(replace(INFEASIBLE, lambda2=1.0)))[1]
    assert "M(lambda)^-1 &gt;= J J&#x27;" in refused


def test_of_many_events_the_newest_only_is_drawn(drawn):
    async def drag():
        shown = Explorer()
        values(shown)
        del drawn[:]
        for lag in np.linspace(4.0, 5.0, 11):
            shown.inputs["lag"].value = lag
        await until(lambda: drawn)

    asyncio.run(drag())
    assert drawn == [replace(PAPER, lag=5e-6)]


def test_the_certificate_keeps_nothing_else_waiting(monkeypatch):
    may_go_on = threading.Event()

    def take(chosen, certified=True):
        assert not certified or chosen == PAPER or may_go_on.wait(PATIENCE)
        return take_snapshot(chosen, certified)

    monkeypatch.setattr(explorer, "take_snapshot", take)

    async def use():
        shown = Explorer()
        before = values(shown)
        shown.inputs["design"].value = "minimax"
        await until(lambda: values(shown)[0] != before[0])
        drawn = values(shown)
        assert JUDGING in drawn[1]
        may_go_on.set()
        await until(lambda: JUDGING not in values(shown)[1])
        assert values(shown)[0] != drawn[0]

    asyncio.run(use())


def test_a_certificate_that_is_late_is_not_shown(monkeypatch):
    asked, may_go_on = threading.Event(), threading.Event()

    def take(chosen, certified=True):
        if certified and chosen.lag == 4e-6:
            asked.set()
            assert may_go_on.wait(PATIENCE)
        return take_snapshot(chosen, certified)

    monkeypatch.setattr(explorer, "take_snapshot", take)

    async def use():
        shown = Explorer()
        values(shown)
        shown.inputs["lag"].value = 4.0
        await until(asked.is_set)
        shown.inputs["lag"].value = 5.0
        may_go_on.set()
        await until(lambda: "delay=5e-06" in values(shown)[2])
        await until(lambda: JUDGING not in values(shown)[1])
        assert values(shown)[0] == panels.png(take_snapshot(replace(PAPER, lag=5e-6)))

    asyncio.run(use())


def test_an_explorer_shows_itself_as_an_image_where_nobody_is():
    shown = Explorer()
    bundle = shown._repr_mimebundle_()
    assert set(bundle) == {"image/png", "text/plain"}
    assert pixels(base64.b64decode(bundle["image/png"])).shape[:2] == (585, 910)
    assert bundle["text/plain"] == summary(shown.snapshot)
    assert not shown.inputs


@pytest.mark.parametrize("answers", [True, False])
def test_an_explorer_shows_its_sliders_to_who_can_move_them(monkeypatch, answers):
    request = {"content": {"allow_stdin": answers}}
    kernel = SimpleNamespace(get_parent=lambda channel: request if channel == "shell" else {})
    monkeypatch.setattr(explorer, "get_ipython", lambda: SimpleNamespace(kernel=kernel))
    bundle = Explorer()._repr_mimebundle_()
    assert ("application/vnd.jupyter.widget-view+json" in bundle) == answers
    assert "image/png" in bundle
