"""What is wrong with how a figure looks, in sentences."""

import itertools
import re
from unittest import mock

import matplotlib as mpl
import numpy as np
from matplotlib.container import Container
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.mathtext import MathTextParser
from matplotlib.text import Text
from matplotlib.transforms import Bbox

SMALLEST = 5.5  # points, also of a subscript
DIMENSIONLESS = {
    r"slope $\Delta_2$",
    r"measurement uncertainty $\Delta_2$",
    r"uncertainty $\Delta_2$",
    "detector's signal",
    r"$\sin e = \beta e + f(e)$",
    r"$|H(i\omega) - e^{-i\omega\delta}|$",
    "measurement noise / signal",
    "certified error, classical / minimax",
    "shot noise / the paper's",
    "smoothed / filtered error",
}
LIGHTNESS, DIFFERENCE = 15.0, 20.0  # least differences of colours, in CIELAB
# How those who lack one kind of cone see linear RGB: Machado, Oliveira and Fernandes (2009).
SIGHTS = {
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
}
TO_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
) / [[0.9505], [1.0], [1.089]]


def flaws(figure):
    """Everything that is found, in sentences."""
    texts = drawn_texts(figure)
    return [
        *_small(texts),
        *_outside(figure, texts),
        *_overlapping(texts),
        *_crossed(figure, texts),
        *_unlabelled(figure),
        *_alike(figure),
    ]


def drawn_texts(figure):
    """Draw the figure; return its texts, each with its box in pixels."""
    drawn, draw = [], Text.draw

    def note(self, renderer):
        draw(self, renderer)
        if self.get_visible() and self.get_text().strip():
            drawn.append((self, self.get_window_extent(renderer)))

    with mock.patch.object(Text, "draw", note):
        figure.canvas.draw()
    return drawn


def _small(texts):
    for text, _ in texts:
        size, words = text.get_fontsize(), text.get_text()
        for line in words.splitlines() if "$" in words else ():
            glyphs = MathTextParser("path").parse(line, 72, FontProperties(size=size)).glyphs
            size = min(size, *(glyph[1] for glyph in glyphs))
        if size < SMALLEST:
            yield f"{words!r} has letters of {size:.1f} points"


def _outside(figure, texts):
    for text, box in texts:
        inside = figure.bbox.padded(1.0)
        if not (inside.contains(*box.min) and inside.contains(*box.max)):
            yield f"{text.get_text()!r} leaves the figure"


def _overlapping(texts):
    for (one, box), (other, another) in itertools.combinations(texts, 2):
        common = Bbox.intersection(box, another)
        if common is not None and min(common.width, common.height) > 1.0:
            yield f"{one.get_text()!r} and {other.get_text()!r} overlap"


def _crossed(figure, texts):
    boxes = [(repr(text.get_text()), box) for text, box in texts]
    boxes += [
        ("a legend", axes.get_legend().get_window_extent())
        for axes in figure.axes
        if axes.get_legend()
    ]
    for axes in figure.axes:
        for line in axes.lines:
            if not line.get_visible() or line.get_linestyle() == "None":
                continue
            path = line.get_path().transformed(line.get_transform())
            path = path.cleaned(remove_nans=True, clip=axes.bbox.extents)
            for words, box in boxes:
                if path.intersects_bbox(box.padded(-1.0), filled=False):
                    yield f"the line {line.get_label()!r} crosses {words}"


def _unlabelled(figure):
    for axes in figure.axes:
        for axis, shared in (
            (axes.xaxis, figure.get_supxlabel()),
            (axes.yaxis, figure.get_supylabel()),
        ):
            ticks = [tick.get_text() for tick in axis.get_ticklabels() if tick.get_visible()]
            numbers = [tick for tick in ticks if re.fullmatch(r"([^A-Za-z]|\\mathdefault)+", tick)]
            if not (axes.axison and numbers):
                continue
            label = shared or axis.label.get_text()
            if not (re.search(r"\(.+\)$", label) or label in DIMENSIONLESS):
                yield f"an axis has numbers and no unit: {label!r}"


def _alike(figure):
    groups = [axes.get_legend_handles_labels() for axes in figure.axes]
    for legend in (*figure.legends, *(axes.get_legend() for axes in figure.axes)):
        if legend:
            groups.append((legend.legend_handles, [text.get_text() for text in legend.texts]))
    for handles, labels in groups:
        drawn = [handle[0] if isinstance(handle, Container) else handle for handle in handles]
        lines = [
            (label, line)
            for label, line in zip(labels, drawn, strict=True)
            if isinstance(line, Line2D)
        ]
        for (one, line), (other, another) in itertools.combinations(lines, 2):
            if _pattern(line) == _pattern(another):
                for sight in seen_alike(line.get_color(), another.get_color()):
                    yield f"{one!r} and {other!r} look alike: {sight}"


def _pattern(line):
    # get_linestyle says "--" of all dashes that have no name
    dashes = line.get_linestyle() == "None" or line._unscaled_dash_pattern
    hollow = line.get_markerfacecolor() == "none"
    return dashes, line.get_marker(), hollow


def seen_alike(one, other):
    """The ways to look at two colours in which they are hard to tell apart."""
    pair = [_linear(colour) for colour in (one, other)]
    first, second = (_cielab(colour)[0] for colour in pair)
    if abs(first - second) < LIGHTNESS:
        yield "in grey"
    for name, sight in SIGHTS.items():
        first, second = (_cielab(np.array(sight) @ colour) for colour in pair)
        if np.linalg.norm(first - second) < DIFFERENCE:
            yield f"with {name}"


def _linear(colour):
    values = np.array(mpl.colors.to_rgb(colour))
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _cielab(linear):
    xyz = TO_XYZ @ np.clip(linear, 0.0, 1.0)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])
