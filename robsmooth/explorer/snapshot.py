"""The explorer's settings, and what there is to see at them."""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import NamedTuple

import numpy as np

import robsmooth as rs
from robsmooth._support import validation
from robsmooth._support.validation import Matrix
from robsmooth.analysis.lag import classical_error, optimal_error
from robsmooth.estimators.bound import best_tau
from robsmooth.estimators.conditions import COSTS
from robsmooth.homodyne.loop import StatisticalLinearisation
from robsmooth.paper.published import DELAY, ORDER
from robsmooth.simulation.loop import Steps, nonlinear_loop

# The example's least bound is at these, unless it pays to ignore the measurement; the parameters
# do not matter. Only tau remains to be found.
BEST_MULTIPLIERS = [1.0, 0.5, 0.0, 0.0]
DELAYS = 1e-6 * np.linspace(0.0, 15.0, 16)  # of the curves over the delay, s
STEP, SHOWN, BEFORE = 0.8e-6, 125, 13  # sample path: step in s, steps shown, steps before them
SEED = 11  # of the sample path
_HINTS = {  # what to do where a design by hand is refused with these words
    "a larger tau": "Move τ up, or the noise factor down. ",
    "M(lambda) > 0": "Move λ₁ and λ₂ above 0. ",
    "multiplier constraint": "Move one of λ₁ to λ₄ down. ",
    "ratios of the multipliers": "Move λ₃ and λ₄ down, or λ₁ up. ",
    "not in lock": "Move the noise factor or κ down. ",
}
_MOST_STATES = 2 + 5  # the phase, and an estimator of the largest order
DESIGNS = ("classical", "tuned", "minimax", "paper's V", "by hand")
_PAPER = rs.homodyne.PAPER


class Slider(NamedTuple):
    """A slider of a setting; the default is one of its values."""

    label: str
    tooltip: str
    low: float
    high: float
    step: float
    unit: float = 1.0  # SI value of the unit that it shows

    def si(self, shown: float) -> float:
        """Return the SI value of what the slider shows, to its digits."""
        return float(f"{shown * self.unit:.4g}")

    def shown(self, value: float) -> float:
        """Return a value in the unit of the slider."""
        return round(value / self.unit, 9)


SLIDERS = {
    "delay": Slider("delay (µs)", "how far back the smoothed estimate looks", 0.2, 15.0, 0.1, 1e-6),
    "order": Slider("order", "states of the delay's model: more follow it more closely", 1, 5, 1),
    "gamma": Slider("uncertainty γ", "half width of the sector of the sine", 0.05, 0.8, 0.01),
    "noise": Slider("noise factor", "shot noise, relative to the paper's", 0.1, 5.0, 0.1),
    "lam": Slider("decay λ (1/ms)", "decay rate of the phase", 1.0, 50.0, 0.02, 1e3),
    "kappa": Slider("κ (rad²/ms)", "diffusion of the phase", 4.0, 250.0, 1.0, 1e3),
    "tau": Slider("τ (µs rad²)", "the scale of the paper's design", 0.2, 10.0, 0.01, 1e-6),
    "lambda1": Slider("λ₁", "of the process noise's constraint", 0.0, 1.0, 0.0001),
    "lambda2": Slider("λ₂", "of the difference of the sine and its copy", 0.0, 1.0, 0.0001),
    "lambda3": Slider("λ₃", "of the sine's own constraint", 0.0, 0.02, 0.0001),
    "lambda4": Slider("λ₄", "of the copy's own constraint", 0.0, 0.02, 0.0001),
}


@dataclass(frozen=True)
class Settings:
    """The settings of the explorer; by default the paper's example, and a design that exists."""

    delay: float = DELAY  # s
    order: int = ORDER  # of its Pade model
    gamma: float = _PAPER.gamma  # half width of the sector assumed for the sine
    noise: float = 1.0  # power of the shot noise over the paper's; the designs are for it
    lam: float = _PAPER.lam  # decay rate of the phase, rad/s
    kappa: float = _PAPER.kappa  # diffusion of the phase, rad^2/s
    cost: str = COSTS[1]  # the error that designs keep low, and that is judged
    design: str = DESIGNS[2]  # one of `DESIGNS`; "by hand" is the paper's at the numbers below
    tau: float = 1.5e-6  # rad^2 s
    lambda1: float = BEST_MULTIPLIERS[0]
    lambda2: float = BEST_MULTIPLIERS[1]
    lambda3: float = BEST_MULTIPLIERS[2]
    lambda4: float = BEST_MULTIPLIERS[3]

    def __post_init__(self):
        for name, slider in SLIDERS.items():
            low, high = slider.si(slider.low), slider.si(slider.high)
            vars(self)[name] = validation.real(name, getattr(self, name), low=low, high=high)
        if not self.order.is_integer():
            raise ValueError(f"order must be a whole number, got {self.order}")
        vars(self)["order"] = int(self.order)
        validation.choice("cost", self.cost, COSTS)
        validation.choice("design", self.design, DESIGNS)

    @property
    def parameters(self) -> rs.homodyne.HomodyneParameters:
        """The optical loop: a weaker beam has more noise."""
        alpha = _PAPER.alpha / self.noise**0.5
        return replace(_PAPER, lam=self.lam, kappa=self.kappa, alpha=alpha, gamma=self.gamma)

    @property
    def plant(self) -> rs.AugmentedSystem:
        """The augmented system of the loop."""
        return rs.augment(self.parameters.uncertain_system(), self.delay, self.order)

    def best_tau(self) -> float:
        """Return the tau of the paper's design with the least bound."""
        return best_tau(self.plant, BEST_MULTIPLIERS, self.cost)

    @cached_property
    def _call(self) -> tuple[str, str, dict[str, object]]:
        """The function that finds the design, its argument, and its options."""
        match self.design:
            case "minimax":
                return "minimax_smoother", "plant", {"output": self.cost}
            case "tuned":
                return "baselines.tuned_fixed_lag_smoother", "plant", {"output": self.cost}
            case "classical":
                options = {"delay": self.delay, "order": self.order, "copies": True}
                return "baselines.fixed_lag_smoother", "plant.system", options
            case "paper's V":
                tau, weights = self.best_tau(), BEST_MULTIPLIERS
            case "by hand":
                tau, weights = self.tau, [getattr(self, f"lambda{i}") for i in (1, 2, 3, 4)]
        options = {"tau": float(f"{tau:.6g}"), "multipliers": weights, "cost": self.cost}
        return "limiting_smoother", "plant", options

    def estimator(self) -> rs.Estimator:
        """Return the design."""
        function, given, options = self._call
        return attrgetter(function)(rs)(attrgetter(given)(self), **options)

    def code(self) -> str:
        """Return code that finds the numbers of the design with the public API."""
        p, (function, given, options) = self.parameters, self._call
        arguments = ", ".join([given, *(f"{name}={value!r}" for name, value in options.items())])
        return f"""\
import robsmooth as rs

parameters = rs.homodyne.HomodyneParameters(
    lam={p.lam!r}, kappa={p.kappa!r}, alpha={p.alpha!r}, beta={p.beta!r}, gamma={p.gamma!r}
)
plant = rs.augment(parameters.uncertain_system(), delay={self.delay!r}, order={self.order})
smoother = rs.{function}({arguments})

judged = rs.judge(smoother, {self.cost!r})
with_sine = rs.statistical_linearisation(parameters, smoother)
print(smoother, judged, with_sine, sep="\\n")
"""


@dataclass(frozen=True, eq=False)
class Findings:
    """An estimator, and its mean square errors, rad^2."""

    estimator: rs.Estimator
    with_sine: StatisticalLinearisation
    judged: rs.Judgement  # of the error that is kept low; NaN where not yet computed


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What there is to see at some settings."""

    settings: Settings
    own: Findings  # of the design that was chosen
    found: dict[str, Findings]  # by design: the classical and the chosen one, then the others
    is_complete: bool  # whether all designs are there, and judged

    @cached_property
    def kalman(self) -> float:
        """The least error of any filter, without uncertainty, rad^2."""
        return optimal_error(self.settings.parameters.uncertain_system(), 0.0)


@lru_cache(maxsize=8)
def take_snapshot(settings: Settings, complete: bool = True) -> Snapshot | str:
    """Return what there is to see, or the sentence that says why there is nothing."""
    refusals, found = (ValueError, ArithmeticError, RuntimeError), {}
    try:
        for name in (DESIGNS[0], settings.design):
            found[name] = own = _findings(replace(settings, design=name), complete)
    except refusals as refusal:
        hints = "".join(hint for cause, hint in _HINTS.items() if cause in str(refusal))
        return f"{hints}The reason: {refusal}."
    for name in DESIGNS[:4] if complete else ():
        with suppress(*refusals):
            found[name] = found.get(name) or _findings(replace(settings, design=name), complete)
    return Snapshot(settings, own, found, complete)


def _findings(settings: Settings, complete: bool) -> Findings:
    estimator, with_sine = _designed(settings)
    if complete:
        return Findings(estimator, with_sine, rs.judge(estimator, settings.cost))
    certain = estimator.plant.structured_delta()
    nominal = rs.error_covariance(estimator, certain, settings.cost, loop="real").item()
    return Findings(estimator, with_sine, rs.Judgement(nominal, math.nan, math.nan))


@lru_cache(maxsize=16)
def _designed(settings: Settings) -> tuple[rs.Estimator, StatisticalLinearisation]:
    """Return the design, and its errors with the sine: for quick results, and again for all."""
    estimator = settings.estimator()
    return estimator, rs.statistical_linearisation(settings.parameters, estimator)


@lru_cache(maxsize=8)
def over_delays(parameters: rs.homodyne.HomodyneParameters, order: int) -> Matrix:
    """Return the optimum and the classical smoother's nominal error at each of `DELAYS`."""
    system = parameters.uncertain_system()
    errors = [(optimal_error(system, d), classical_error(system, order, d)) for d in DELAYS]
    return np.array(errors).T


def sample_path(estimator: rs.Estimator) -> Matrix:
    """Return the phase and its two estimates each `STEP`, of the same noise for every loop, rad."""
    loop = nonlinear_loop(estimator)
    scheme = Steps(loop, STEP)
    noise = np.random.default_rng(SEED).standard_normal((1 + BEFORE + SHOWN, _MOST_STATES))
    start, *steps = noise[:, : loop.order, None]
    z = loop.stationary_root @ start
    states = []
    for normals in steps:
        z = scheme.advance(0.0, z, scheme.noise @ normals)
        states.append(z[:, 0])
    return loop.readout @ np.array(states[BEFORE:]).T
