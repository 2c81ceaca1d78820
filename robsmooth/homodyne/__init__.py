"""Section IV: adaptive homodyne estimation of an optical phase, the paper's example."""

from robsmooth.homodyne.parameters import PAPER, HomodyneParameters

__all__ = ["PAPER", "HomodyneParameters"]
