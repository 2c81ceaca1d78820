"""Section IV: adaptive homodyne estimation of an optical phase, the paper's example."""

from robsmooth.homodyne.parameters import PAPER, HomodyneParameters, fraction_inside

__all__ = ["PAPER", "HomodyneParameters", "fraction_inside"]
