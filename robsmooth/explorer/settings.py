"""The settings of the explorer: what its controls say."""

from dataclasses import dataclass, replace
from decimal import Decimal
from typing import NamedTuple

import robsmooth as rs
from robsmooth._support import validation
from robsmooth.estimators.conditions import COSTS
from robsmooth.paper.published import DELAY, ORDER, printed

DESIGNS = ("robust", "by hand", "classical")
_PAPER = rs.homodyne.PAPER


class Range(NamedTuple):
    """The values of a setting in the unit of its slider; its default must be one of them."""

    low: float
    high: float
    step: float
    exponent: int = 0  # the slider's unit is 10^exponent of SI

    def si(self, shown: float) -> float:
        """Return in SI what the slider shows, to the digits that it shows."""
        return float(Decimal(f"{shown:.4g}").scaleb(self.exponent))

    def shown(self, value: float) -> float:
        """Return a value in the unit of the slider."""
        return round(value / 10.0**self.exponent, 12)


RANGES = {
    "lag": Range(0.2, 15.0, 0.1, -6),
    "order": Range(1, 5, 1),
    "gamma": Range(0.05, 0.8, 0.01),
    "noise": Range(0.1, 5.0, 0.1),
    "lam": Range(1.0, 50.0, 0.02, 3),
    "kappa": Range(4.0, 250.0, 2.0, 3),
    "tau": Range(0.2, 10.0, 0.01, -6),
    **dict.fromkeys(("lambda1", "lambda2"), Range(0.0, 1.0, 0.0001)),
    **dict.fromkeys(("lambda3", "lambda4"), Range(0.0, 0.02, 0.0001)),
}


@dataclass(frozen=True)
class Settings:
    """What the explorer shows; by default the paper's example."""

    lag: float = DELAY  # how far back the smoothed estimate looks, s
    order: int = ORDER  # of the Pade model of the lag
    gamma: float = _PAPER.gamma  # half width of the sector that the sine is taken to stay in
    noise: float = 1.0  # power of the shot noise, relative to the paper's; the design knows of it
    lam: float = _PAPER.lam  # decay rate of the phase, rad/s
    kappa: float = _PAPER.kappa  # diffusion of the phase, rad^2/s
    cost: str = COSTS[0]  # the error that a robust design keeps low
    design: str = DESIGNS[0]  # least bound, these tau and lambda, or the nominal smoother
    tau: float = printed("tau")  # rad^2 s
    lambda1: float = printed("lambda_1")
    lambda2: float = printed("lambda_2")
    lambda3: float = printed("lambda_3")
    lambda4: float = printed("lambda_4")

    def __post_init__(self):
        for name, allowed in RANGES.items():
            low, high = allowed.si(allowed.low), allowed.si(allowed.high)
            value = validation.real(name, getattr(self, name), low=low, high=high)
            object.__setattr__(self, name, value)
        if not self.order.is_integer():
            raise ValueError(f"order must be a whole number, got {self.order}")
        object.__setattr__(self, "order", int(self.order))
        validation.choice("cost", self.cost, COSTS)
        validation.choice("design", self.design, DESIGNS)

    @property
    def multipliers(self) -> tuple[float, ...]:
        """The four multipliers of a design by hand."""
        return self.lambda1, self.lambda2, self.lambda3, self.lambda4

    @property
    def parameters(self) -> rs.homodyne.HomodyneParameters:
        """The optical loop: more noise is that of a weaker beam."""
        alpha = _PAPER.alpha / self.noise**0.5
        return replace(_PAPER, lam=self.lam, kappa=self.kappa, alpha=alpha, gamma=self.gamma)
