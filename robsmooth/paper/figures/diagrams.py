"""The block diagrams of Fig. 1 and Fig. 2, drawn with schemdraw."""

from collections.abc import Callable
from functools import wraps

import matplotlib.pyplot as plt
import schemdraw
from matplotlib.figure import Figure
from schemdraw import dsp, elements
from schemdraw.flow import Arrow, Box, Line, Wire
from schemdraw.segments import Segment, SegmentArc

_WIDTH = 3.4  # inches
_MARGIN = 0.4  # schemdraw's units, because its box of a text is a little too small
_LEFT = {"loc": "mid", "halign": "right", "ofst": (-0.15, 0)}  # a text left of a wire
_RIGHT = {"loc": "mid", "halign": "left", "ofst": (0.15, 0)}
_BEAM = {"color": "C1", "lw": 1.8}  # light; signals are thin


def _diagram(draw: Callable[[], None]) -> Callable[[], Figure]:
    """Make a function that draws return its figure, some ten units wide."""

    @wraps(draw)
    def diagram() -> Figure:
        with schemdraw.Drawing(show=False) as drawing:
            drawing.config(fontsize=8, lw=0.8, inches_per_unit=0.34)
            draw()
        box = drawing.get_bbox()
        left, right = box.xmin - _MARGIN, box.xmax + _MARGIN
        bottom, top = box.ymin - _MARGIN, box.ymax + _MARGIN
        size = (_WIDTH, _WIDTH * (top - bottom) / (right - left))
        figure, axes = plt.subplots(figsize=size, layout="none")
        figure.subplots_adjust(0, 0, 1, 1)
        drawing.draw(canvas=axes, show=False)
        for text in axes.texts:
            text.set_linespacing(1.3)  # room for hats and tildes
        axes.set(xlim=(left, right), ylim=(bottom, top))
        axes.axis("off")
        return figure

    return diagram


@_diagram
def smoother_loop() -> None:
    """Draw Fig. 1: the uncertain nonlinear system, its delay model, and the nonlinear smoother."""
    system = Box(w=2.7, h=2.4).label("uncertain\nnonlinear\nsystem")
    Arrow(arrow="<-").at(system.W).left(1.2).label("$W$")
    delta = Box(w=2.7, h=1.2).label(r"$\Delta,\ \ \psi_i(\cdot)$").anchor("S").at(system.N, dy=0.9)
    Wire("c", k=0.7, arrow="->").at(system.ENE).to(delta.E).label(r"$\zeta,\ \nu$", **_RIGHT)
    Wire("c", k=-0.7, arrow="->").at(delta.W).to(system.WNW).label(r"$\xi,\ \mu$", **_LEFT)

    Arrow().at(system.E).right(2.1).label("$w$")
    delay = Box(w=2.8, h=1.2).anchor("W").linestyle("--").label("delay model")
    Arrow().at(delay.E).right(1.6).label("$w_a$")

    linear = Box(w=3.4, h=1.8).anchor("N").at(delay.S, dx=-1.0, dy=-1.4)
    linear.label("linear estimator\n" + r"$A_c,\ \tilde B_c,\ \tilde C_c$")
    measured = Wire("|-", arrow="->").at(system.S).to(linear.WNW)
    measured.label("$y$", "mid", valign="bottom", ofst=(-0.5, 0.1))
    Arrow().at(linear.ENE).right(2.6).label(r"$\hat w,\ \hat w_a$", ofst=(0.65, 0.1))
    copies = Box(w=3.4, h=1.2).label(r"copies $\psi_i(\cdot)$").anchor("N").at(linear.S, dy=-0.8)
    inner = Wire("c", k=0.6, arrow="->").at(linear.ESE).to(copies.E).label(r"$\tilde\nu$", **_RIGHT)
    outer = Wire("c", k=-0.6, arrow="->").at(copies.W).to(linear.WSW).label(r"$\tilde\mu$", **_LEFT)
    parts = [linear, copies, inner, outer]
    whole = elements.EncircleBox(parts, padx=0.6, pady=0.3, includelabels=False)
    whole.linestyle(":").label("nonlinear\nsmoother", "W", halign="right", ofst=(-0.2, -1))


@_diagram
def homodyne_loop() -> None:
    """Draw Fig. 2: the adaptive homodyne loop with the robust nonlinear filter and smoother."""
    laser = Box(w=1.4, h=0.9).label("laser")
    Line(**_BEAM).at(laser.E).right(0.5)
    split = _beam_splitter().flip()  # its N is below
    Line(**_BEAM).at(split.E).right(0.8).label(r"$\alpha$", color="k")
    modulator = Box(w=2.3, h=1.2).anchor("W").label("phase\nmodulator")
    Arrow(arrow="<-").at(modulator.N).up(0.9).label(r"$\phi(t)$", "right")
    Line(**_BEAM).at(modulator.E).right(1.3).label(r"$\alpha e^{i\phi}$", color="k")
    mixed = _beam_splitter()

    oscillator = Box(w=3.2, h=1.4).anchor("N").at(modulator.S, dy=-0.7)
    oscillator.label("local oscillator\n" + r"$\Phi = \hat\phi + \pi/2$")
    Wire("|-", **_BEAM).at(split.N).to(oscillator.W)
    Wire("-|", **_BEAM).at(oscillator.E).to(mixed.S)
    for corner, angle in (((split.N.x, oscillator.W.y), -45), ((mixed.S.x, oscillator.E.y), 45)):
        mirror = elements.Element().at(corner).theta(angle)
        mirror.segments.append(Segment([(-0.35, 0), (0.35, 0)], lw=1.5))

    Line(**_BEAM).at(mixed.E).right(0.5)
    right = _detector()
    Line(**_BEAM).at(mixed.N).up(0.5)
    upper = _detector().theta(90)
    Arrow().at(right.out).right(0.6)
    difference = dsp.Circle(radius=0.3).label("$-$")
    Wire("n", k=0.25, arrow="->").at(upper.out).to(difference.N)

    Arrow().at(difference.S).down(0.9).label("$I(t)$", "bottom")
    smoother = Box(w=2.2, h=1.8).anchor("N").label("robust\nfilter and\nsmoother")
    Arrow().at(smoother.SSE).down(1.2).label(r"$\hat\phi(t|t\!+\!\delta)$", "left")
    fed = Wire("n", k=-0.6, arrow="->").at(smoother.SSW).to(oscillator.S)
    fed.label(r"$\hat\phi(t|t)$", "mid", valign="bottom", ofst=(0, 0.1))


def _beam_splitter() -> elements.Element:
    cube = dsp.Square()
    cube.segments.append(Segment([(0, -0.5), (1, 0.5)]))
    return cube


def _detector() -> elements.Element:
    """Return a photodetector: light enters at its flat side, current leaves at its round side."""
    arc, detector = SegmentArc((0, 0), 0.8, 0.8, theta1=-90, theta2=90), elements.Element()
    detector.segments += [arc, Segment([(0, -0.4), (0, 0.4)])]
    detector.anchors["out"] = detector.elmparams["drop"] = (0.4, 0)
    return detector
