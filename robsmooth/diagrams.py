"""The block diagrams, Fig. 1 and Fig. 2, drawn with schemdraw."""

import itertools

import matplotlib.pyplot as plt
import schemdraw
from matplotlib.figure import Figure
from schemdraw import flow

Point = tuple[float, float]
_MARGIN = 0.6  # of schemdraw units: it takes the height of a text to be less than it is


def smoother_loop() -> Figure:
    """Draw Fig. 1: the uncertain nonlinear system, its delay model, and the nonlinear smoother."""
    diagram = _Diagram()
    diagram.box((0, 0), "uncertain nonlinear\nsystem", 5.8, 2.0)
    diagram.box((0, 3.0), r"$\Delta,\ \ \psi_i(\cdot)$", 3.0, 1.4)
    diagram.box((7.2, 0.5), "delay model", 3.4, 1.4)
    diagram.box((7.2, -3.6), "linear estimator\n$A_c,\\ \\tilde B_c,\\ \\tilde C_c$", 4.4, 2.0)
    diagram.box((7.2, -6.6), r"copies $\psi_i(\cdot)$", 3.4, 1.4)

    diagram.path((-5.0, -0.5), (-2.9, -0.5), label="$W$")
    diagram.path((2.9, 0.5), (4.0, 0.5), (4.0, 3.0), (1.5, 3.0), label=r"$\zeta,\ \nu$", segment=2)
    diagram.path((-1.5, 3.0), (-4.0, 3.0), (-4.0, 0.5), (-2.9, 0.5), label=r"$\xi,\ \mu$")
    diagram.path((4.0, 0.5), (5.5, 0.5), label="$w$")
    diagram.path((8.9, 0.5), (11.6, 0.5), label="$w_a$")
    diagram.path((2.9, -0.5), (4.0, -0.5), (4.0, -3.1), (5.0, -3.1), label="$y$", segment=2)
    diagram.path((9.4, -3.1), (11.6, -3.1), label=r"$\hat w,\ \hat w_a$")
    diagram.path(
        (9.4, -4.1), (10.6, -4.1), (10.6, -6.6), (8.9, -6.6), label=r"$\tilde\nu$", segment=2
    )
    diagram.path((5.5, -6.6), (4.0, -6.6), (4.0, -4.1), (5.0, -4.1), label=r"$\tilde\mu$")
    return diagram.figure(width=3.4)


def homodyne_loop() -> Figure:
    """Draw Fig. 2: the adaptive homodyne loop with the robust nonlinear filter and smoother."""
    diagram = _Diagram()
    diagram.box((0, 0), "phase\nmodulator", 3.8, 2.0)
    diagram.box((5.8, 0), "homodyne\ndetector", 3.8, 2.0)
    diagram.box((12.0, 0), "robust filter\nand smoother", 5.2, 2.0)
    diagram.box((5.8, -3.6), "local oscillator\n$\\Phi = \\hat\\phi + \\pi/2$", 5.4, 2.2)
    diagram.path((-3.6, 0), (-1.9, 0), label=r"$\alpha$")
    diagram.path((0, 2.6), (0, 1.0), label=r"$\phi(t)$", side="right")
    diagram.path((1.9, 0), (3.9, 0), label=r"$\alpha e^{i\phi}$")
    diagram.path((7.7, 0), (9.4, 0), label="$I(t)$")
    diagram.path((14.6, 0), (18.1, 0), label=r"$\hat\phi(t|t\!+\!\delta)$")
    diagram.path((12.0, -1.0), (12.0, -3.6), (8.5, -3.6), label=r"$\hat\phi(t|t)$", segment=1)
    diagram.path((5.8, -2.5), (5.8, -1.0))
    return diagram.figure(width=3.4)


class _Diagram:
    """Boxes and arrows at given places, in units of a third of a box's width or so."""

    def __init__(self):
        self._drawing = schemdraw.Drawing(show=False)
        self._drawing.config(fontsize=7, lw=0.8)

    def box(self, center: Point, text: str, width: float, height: float = 1.7) -> None:
        """Draw a box around a text."""
        box = flow.Box(w=width, h=height).anchor("center").at(center).label(text)
        self._drawing.add(box)

    def path(self, *points: Point, label: str = "", segment: int = 0, side: str = "top") -> None:
        """Draw a line through the points that ends in an arrow, with a label on one segment."""
        for index, (start, end) in enumerate(itertools.pairwise(points)):
            last = index == len(points) - 2
            line = flow.Arrow(headwidth=0.3, headlength=0.4) if last else flow.Line()
            line = line.at(start).to(end)
            if label and index == segment:
                line = line.label(label, side, ofst=0.15)
            self._drawing.add(line)

    def figure(self, width: float) -> Figure:
        """Return the diagram as a figure that is `width` inches wide."""
        box = self._drawing.get_bbox()
        left, right = box.xmin - _MARGIN, box.xmax + _MARGIN
        bottom, top = box.ymin - _MARGIN, box.ymax + _MARGIN
        size = (width, width * (top - bottom) / (right - left))
        figure, axes = plt.subplots(figsize=size, layout="none")
        figure.subplots_adjust(0, 0, 1, 1)
        self._drawing.draw(canvas=axes, show=False)
        axes.set(xlim=(left, right), ylim=(bottom, top))
        axes.axis("off")
        return figure
