"""The block diagrams, Fig. 1 and Fig. 2, drawn with schemdraw."""

import matplotlib.pyplot as plt
import schemdraw
from matplotlib.figure import Figure
from schemdraw import dsp, elements, flow
from schemdraw.segments import Segment, SegmentArc

_WIDTH = 3.4  # inches
_MARGIN = 0.4  # of schemdraw's units: it takes a text to be a little smaller than it is
_BEAM = {"color": "C1", "lw": 1.8}  # light is thick, and what is electric or a number is thin


def smoother_loop() -> Figure:
    """Draw Fig. 1: the uncertain nonlinear system, its delay model, and the nonlinear smoother."""
    with _drawing() as drawing:
        system = flow.Box(w=2.7, h=2.4).label("uncertain\nnonlinear\nsystem")
        flow.Arrow(arrow="<-").at(system.W).left(1.2).label("$W$")
        uncertainty = flow.Box(w=2.7, h=1.2).anchor("S").at(system.N, dy=0.9)
        uncertainty.label(r"$\Delta,\ \ \psi_i(\cdot)$")
        given = flow.Wire("c", k=0.7, arrow="->").at(system.ENE).to(uncertainty.E)
        given.label(r"$\zeta,\ \nu$", "mid", halign="left", ofst=(0.15, 0))
        back = flow.Wire("c", k=-0.7, arrow="->").at(uncertainty.W).to(system.WNW)
        back.label(r"$\xi,\ \mu$", "mid", halign="right", ofst=(-0.15, 0))

        flow.Arrow().at(system.E).right(2.1).label("$w$")
        delay = flow.Box(w=2.8, h=1.2).anchor("W").linestyle("--").label("delay model")
        flow.Arrow().at(delay.E).right(1.6).label("$w_a$")

        estimator = flow.Box(w=3.4, h=1.8).anchor("N").at(delay.S, dx=-1.0, dy=-1.4)
        estimator.label("linear estimator\n" + r"$A_c,\ \tilde B_c,\ \tilde C_c$")
        measured = flow.Wire("|-", arrow="->").at(system.S).to(estimator.WNW)
        measured.label("$y$", "mid", valign="bottom", ofst=(-0.5, 0.1))
        flow.Arrow().at(estimator.ENE).right(2.6).label(r"$\hat w,\ \hat w_a$", ofst=(0.65, 0.1))
        copies = flow.Box(w=3.4, h=1.2).anchor("N").at(estimator.S, dy=-0.8)
        copies.label(r"copies $\psi_i(\cdot)$")
        inner = flow.Wire("c", k=0.6, arrow="->").at(estimator.ESE).to(copies.E)
        inner.label(r"$\tilde\nu$", "mid", halign="left", ofst=(0.15, 0))
        outer = flow.Wire("c", k=-0.6, arrow="->").at(copies.W).to(estimator.WSW)
        outer.label(r"$\tilde\mu$", "mid", halign="right", ofst=(-0.15, 0))
        parts = [estimator, copies, inner, outer]
        whole = elements.EncircleBox(parts, padx=0.6, pady=0.3, includelabels=False)
        whole.linestyle(":").label("nonlinear\nsmoother", "W", halign="right", ofst=(-0.2, -1))
    return _figure(drawing)


def homodyne_loop() -> Figure:
    """Draw Fig. 2: the adaptive homodyne loop with the robust nonlinear filter and smoother."""
    with _drawing() as drawing:
        laser = flow.Box(w=1.4, h=0.9).label("laser")
        flow.Line(**_BEAM).at(laser.E).right(0.5)
        split = _BeamSplitter().flip()  # its N is below
        flow.Line(**_BEAM).at(split.E).right(0.8).label(r"$\alpha$", color="k")
        modulator = flow.Box(w=2.3, h=1.2).anchor("W").label("phase\nmodulator")
        flow.Arrow(arrow="<-").at(modulator.N).up(0.9).label(r"$\phi(t)$", "right")
        flow.Line(**_BEAM).at(modulator.E).right(1.3).label(r"$\alpha e^{i\phi}$", color="k")
        mixed = _BeamSplitter()

        oscillator = flow.Box(w=3.2, h=1.4).anchor("N").at(modulator.S, dy=-0.7)
        oscillator.label("local oscillator\n" + r"$\Phi = \hat\phi + \pi/2$")
        flow.Wire("|-", **_BEAM).at(split.N).to(oscillator.W)
        flow.Wire("-|", **_BEAM).at(oscillator.E).to(mixed.S)
        _Mirror().at((split.N.x, oscillator.W.y)).theta(-45)
        _Mirror().at((mixed.S.x, oscillator.E.y)).theta(45)

        flow.Line(**_BEAM).at(mixed.E).right(0.5)
        right = _Detector()
        flow.Line(**_BEAM).at(mixed.N).up(0.5)
        upper = _Detector().theta(90)
        flow.Arrow().at(right.out).right(0.6)
        difference = dsp.Circle(radius=0.3).label("$-$")
        flow.Wire("n", k=0.25, arrow="->").at(upper.out).to(difference.N)

        flow.Arrow().at(difference.S).down(0.9).label("$I(t)$", "bottom")
        smoother = flow.Box(w=2.2, h=1.8).anchor("N").label("robust\nfilter and\nsmoother")
        flow.Arrow().at(smoother.SSE).down(1.2).label(r"$\hat\phi(t|t\!+\!\delta)$", "left")
        fed = flow.Wire("n", k=-0.6, arrow="->").at(smoother.SSW).to(oscillator.S)
        fed.label(r"$\hat\phi(t|t)$", "mid", valign="bottom", ofst=(0, 0.1))
    return _figure(drawing)


class _BeamSplitter(dsp.Square):
    """A cube with its mirror."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.segments.append(Segment([(0, -0.5), (1, 0.5)]))


class _Mirror(elements.Element):
    """A mirror, in the middle of its line."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.segments.append(Segment([(-0.35, 0), (0.35, 0)], lw=1.5))


class _Detector(elements.Element):
    """A photodetector: the light comes to its flat side, the current leaves at the round one."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.segments.append(SegmentArc((0, 0), 0.8, 0.8, theta1=-90, theta2=90))
        self.segments.append(Segment([(0, -0.4), (0, 0.4)]))
        self.anchors["out"] = (0.4, 0)
        self.elmparams["drop"] = (0.4, 0)


def _drawing() -> schemdraw.Drawing:
    """Return a drawing of whose units ten or so are the width."""
    drawing = schemdraw.Drawing(show=False)
    drawing.config(fontsize=8, lw=0.8, inches_per_unit=0.34)
    return drawing


def _figure(drawing: schemdraw.Drawing) -> Figure:
    """Return the diagram as a figure."""
    box = drawing.get_bbox()
    left, right = box.xmin - _MARGIN, box.xmax + _MARGIN
    bottom, top = box.ymin - _MARGIN, box.ymax + _MARGIN
    size = (_WIDTH, _WIDTH * (top - bottom) / (right - left))
    figure, axes = plt.subplots(figsize=size, layout="none")
    figure.subplots_adjust(0, 0, 1, 1)
    drawing.draw(canvas=axes, show=False)
    for text in axes.texts:
        text.set_linespacing(1.3)  # there are hats and tildes
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.axis("off")
    return figure
