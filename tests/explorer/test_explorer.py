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
from matplotlib.text import Text

import robsmooth as rs
from robsmooth.explorer import Explorer, Settings, describe, explorer
from robsmooth.explorer import snapshot as model
from robsmooth.explorer.panels import NO_DESIGN, Panels
from robsmooth.explorer.snapshot import DESIGNS, RANGES
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


def whole(chosen):
    """A snapshot with all that there is to see."""
    return model.judge(model.take_snapshot(chosen))


def pixels(png):
    return matplotlib.image.imread(io.BytesIO(png))


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RANGES)
def test_a_slider_can_stand_at_its_default(name):
    allowed = RANGES[name]
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
    for name in given.keys() & RANGES.keys():
        allowed, interval = RANGES[name], given[name].interval
        limits = {"low": allowed.si(allowed.low), "high": allowed.si(allowed.high)}
        assert interval == {**limits, "without": []}
    for name in given.keys() & asdict(PAPER).keys():
        assert given[name].default == getattr(PAPER, name)


# --- what is shown --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DESIGNED)
def test_the_code_finds_the_numbers_of_the_panels(name):
    snapshot = whole(DESIGNED[name])
    found = {"print": lambda *_: None}
    exec(describe.code(snapshot.settings), found)
    assert np.array_equal(found["filtered"], snapshot.sweeps.own.filtered)
    assert np.array_equal(found["smoothed"], snapshot.sweeps.own.smoothed)
    assert found["with_sine"] == snapshot.predicted.own
    assert found["judged"] == snapshot.judged.own
    for matrix in ("A_c", "B_c", "C_c"):
        own = getattr(snapshot.estimator, matrix)
        assert np.array_equal(getattr(found["smoother"], matrix), own)


def test_where_there_is_no_design_the_code_raises_what_the_panels_say():
    snapshot = whole(INFEASIBLE)
    with pytest.raises(rs.InfeasibleDesignError) as refusal:
        exec(describe.code(INFEASIBLE), {})
    assert str(refusal.value) == snapshot.estimator == snapshot.sweeps
    assert snapshot.predicted == snapshot.path == snapshot.judged == snapshot.estimator
    assert snapshot.estimator in describe.summary(snapshot)


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
@pytest.mark.parametrize("change", [{}, {"gamma": 0.7, "lag": 1e-6}, {"noise": 3.0, "order": 1}])
def test_the_robust_design_has_the_least_bound(cost, change):
    design = model.design(Settings(**change, cost=cost))
    least = rs.minimize_bound(design.plant, cost)
    assert design.bound == pytest.approx(least.bound_infimum, rel=1e-6)


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
@pytest.mark.parametrize("design", ["robust", "minimax", "classical", "tuned classical"])
def test_the_three_errors_are_in_their_order_and_below_the_papers_bound(cost, design):
    snapshot = whole(Settings(cost=cost, design=design))
    own, classical = snapshot.judged
    assert own.nominal < own.worst_constant < own.certified * (1 + 1e-6)
    assert own.nominal == pytest.approx(getattr(snapshot.sweeps.own, cost)[-1], rel=1e-9)
    assert own.worst_constant == pytest.approx(getattr(snapshot.sweeps.own, cost)[0], rel=1e-3)
    if design == "robust":
        assert own.certified < snapshot.estimator.mean_square_bound
    assert classical == whole(snapshot.settings.classical).judged.own


def test_the_new_designs_are_ahead_in_what_they_are_for():
    judged = {
        design: whole(Settings(cost="smoothed", design=design)).judged for design in DESIGNS[:4]
    }
    certified = {design: found.own.certified for design, found in judged.items()}
    constant = {design: found.own.worst_constant for design, found in judged.items()}
    assert min(certified, key=certified.get) == "minimax"
    assert min(constant, key=constant.get) == "tuned classical"


def test_what_is_judged_at_once_stays_nearly_as_it_is_when_the_certificate_is_there():
    quick = model.take_snapshot(PAPER)
    for before, after in zip(quick.judged, model.judge(quick).judged, strict=True):
        assert np.isnan(before.certified)
        assert np.isfinite(after.certified)
        assert before.nominal == pytest.approx(after.nominal, rel=1e-9)
        assert before.worst_constant == pytest.approx(after.worst_constant, rel=1e-3)
    assert describe.JUDGING in describe.summary(quick)


def test_references_are_the_best_that_there_are():
    classical = model.take_snapshot(Settings(design="classical", order=5))
    own = classical.sweeps.own
    assert classical.filtering == pytest.approx(own.filtered[-1], rel=1e-6)
    assert classical.optimum == pytest.approx(own.smoothed[-1], rel=2e-3)
    assert classical.optimum < own.smoothed[-1]
    robust = model.take_snapshot(Settings(order=5))
    assert np.array_equal(robust.sweeps.classical.smoothed, own.smoothed)


@pytest.mark.parametrize("name", ["paper", "other light", "minimax"])
def test_the_errors_with_the_sine_are_those_of_its_stationary_density(name):
    chosen = DESIGNED[name]
    found = model.take_snapshot(chosen)
    for loop, each in zip(found.predicted, (chosen, chosen.classical), strict=True):
        exact = rs.stationary_errors(chosen.parameters, model.design(each))
        assert loop.filtered == pytest.approx(exact.filtered, rel=0.01)
        assert loop.smoothed == pytest.approx(exact.smoothed, rel=0.01)


def test_the_path_is_one_of_the_loop():
    """Averaged over time, its errors are those of the simulation, as far as chance lets them."""
    path = model.take_snapshot(PAPER).path
    then = path.time - PAPER.lag
    filtered = np.mean((path.phase - path.filtered) ** 2)
    delayed = np.interp(then, path.time, path.phase)
    smoothed = np.mean((delayed - path.smoothed)[then > 0.0] ** 2)
    assert 0.03 < smoothed < filtered < 0.2
    moved = model.take_snapshot(replace(PAPER, lag=3.2e-6, order=3)).path
    assert np.allclose(moved.phase, path.phase, rtol=1e-9, atol=1e-9)
    assert np.abs(moved.smoothed - path.smoothed).max() < 0.2


def positions(allowed):
    """What a slider can be at."""
    steps = round((allowed.high - allowed.low) / allowed.step)
    return st.integers(0, steps).map(lambda k: allowed.si(allowed.low + k * allowed.step))


all_settings = st.builds(
    Settings,
    **{name: positions(allowed) for name, allowed in RANGES.items()},
    cost=st.sampled_from(["filtered", "smoothed"]),
    design=st.sampled_from(DESIGNS),
)


@pytest.fixture(scope="module")
def panels():
    return Panels()


@settings(max_examples=40)
@given(all_settings)
def test_every_setting_gives_panels_or_a_sentence(panels, chosen):
    snapshot = whole(chosen)
    panels.update(snapshot)
    assert pixels(panels.png()).shape == (585, 910, 3)
    assert describe.summary(snapshot).endswith(".")
    if isinstance(snapshot.estimator, str):
        shown = [text.get_text().replace("\n", " ") for text in panels.figure.findobj(Text)]
        assert snapshot.estimator in shown
        assert shown.count(NO_DESIGN) == 2


def test_words_say_where_theory_ends():
    for chosen, share in ((PAPER, "2e-08"), (Settings(kappa=2e5, noise=2.0), "3e-03")):
        assert f"a share of {share} of the time" in describe.summary(whole(chosen))
    weak = whole(Settings(kappa=4e3, lam=5e4, noise=5.0, gamma=0.8, cost="smoothed", lag=15e-6))
    assert "not to measure at all is as good, 0.0400 rad²" in describe.summary(weak)
    classical = whole(Settings(design="classical"))
    assert "a filtered error of at most 0.1388 rad²." in describe.summary(classical)
    own = replace(classical.judged.own, certified=np.inf)
    without = replace(classical, judged=classical.judged._replace(own=own))
    assert "Nothing is certified" in describe.summary(without)


def test_too_long_a_lag_is_said_to_be_worse_than_none():
    snapshot = whole(Settings(lag=15e-6, order=1))
    assert snapshot.predicted.own.smoothed > snapshot.predicted.own.filtered
    assert "above the filter's" in describe.summary(snapshot)


# --- the figure -----------------------------------------------------------------------------------


def test_the_figure_fits_a_page_and_nothing_is_in_the_way_of_its_words(panels):
    panels.update(whole(PAPER))
    figure = panels.figure
    assert figure.get_figwidth() <= 7.0
    assert looks.flaws(figure) == []


def test_a_figure_depends_on_the_settings_alone(panels):
    snapshot = whole(PAPER)
    panels.update(snapshot)
    first = panels.png()
    panels.update(whole(INFEASIBLE))
    assert panels.png() != first
    with mpl.rc_context({"axes.prop_cycle": mpl.cycler(color=["k"]), "font.size": 20}):
        panels.update(snapshot)
        assert panels.png() == first


def test_without_a_prediction_the_other_errors_are_drawn(panels):
    panels.update(replace(whole(PAPER), predicted="no stationary variance"))
    (axes,) = [each for each in panels.figure.axes if "errors of" in each.get_title()]
    drawn = [line.get_ydata() for line in axes.lines if line.get_label() != "the paper's bound 2V"]
    assert np.isfinite(drawn).tolist() == [[True, True, True, False]] * 2


def test_without_a_design_only_what_depends_on_it_changes(panels):
    panels.update(whole(PAPER))
    with_design = pixels(panels.png())
    panels.update(whole(INFEASIBLE))
    changed = (pixels(panels.png()) != with_design).any(axis=2)
    for axes in panels.figure.axes:
        box = axes.get_window_extent()
        rows = slice(round(585 - box.y1), round(585 - box.y0))
        inside = changed[rows, round(box.x0) : round(box.x1)]
        assert inside.any()
        changed[rows, round(box.x0) - 2 : round(box.x1) + 9] = False  # the star is on the edge
    assert not changed.any()


# --- controls, and what is drawn when -------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch):
    """The settings that were drawn, in order."""
    seen = []
    monkeypatch.setattr(
        explorer, "take_snapshot", lambda chosen: seen.append(chosen) or model.take_snapshot(chosen)
    )
    return seen


def test_the_controls_have_their_panels_from_the_start():
    async def show():
        controls = Explorer().show_controls()
        return controls.panels.value, controls.summary.value, controls.code.value

    assert all(asyncio.run(show()))


def test_a_slider_changes_the_panels_and_reset_brings_them_back():
    shown = Explorer(replace(PAPER, lag=2e-6))
    controls = shown.show_controls()
    first = {name: getattr(controls, name).value for name in ("panels", "summary", "code")}
    controls.inputs["lag"].value = 4.0
    assert shown.settings == replace(PAPER, lag=4e-6) == shown.snapshot.settings
    for name, value in first.items():
        assert getattr(controls, name).value != value
    controls.reset.click()
    for name, value in first.items():
        assert getattr(controls, name).value == value


def test_reset_is_one_change(drawn):
    shown = Explorer()
    controls = shown.show_controls()
    for name in ("lag", "gamma", "noise"):
        controls.inputs[name].value *= 1.5
    del drawn[:]
    controls.reset.click()
    assert drawn == [PAPER]


def test_only_controls_that_matter_are_there():
    controls = Explorer().show_controls()
    *always, by_hand = controls.widget.children[0].children
    assert controls.inputs["tau"] in by_hand.children[1].children
    shown = {}
    for design in ("robust", "by hand", "classical"):
        controls.inputs["design"].value = design
        shown[design] = by_hand.layout.display != "none"
        assert all(column.layout.display != "none" for column in always)
    assert shown == {"robust": False, "by hand": True, "classical": False}


def test_without_a_design_the_reason_is_said_and_escaped():
    controls = Explorer().show_controls()
    controls.inputs["design"].value = "by hand"
    assert "Assumption 3.2 (Riccati equation for X) fails" in controls.summary.value
    controls.inputs["lambda2"].value = 1.0
    assert "M(lambda)^-1 &gt;= J J&#x27;" in controls.summary.value


def test_the_code_is_copied_by_the_browser():
    controls = Explorer().show_controls()
    controls.copy.click()
    controls.copy.click()
    (output,) = controls._script.outputs  # not one more for each click
    script = output["data"]["application/javascript"]
    assert "clipboard.writeText" in script
    (own,) = [name for name in controls.widget._dom_classes if f".{name} textarea" in script]
    assert own != Explorer().show_controls().widget._dom_classes[-1]


def test_of_many_events_the_newest_only_is_drawn(drawn):
    async def drag():
        shown = Explorer()
        controls = shown.show_controls()
        del drawn[:]
        for lag in np.linspace(4.0, 5.0, 11):
            controls.inputs["lag"].value = lag
        while not drawn:
            await asyncio.sleep(0.001)
        return shown.settings

    assert asyncio.run(drag()) == replace(PAPER, lag=5e-6)
    assert drawn == [replace(PAPER, lag=5e-6)]


def test_the_certificate_keeps_nothing_else_waiting(monkeypatch):
    may_go_on = threading.Event()
    monkeypatch.setattr(
        explorer, "judge", lambda snapshot: may_go_on.wait(PATIENCE) and model.judge(snapshot)
    )

    async def explore():
        controls = Explorer().show_controls()
        before = controls.panels.value
        controls.inputs["design"].value = "minimax"
        while controls.panels.value == before:
            await asyncio.sleep(0.001)
        assert controls.summary.value.count("With the sine in the loop") == 1
        assert describe.JUDGING in controls.summary.value
        drawn = controls.panels.value
        may_go_on.set()
        while describe.JUDGING in controls.summary.value:
            await asyncio.sleep(0.001)
        assert "Certified" in controls.summary.value
        assert controls.panels.value != drawn

    asyncio.run(explore())


def test_an_explorer_shows_itself_as_an_image_where_nobody_is():
    shown = Explorer()
    bundle = shown._repr_mimebundle_()
    assert set(bundle) == {"image/png", "text/plain"}
    assert pixels(base64.b64decode(bundle["image/png"])).shape == (585, 910, 3)
    assert bundle["text/plain"] == describe.summary(shown.snapshot)
    assert shown.controls is None


@pytest.mark.parametrize("answers", [True, False])
def test_an_explorer_shows_its_sliders_to_who_can_move_them(monkeypatch, answers):
    request = {"content": {"allow_stdin": answers}}
    kernel = SimpleNamespace(get_parent=lambda channel: request if channel == "shell" else {})
    monkeypatch.setattr(explorer, "get_ipython", lambda: SimpleNamespace(kernel=kernel))
    bundle = Explorer()._repr_mimebundle_()
    assert ("application/vnd.jupyter.widget-view+json" in bundle) == answers
    assert "image/png" in bundle
