"""The explorer: its numbers are the library's, every setting gives panels or a sentence."""

import asyncio
import base64
import io
import math
import re
import threading
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import matplotlib as mpl
import matplotlib.image
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robsmooth as rs
from robsmooth.explorer import Explorer, Settings, explorer, panels, snapshot
from robsmooth.explorer.explorer import JUDGING, verdict
from robsmooth.explorer.snapshot import (
    DELAYS,
    DESIGNS,
    SLIDERS,
    STEP,
    Snapshot,
    over_delays,
    sample_path,
    take_snapshot,
)
from robsmooth.paper.figures import use_style
from robsmooth.paper.published import printed
from robsmooth.workbench import parameters
from tests.helpers import looks
from tests.helpers.waiting import PATIENCE

NOTEBOOK = Path(__file__).resolve().parents[2] / "notebooks" / "explore.ipynb"
PAPER = Settings()
ON_ITS_FACE = {"design": "by hand", "lambda1": 1.0, "lambda2": 0.5, "lambda3": 0.0, "lambda4": 0.0}
AS_PRINTED = {name: printed(name.replace("lambda", "lambda_")) for name in list(SLIDERS)[-5:]}
INFEASIBLE = Settings(design="by hand", cost="filtered", **AS_PRINTED)
DESIGNED = {
    "paper": PAPER,
    "filtered cost": Settings(cost="filtered", delay=8e-6, gamma=0.3),
    "by hand": Settings(**ON_ITS_FACE, tau=1.3e-6, order=1),
    "other light": Settings(noise=0.5, lam=2e4, kappa=1e5, order=1),
    "classical": Settings(design="classical", kappa=2e4),
    "paper's V": Settings(design="paper's V", cost="filtered"),
    "tuned": Settings(design="tuned", delay=2e-6, gamma=0.6),
}


@pytest.fixture(autouse=True, scope="module")
def remembered():
    """Designs and their errors are kept, as most tests look at the same few settings."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(snapshot, "_designed", cache(snapshot._designed.__wrapped__))
        patch.setattr(snapshot, "_findings", cache(snapshot._findings))
        yield


def pixels(png):
    return matplotlib.image.imread(io.BytesIO(png))


def images(found, titles=panels.OVERVIEW):
    """The images of panels that have drawn nothing before."""
    return tuple(panels.png(panels.Panel(title).pixels(found)) for title in titles)


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
        ({"delay": 1.0}, r"delay must be finite and in \[2e-07, 1.5e-05\], got 1.0"),
        ({"order": 2.5}, "order must be a whole number, got 2.5"),
        ({"cost": "low"}, "cost must be one of 'filtered', 'smoothed', got 'low'"),
        (
            {"design": "good"},
            "design must be one of 'classical', 'tuned', .* got 'good'",
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
def test_the_code_finds_the_numbers_of_the_design(name):
    own = take_snapshot(DESIGNED[name]).own
    found = {"print": lambda *_, **__: None}
    exec(DESIGNED[name].code(), found)
    assert found["with_sine"] == own.with_sine
    assert found["judged"] == own.judged
    for matrix in ("A_c", "B_c", "C_c"):
        assert np.array_equal(getattr(found["smoother"], matrix), getattr(own.estimator, matrix))


def test_where_there_is_no_design_the_code_raises_what_is_said():
    with pytest.raises(rs.InfeasibleDesignError) as refusal:
        exec(INFEASIBLE.code(), {})
    said = take_snapshot(INFEASIBLE)
    assert said.endswith(f"The reason: {refusal.value}.")
    assert verdict(said) == [f"There is no design. {said}"]


def test_a_design_by_hand_starts_at_one_that_exists():
    found = take_snapshot(Settings(design="by hand"))
    assert found.own.judged.certified < 1.05 * found.found["minimax"].judged.certified


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
@pytest.mark.parametrize("change", [{}, {"gamma": 0.7, "delay": 1e-6}, {"noise": 3.0, "order": 1}])
def test_the_papers_design_has_the_least_bound(cost, change):
    design = Settings(**change, cost=cost, design="paper's V").estimator()
    least = rs.minimize_bound(design.plant, cost)
    assert design.bound == pytest.approx(least.bound_infimum, rel=1e-6)


@pytest.mark.parametrize("cost", ["filtered", "smoothed"])
def test_the_three_errors_are_in_their_order_and_below_the_papers_bound(cost):
    snapshot = take_snapshot(Settings(cost=cost))
    assert set(snapshot.found) == set(DESIGNS[:4])
    for name, found in snapshot.found.items():
        judged = found.judged
        assert judged.nominal < judged.worst_constant < judged.certified * (1 + 1e-6)
        alone = take_snapshot(Settings(cost=cost, design=name)).own
        assert alone.judged == judged
        assert alone.with_sine == found.with_sine
    paper = snapshot.found["paper's V"]
    assert paper.judged.certified < paper.estimator.mean_square_bound


def test_the_designs_are_ahead_in_what_they_are_for():
    found = take_snapshot(PAPER).found
    assert min(found, key=lambda name: found[name].judged.certified) == "minimax"
    assert min(found, key=lambda name: found[name].judged.worst_constant) == "tuned"
    assert min(found, key=lambda name: found[name].judged.nominal) == "classical"


def test_a_design_that_does_not_exist_leaves_the_others_there(monkeypatch):
    def refuse(*_, **__):
        raise rs.InfeasibleDesignError("Assumption 3.2", "as a test")

    monkeypatch.setattr(rs, "limiting_smoother", refuse)
    found = take_snapshot(replace(PAPER, delay=2.7e-6))
    assert set(found.found) == set(DESIGNS[:3])
    assert len(verdict(found)) == 3


def test_what_is_shown_at_once_stays_when_the_certificates_are_there():
    quick, whole = take_snapshot(PAPER, complete=False), take_snapshot(PAPER)
    assert {*quick.found} == {"classical", PAPER.design}
    for name, before in quick.found.items():
        after = whole.found[name]
        assert np.isnan(before.judged.certified)
        assert np.isfinite(after.judged.certified)
        assert before.judged.nominal == pytest.approx(after.judged.nominal, rel=1e-9)
        assert before.with_sine == after.with_sine
    assert (quick.is_complete, whole.is_complete) == (False, True)
    assert JUDGING in verdict(quick)
    assert verdict(whole)[0] == verdict(quick)[0]


def test_the_verdict_has_the_numbers_of_the_library():
    uncertain = replace(PAPER, gamma=0.7)
    first, second, third = verdict(take_snapshot(uncertain))
    minimax, classical = (replace(uncertain, design=each) for each in ("minimax", "classical"))
    with_sine = rs.statistical_linearisation(uncertain.parameters, minimax.estimator())
    saved = 1.0 - with_sine.smoothed / with_sine.filtered
    assert f"from {with_sine.filtered:.4f} rad² to {with_sine.smoothed:.4f} rad²" in first
    assert f"lowers the mean square error from {with_sine.filtered:.4f}" in first
    assert first.endswith(f"by {saved:.1%}.")
    robust, plain = (rs.judge(each.estimator(), uncertain.cost) for each in (minimax, classical))
    assert second == (
        "The minimax design has the lowest guarantee: for every curve in the sector, the smoothed "
        f"error is at most {robust.certified:.4f} rad². The classical design guarantees "
        f"{plain.certified:.4f} rad². Without uncertainty the error of the lowest is "
        f"{robust.nominal / plain.nominal - 1.0:.1%} higher."
    )
    least = rs.statistical_linearisation(uncertain.parameters, classical.estimator()).smoothed
    assert third == (f"With the sine, the classical design has the lowest error: {least:.4f} rad².")


def judged_as(found, **certified):
    """The snapshot with other certified errors."""
    changed = {
        name: replace(each, judged=replace(each.judged, certified=certified.get(name, 9.0)))
        for name, each in found.found.items()
    }
    return replace(found, found=changed)


def test_within_a_per_cent_the_classical_design_is_as_good():
    found = take_snapshot(PAPER)
    tie = verdict(judged_as(found, minimax=0.1, classical=0.1009))[1]
    assert tie == (
        "The classical design has the lowest guarantee, within 1%: for every curve in the sector, "
        "the smoothed error is at most 0.1009 rad²."
    )
    assert verdict(judged_as(found, minimax=0.1, classical=0.1011))[1].startswith("The minimax")
    assert "lowest guarantee: " in verdict(judged_as(found, classical=0.1))[1]


def test_designs_are_named_in_english():
    found = take_snapshot(PAPER)
    papers = verdict(judged_as(found, **{"paper's V": 0.1}))[1]
    assert papers.startswith("The design by the paper's V has the lowest guarantee: ")
    infinite = dict.fromkeys(found.found, math.inf)
    assert "No design has a guarantee" in verdict(judged_as(found, **infinite))[1]
    assert (
        "The classical design has none."
        in verdict(judged_as(found, **infinite | {"minimax": 0.1}))[1]
    )


def test_where_the_sine_leaves_its_sector_the_verdict_says_how_often():
    found = take_snapshot(Settings(kappa=2.5e5, noise=5.0, gamma=0.2))
    variance = found.own.with_sine.filtered
    reach = found.settings.parameters.sector_range()
    errors = np.random.default_rng(0).normal(0.0, variance**0.5, 1_000_000)
    share = float(re.search(r"leaves the sector ([\d.]+)% of the time", verdict(found)[1])[1])
    assert share == pytest.approx(100.0 * np.mean(np.abs(errors) > reach), rel=0.02)
    assert "leaves the sector" not in verdict(take_snapshot(PAPER))[1]


@pytest.mark.parametrize("order", [1, 5])
def test_curves_over_the_delay_meet_the_filter_and_the_design(order):
    found = take_snapshot(Settings(design="classical", delay=3e-6, order=order))
    optimum, modelled = over_delays(PAPER.parameters, order)
    filtering = rs.baselines.optimal_fixed_lag_error(PAPER.parameters.uncertain_system(), 0.0)
    assert optimum[0] == found.kalman == pytest.approx(filtering.item())
    assert modelled[0] == pytest.approx(filtering.item())
    assert (np.diff(optimum) < 0.0).all()
    assert (modelled >= optimum * (1.0 - 1e-9)).all()
    (here,) = np.flatnonzero(np.isclose(DELAYS, 3e-6))
    assert modelled[here] == pytest.approx(found.own.judged.nominal, rel=1e-9)


@pytest.mark.parametrize("name", ["paper", "other light", "paper's V"])
def test_the_errors_with_the_sine_are_those_of_its_stationary_density(name):
    for found in take_snapshot(DESIGNED[name]).found.values():
        exact = rs.stationary_errors(DESIGNED[name].parameters, found.estimator)
        assert found.with_sine.filtered == pytest.approx(exact.filtered, rel=0.01)
        assert found.with_sine.smoothed == pytest.approx(exact.smoothed, rel=0.01)


def test_the_path_is_one_of_the_loop():
    """Averaged over time, its errors are those of the simulation, as far as chance lets them."""
    phase, filtered, smoothed = sample_path(take_snapshot(PAPER).own.estimator)
    steps = np.arange(len(phase))
    then = steps - PAPER.delay / STEP
    delayed = np.interp(then, steps, phase)
    late = np.mean((delayed - smoothed)[then > 0.0] ** 2)
    assert 0.03 < late < np.mean((phase - filtered) ** 2) < 0.2
    moved = sample_path(replace(PAPER, delay=3.2e-6, order=3).estimator())
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


@settings(max_examples=8)
@given(all_settings)
def test_every_setting_gives_panels_or_a_sentence(chosen):
    found = take_snapshot(chosen)
    if not isinstance(found, str):
        assert all(pixels(image).shape[:2] == (420, 560) for image in images(found, panels.PANELS))
    assert all(sentence.endswith(".") for sentence in verdict(found))


def test_too_long_a_delay_is_said_to_be_worse_than_none():
    found = take_snapshot(Settings(delay=15e-6, order=1))
    assert found.own.with_sine.smoothed > found.own.with_sine.filtered
    assert "raises the mean square error" in verdict(found)[0]


# --- the figures ----------------------------------------------------------------------------------


@pytest.mark.parametrize("title", panels.PANELS)
@pytest.mark.parametrize("chosen", [PAPER, Settings(gamma=0.8, design="by hand")], ids=["", "wide"])
def test_nothing_is_in_the_way_of_the_words_of_a_figure(title, chosen):
    panel = panels.Panel(title)
    panel.pixels(take_snapshot(chosen))
    with mpl.rc_context():
        use_style()
        assert looks.flaws(panel.figure) == []


@pytest.mark.parametrize("title", panels.PANELS)
def test_a_figure_depends_on_the_settings_alone(title):
    kept, other = panels.Panel(title), replace(PAPER, gamma=0.6, kappa=1e5, design="paper's V")
    for chosen in (PAPER, other, replace(other, delay=5e-6), PAPER):
        found = take_snapshot(chosen)
        with mpl.rc_context({"axes.prop_cycle": mpl.cycler(color=["k"]), "font.size": 20}):
            assert panels.png(kept.pixels(found)) == images(found, [title])[0]
    assert images(take_snapshot(other), [title]) != images(take_snapshot(PAPER), [title])


def test_an_error_beyond_the_axis_is_a_number_and_the_others_are_drawn():
    found = take_snapshot(PAPER)
    judged = replace(found.own.judged, certified=np.inf)
    changed = found.found | {PAPER.design: replace(found.own, judged=judged)}
    panel = panels.Panel(panels.JUDGED)
    panel.pixels(replace(found, found=changed))
    (axes,) = panel.figure.axes
    assert [text.get_text() for text in axes.texts] == ["inf →"]
    (drawn,) = (line for line in axes.lines if line.get_marker() == "|")
    assert np.isfinite(drawn.get_xdata()).sum() == 3


def test_a_path_that_moves_far_stays_in_its_axes():
    found = take_snapshot(Settings(kappa=2.5e5, lam=1e3))
    panel = panels.Panel("a path and its estimates")
    panel.pixels(found)
    reach = np.abs(sample_path(found.own.estimator)).max()
    assert panel.figure.axes[0].get_ylim()[1] >= reach > 3.0


# --- controls, and what is drawn when -------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch):
    """The settings that were drawn, in order."""
    seen = []

    def take(chosen, complete=True):
        seen.append(chosen)
        return take_snapshot(chosen, complete)

    monkeypatch.setattr(explorer, "take_snapshot", take)
    return seen


def values(shown):
    """What the picture, the verdict and the code are."""
    shown.widget  # noqa: B018 - they are made with it
    pictures = tuple(shown._images[title].value for title in panels.OVERVIEW)
    return pictures, shown._verdict.value, shown._code.value


async def until(condition):
    """Wait for something."""
    async with asyncio.timeout(PATIENCE):
        while not condition():
            await asyncio.sleep(0.001)


def inside(widget, kind):
    """All widgets of a kind in a widget."""
    children = getattr(widget, "children", ())
    found = [each for child in children for each in inside(child, kind)]
    return [widget, *found] if isinstance(widget, kind) else found


def test_a_slider_changes_the_panels_and_reset_brings_them_back(drawn):
    async def use():
        shown = Explorer(replace(PAPER, delay=2e-6))
        first = values(shown)
        assert all(first)
        shown.inputs["delay"].value = 4.0
        assert shown.settings == replace(PAPER, delay=4e-6)
        await until(lambda: values(shown)[0] != first[0])
        for old, new in zip(first, values(shown), strict=True):
            assert old != new
        shown.inputs["gamma"].value = 0.5
        del drawn[:]
        buttons = inside(shown.widget, explorer.widgets.Button)
        (reset,) = [each for each in buttons if each.description == "Reset"]
        reset.click()
        await until(lambda: values(shown) == first)
        assert set(drawn) == {replace(PAPER, delay=2e-6)}  # it is one change

    asyncio.run(use())


def test_a_slider_can_be_typed_into_with_the_digits_of_its_step():
    async def use():
        shown = Explorer()
        values(shown)
        sliders = [shown.inputs[name] for name in SLIDERS]
        assert all(each.readout and not each.disabled for each in sliders)
        digits = [each.readout_format for each in sliders]
        assert digits == [".1f", ".0f", ".2f", ".1f", ".2f", *[".0f", ".2f"], *[".4f"] * 4]
        shown.inputs["gamma"].value = 0.39999999999999997  # of a browser
        assert shown.settings == PAPER
        shown.inputs["order"].value = 3
        assert shown.settings == replace(PAPER, order=3)

    asyncio.run(use())


def test_only_controls_that_matter_are_there():
    async def use():
        shown = Explorer()
        values(shown)
        for design in ("classical", "by hand", "minimax"):
            shown.inputs["design"].value = design
            hidden = "flex" if design == "by hand" else "none"
            await until(lambda hidden=hidden: shown._by_hand.layout.display == hidden)
        loop, own = shown.widget.children
        for control in (*shown.inputs.values(), shown._verdict, *shown._images.values()):
            kind = type(control)
            assert control in inside(loop, kind)
            assert control not in inside(own, kind)

    asyncio.run(use())


def test_without_a_design_the_reason_is_said_and_escaped():
    shown = Explorer(INFEASIBLE)
    assert "Assumption 3.2 (Riccati equation for X) fails" in values(shown)[1]
    assert shown._views.layout.visibility == "hidden"
    assert set(shown._repr_mimebundle_()) == {"text/plain"}
    refused = values(Explorer(replace(INFEASIBLE, lambda2=1.0)))[1]
    assert "M(lambda)^-1 &gt;= J J&#x27;" in refused


@pytest.mark.parametrize(
    ("change", "advice", "reason", "followed"),
    [
        ({"tau": 0.2e-6}, "Move τ up, or the noise factor down.", "Assumption 3.1", {"tau": 2e-6}),
        ({"tau": 0.2e-6}, "Move τ up, or the noise factor down.", "Assumption 3.1", {"noise": 0.1}),
        ({"lambda1": 0.0}, "Move λ₁ and λ₂ above 0.", "M(lambda) &gt; 0", {"lambda1": 0.1}),
        ({"lambda2": 1.0}, "Move one of λ₁ to λ₄ down.", "The multiplier", {"lambda2": 0.5}),
        (
            AS_PRINTED,
            "Move λ₃ and λ₄ down, or λ₁ up.",
            "Assumption 3.2",
            {"lambda3": 0.0, "lambda4": 0.0, "tau": 2e-6},
        ),
        (
            {"noise": 5.0, "kappa": 2.5e5, "tau": 1e-5, "lambda1": 0.01},
            "Move the noise factor or κ down.",
            "the loop is not in lock",
            {"noise": 1.0, "kappa": 4e4},
        ),
    ],
)
def test_a_design_by_hand_that_is_refused_comes_with_advice_that_helps(
    change, advice, reason, followed
):
    refused = replace(PAPER, design="by hand", **change)
    assert f"There is no design. {advice} The reason: {reason}" in values(Explorer(refused))[1]
    assert isinstance(take_snapshot(replace(refused, **followed), complete=False), Snapshot)


def test_a_design_by_hand_starts_at_the_best_tau_of_the_settings():
    async def use():
        shown = Explorer()
        values(shown)
        shown.inputs["noise"].value = 5.0
        shown.inputs["design"].value = "by hand"
        await until(lambda: "tau=" in values(shown)[2])
        noisy = Settings(noise=5.0, design="by hand")
        assert shown.settings.tau == pytest.approx(noisy.best_tau(), abs=0.005e-6)
        assert shown._views.layout.visibility == "visible"
        await until(lambda: JUDGING not in values(shown)[1])

    asyncio.run(use())


def test_what_is_no_longer_true_is_dimmed_until_there_is_more():
    async def use():
        shown = Explorer()
        values(shown)
        assert "robsmooth-old" not in shown._shown._dom_classes
        shown.inputs["gamma"].value = 0.5
        assert "robsmooth-old" in shown._shown._dom_classes
        await until(lambda: "gamma=0.5" in values(shown)[2])
        assert "robsmooth-old" not in shown._shown._dom_classes

    asyncio.run(use())


def test_the_figures_for_theorists_are_drawn_when_they_are_looked_at():
    def theory(shown):
        return tuple(shown._images[title].value for title in panels.THEORY)

    async def use():
        shown = Explorer()
        values(shown)
        first = theory(shown)
        assert first == images(take_snapshot(PAPER), panels.THEORY)
        shown.inputs["delay"].value = 4.0
        await until(lambda: "delay=4e-06" in values(shown)[2])
        await until(lambda: JUDGING not in values(shown)[1])
        assert theory(shown) == first
        shown._views.selected_index = 1
        later = take_snapshot(replace(PAPER, delay=4e-6))
        assert theory(shown) == images(later, panels.THEORY)

    asyncio.run(use())


def test_of_many_events_the_newest_only_is_drawn(drawn):
    async def drag():
        shown = Explorer()
        values(shown)
        del drawn[:]
        for delay in np.linspace(4.0, 5.0, 11):
            shown.inputs["delay"].value = delay
        await until(lambda: drawn)

    asyncio.run(drag())
    assert drawn == [replace(PAPER, delay=5e-6)]


def test_the_certificate_keeps_nothing_else_waiting(monkeypatch):
    may_go_on = threading.Event()

    def take(chosen, complete=True):
        assert not complete or chosen == PAPER or may_go_on.wait(PATIENCE)
        return take_snapshot(chosen, complete)

    monkeypatch.setattr(explorer, "take_snapshot", take)

    async def use():
        shown = Explorer()
        before = values(shown)
        shown.inputs["design"].value = "classical"
        await until(lambda: values(shown)[0] != before[0])
        drawn = values(shown)
        assert JUDGING in drawn[1]
        may_go_on.set()
        await until(lambda: JUDGING not in values(shown)[1])
        assert values(shown)[0] != drawn[0]

    asyncio.run(use())


def test_a_certificate_that_is_late_is_not_shown(monkeypatch):
    asked, may_go_on = threading.Event(), threading.Event()

    def take(chosen, complete=True):
        if complete and chosen.delay == 4e-6:
            asked.set()
            assert may_go_on.wait(PATIENCE)
        return take_snapshot(chosen, complete)

    monkeypatch.setattr(explorer, "take_snapshot", take)

    async def use():
        shown = Explorer()
        values(shown)
        shown.inputs["delay"].value = 4.0
        await until(asked.is_set)
        shown.inputs["delay"].value = 5.0
        may_go_on.set()
        await until(lambda: "delay=5e-06" in values(shown)[2])
        await until(lambda: JUDGING not in values(shown)[1])
        expected = take_snapshot(replace(PAPER, delay=5e-6))
        assert values(shown)[0] == images(expected)

    asyncio.run(use())


def test_an_explorer_shows_itself_as_an_image_where_nobody_is():
    shown = Explorer()
    bundle = shown._repr_mimebundle_()
    assert set(bundle) == {"image/png", "text/plain"}
    assert pixels(base64.b64decode(bundle["image/png"])).shape[:2] == (840, 1120)
    assert bundle["text/plain"] == " ".join(verdict(take_snapshot(PAPER)))
    assert not shown.inputs


@pytest.mark.parametrize("answers", [True, False])
def test_an_explorer_shows_its_sliders_to_who_can_move_them(monkeypatch, answers):
    request = {"content": {"allow_stdin": answers}}
    kernel = SimpleNamespace(get_parent=lambda channel: request if channel == "shell" else {})
    monkeypatch.setattr(explorer, "get_ipython", lambda: SimpleNamespace(kernel=kernel))
    bundle = Explorer()._repr_mimebundle_()
    assert ("application/vnd.jupyter.widget-view+json" in bundle) == answers
    assert "image/png" in bundle
