"""The figures: what they plot, and how they are saved."""

import itertools
import re
from dataclasses import replace
from functools import cache

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.text import Text

from robsmooth import homodyne, lag_sweep, sample_paths
from robsmooth.analysis.covariance import DeltaSweep
from robsmooth.estimators import baselines
from robsmooth.homodyne.montecarlo import MeanSquare
from robsmooth.homodyne.study import QUANTITIES, Study
from robsmooth.paper import figures
from robsmooth.paper.figures import diagrams
from robsmooth.paper.figures.plots import FORMATS, shade
from tests.helpers import looks

SLOPES = np.linspace(-1.0, 0.0, 11)
CURVES = {"NGCF": 0.1 - 0.05 * SLOPES, "robust smoother": 0.06 - 0.04 * SLOPES}


CASES = ["as written", "with a stronger noise of the detector"]
RESULTS = {
    "smoother": [MeanSquare(0.05, 0.001), MeanSquare(0.06, 0.001)],
    "NGCF": [MeanSquare(0.09, 0.002), MeanSquare(0.1, 0.002)],
}

LAGS, NOISES = (0.3e-6, 3e-6, 3.1e-6, 30e-6), (0.1, 1.0, 6.0)
SHAPE = (1, len(NOISES), 2, len(LAGS))
ERRORS = dict.fromkeys(QUANTITIES, np.full(SHAPE, 0.04)) | {
    "filtered": np.full(SHAPE, 0.088),
    "smoothed": np.linspace(0.045, 0.1, np.prod(SHAPE)).reshape(SHAPE),
}
STUDY = Study((0.4,), NOISES, (1, 2), LAGS, ERRORS, {})
SYSTEM = homodyne.PAPER.uncertain_system()
CLASSICAL = baselines.fixed_lag_smoother(SYSTEM, 3.1e-6, 2, copies=True)
JUDGED = {
    "classical": {
        "nominal": 0.05,
        "worst constant": 0.08,
        "certified": 0.09,
        "with the sine": 0.06,
    },
    "constant minimax": {"nominal": 0.05, "worst constant": 0.07, "certified": 0.2},
}


@cache
def paths():
    return sample_paths(CLASSICAL, runs=1, duration=3.1e-5, step=3.1e-7)


@cache
def lags_swept():
    return lag_sweep(SYSTEM, [1e-6, 2e-6, 4e-6], [1, 2, 3])


def swept(curves):
    figure, axes = plt.subplots()
    for name, values in curves.items():
        DeltaSweep(SLOPES, values[:, None, None], "smoothed").plot(axes, name)
    axes.legend()
    return figure


def mapped(ratio):
    """What smoothing saves over delay and noise, for the highest order."""
    figure, axes = plt.subplots()
    saved, lags, noises = 100 * (1 - ratio[0, :, -1]), np.array(LAGS), np.array(NOISES)
    shade(axes, lags, noises, saved, np.arange(0, 61, 10), missing="no design")
    figures.plots.hatch(axes, lags, noises, -saved, "no gain", hatch="-----")
    axes.set(xscale="log", yscale="log", xlabel="delay (s)", ylabel="shot noise / the paper's")
    return figure


MAKERS = {
    "fig1": diagrams.smoother_loop,
    "fig2": diagrams.homodyne_loop,
    "fig3": lambda: figures.plots.sector(homodyne.PAPER, 0.088),
    "fig4": lambda: swept(CURVES),
    "monte_carlo": lambda: figures.plots.mean_squares(
        CASES, RESULTS, {"smoother": 0.06, "NGCF": 0.1}
    ),
    "map": lambda: mapped(ERRORS["smoothed"] / ERRORS["filtered"]),
    "candidates": lambda: figures.plots.candidates(
        JUDGED, {"optimum": 0.045}, "rad$^2$", (0.04, 0.1)
    ),
    "sample_path": lambda: paths().plot().figure,
    "lag_sweep": lambda: lags_swept().plot().figure,
    "worst_lag_sweep": lambda: lags_swept().plot(error="worst").figure,
    "study": lambda: STUDY.plot().figure,
}


@pytest.fixture(autouse=True)
def style():
    with mpl.rc_context():
        mpl.use("Agg")
        figures.use_style()
        yield
    plt.close("all")


@pytest.fixture(scope="module", params=MAKERS)
def saved(request, tmp_path_factory):
    """Each figure, drawn and saved twice: the files of both, by suffix."""
    folders = tmp_path_factory.mktemp("one"), tmp_path_factory.mktemp("two")
    with mpl.rc_context():
        mpl.use("Agg")
        figures.use_style()
        for folder in folders:
            figures.save_figure(MAKERS[request.param](), folder, request.param)
    plt.close("all")
    return tuple(
        {suffix: (folder / f"{request.param}.{suffix}").read_bytes() for suffix in FORMATS}
        for folder in folders
    )


def test_a_figure_drawn_twice_is_the_same_bytes(saved):
    first, second = saved
    assert first == second
    assert min(map(len, first.values())) > 1000


def test_text_stays_text_and_a_pdf_has_its_fonts(saved):
    pdf, svg = saved[0]["pdf"], saved[0]["svg"]
    assert b"/Type3" not in pdf
    assert pdf.count(b"/FontFile2") == pdf.count(b"/Type /FontDescriptor") > 0  # TrueType
    assert b"<text" in svg
    assert b"DejaVuSans-" not in svg  # the outlines of letters


def test_files_hold_no_date_and_no_release(tmp_path):
    figures.save_figure(MAKERS["fig4"](), tmp_path, "fig4")
    pdf, svg, png = ((tmp_path / f"fig4.{s}").read_bytes() for s in FORMATS)
    for content in (pdf, svg, png):
        assert not re.search(rb"20\d\d-\d\d-\d\d|CreationDate|dc:date", content)
        assert mpl.__version__.encode() not in content


@pytest.mark.parametrize("name", MAKERS)
def test_a_figure_fits_a_column_and_can_be_read_there(name):
    figure = MAKERS[name]()
    assert figure.get_figwidth() <= 3.4
    assert looks.flaws(figure) == []


def test_what_cannot_be_read_is_found():
    figure, axes = plt.subplots(layout="none")
    axes.plot([0, 1], [0, 1], color="#d55e00", linestyle="-", label="red")
    axes.plot([0, 1], [1, 0], color="#809000", linestyle="-", label="green")
    axes.set_yticks([])
    axes.legend(loc="center")
    axes.text(0.2, 0.9, "under")
    axes.text(0.2, 0.9, "$a_b$", fontsize=7)
    axes.text(0.25, 0.73, "crossed")
    axes.text(0.9, 0.5, "far away from here")
    assert sorted(set(looks.flaws(figure))) == [
        "'$a_b$' has letters of 4.9 points",
        "'far away from here' leaves the figure",
        "'red' and 'green' look alike: in grey",
        "'red' and 'green' look alike: with deuteranopia",
        "'red' and 'green' look alike: with protanopia",
        "'under' and '$a_b$' overlap",
        "an axis has numbers and no unit: ''",
        "the line 'green' crosses 'crossed'",
        "the line 'green' crosses 'green'",
        "the line 'green' crosses a legend",
        "the line 'red' crosses 'red'",
        "the line 'red' crosses a legend",
    ]


@pytest.mark.parametrize("name", MAKERS)
def test_nothing_leaves_the_figure(name):
    figure = MAKERS[name]()
    figure.canvas.draw()
    drawn = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert drawn.x0 > -0.02 and drawn.y0 > -0.02
    assert drawn.x1 < width + 0.02 and drawn.y1 < height + 0.02


def test_the_sweep_plots_what_it_is_given():
    (axes,) = MAKERS["fig4"]().axes
    lines = {line.get_label(): line for line in axes.lines}
    for label, values in CURVES.items():
        assert np.array_equal(lines[label].get_xdata(), SLOPES)
        assert np.array_equal(lines[label].get_ydata(), values)
    assert lines["NGCF"].get_linestyle() == "-"  # solid and dashed, as the paper says
    assert lines["robust smoother"].get_linestyle() == "--"
    assert "squared unit" in axes.get_ylabel() and r"\Delta_2" in axes.get_xlabel()


def test_an_error_beyond_the_limits_is_a_number_at_the_edge():
    texts = [text.get_text() for text in MAKERS["candidates"]().findobj(Text)]
    assert [text for text in texts if "→" in text] == ["0.2 →"]


def test_the_smoothed_path_is_drawn_at_the_time_that_it_is_for():
    (axes,) = MAKERS["sample_path"]().axes
    lines = {line.get_label(): line for line in axes.lines}
    shift = lines["true"].get_xdata() - lines["smoothed"].get_xdata()
    assert np.allclose(shift, 3.1e-6)


def hatched(axes, label):
    """A function that tells whether a point of the axes is hatched with a label, as it is drawn."""
    for patch in axes.patches:
        seen = patch.get_label() == label
        patch.set(hatch=None, facecolor="#00ff00" if seen else "#ff0000", antialiased=False)
    for line in axes.lines:
        line.set_visible(False)
    axes.figure.canvas.draw()
    pixels = np.asarray(axes.figure.canvas.buffer_rgba())

    def tell(x, y):
        place = (axes.transData - axes.transAxes).transform((x, y))
        place = np.clip(place, 0.03, 0.97)  # on the edge is a line
        column, row = axes.transAxes.transform(place).astype(int)
        return tuple(pixels[len(pixels) - 1 - row, column, :3]) == (0, 255, 0)

    return tell


@pytest.mark.parametrize("seed", range(4))
def test_a_map_is_hatched_at_the_points_of_its_grid_without_a_value_and_no_others(seed):
    rng = np.random.default_rng(seed)
    x, y = np.geomspace(1.0, 10.0, 7), np.linspace(1.0, 2.0, 5)
    values = np.where(rng.random((5, 7)) < 0.3, np.nan, rng.uniform(0.0, 9.0, (5, 7)))
    _, axes = plt.subplots()
    axes.set(xscale="log")
    shade(axes, x, y, values, [0.0, 1.0, 4.0], missing="nothing")
    tell = hatched(axes, "nothing")
    found = [[tell(a, b) for a in x] for b in y]
    assert np.array_equal(found, np.isnan(values))
    assert axes.get_xlim() == (1.0, 10.0) and axes.get_ylim() == (1.0, 2.0)
    assert axes.patch.get_hatch() is None


def test_a_map_with_all_its_values_has_no_hatch():
    _, axes = plt.subplots()
    shade(axes, np.arange(3.0), np.arange(2.0), np.ones((2, 3)), [0.0, 2.0], missing="nothing")
    assert not axes.patches


def test_no_gain_and_no_design_are_told_apart():
    ratio = ERRORS["smoothed"] / ERRORS["filtered"]
    ratio[:, 0] = np.nan  # at the least noise there is no design
    (axes, *_) = mapped(ratio).axes
    ratio = ratio[0, :, -1]
    no_design = hatched(axes, "no design")
    points = [(lag, noise) for noise in NOISES for lag in LAGS]
    assert [no_design(*point) for point in points] == list(np.isnan(ratio).ravel())
    no_gain = hatched(axes, "no gain")
    assert [no_gain(*point) for point in points] == list((ratio > 1).ravel())
    assert (ratio > 1).any()


def test_optimum_of_the_linear_loop_is_relative_to_the_filter_of_the_linear_loop():
    def drawn(study):
        axes = study.plot(plt.subplots()[1], 0.4, NOISES[1])
        (line,) = (line for line in axes.lines if "linear loop" in line.get_label())
        return line.get_ydata()

    optimal = np.linspace(0.08, 0.04, np.prod(SHAPE)).reshape(SHAPE)
    errors = ERRORS | {"optimal": optimal, "optimal_filtered": np.full(SHAPE, 0.08)}
    study = replace(STUDY, quantities=errors)
    assert np.array_equal(drawn(study), optimal[0, 1, -1] / 0.08)
    noisier = replace(STUDY, quantities=errors | {"filtered": np.full(SHAPE, 0.2)})
    assert np.array_equal(drawn(noisier), drawn(study))


def test_curves_differ_by_more_than_their_colour():
    cycle = list(mpl.rcParams["axes.prop_cycle"])
    assert len({str(look["linestyle"]) for look in cycle}) == len(cycle) >= 5
    first = [look["color"] for look in cycle[:3]]
    for one, other in itertools.combinations(first, 2):
        assert list(looks.seen_alike(one, other)) == []


def test_what_is_in_several_figures_looks_the_same_in_all():
    def line(figure, label):
        for handle, name in zip(*figure.axes[-1].get_legend_handles_labels(), strict=True):
            if name == label:
                return getattr(handle, "lines", [handle])[0]
        raise AssertionError(label)

    for name in ("NGCF", "smoother"):
        compared = swept({"other": SLOPES, name: SLOPES})
        simulated = MAKERS["monte_carlo"]()
        assert line(compared, name).get_color() == line(simulated, name).get_color()


def test_names_without_a_look_of_their_own_get_what_is_left():
    names = ["mine", "smoothed", "yours", "filtered"]
    found = figures.styles(names)
    assert found[1::2] == figures.styles(["smoothed", "filtered"])
    for key in ("color", "linestyle"):
        assert len({str(look[key]) for look in found}) == len(names)
    many = figures.styles(range(100, 120))
    assert len(many) == 20


def test_the_sector_figure_marks_where_the_sine_leaves_the_sector():
    top, _ = MAKERS["fig3"]().axes
    marks = [line.get_xdata()[0] for line in top.lines if np.ptp(line.get_xdata()) == 0]
    reach = max(marks)
    assert np.sin(reach) == pytest.approx(homodyne.PAPER.lower_slope * reach, rel=1e-9)


def test_a_failed_save_leaves_the_old_figure(tmp_path, monkeypatch):
    path = tmp_path / "fig4.pdf"
    path.write_bytes(b"yesterday")
    figure = MAKERS["fig4"]()

    def fail(target, **_):
        target.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(figure, "savefig", fail)
    with pytest.raises(OSError, match="disk full"):
        figures.save_figure(figure, tmp_path, "fig4")
    assert path.read_bytes() == b"yesterday"
    assert [entry.name for entry in tmp_path.iterdir()] == ["fig4.pdf"]
