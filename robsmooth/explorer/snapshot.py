"""From settings to everything that the panels show: pure functions, quick enough for a slider.

Where the theory, or the loop itself, does not allow something, its place is taken by the sentence
that says so.
"""

import math
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import NamedTuple, TypeVar

import numpy as np

import robsmooth as rs
from robsmooth._support import validation
from robsmooth.estimators.bound import best_tau
from robsmooth.estimators.conditions import COSTS
from robsmooth.paper.published import DELAY, ORDER, printed
from robsmooth.simulation.integrator import ExponentialIntegrator
from robsmooth.simulation.loop import nonlinear_loop

# Where the least bound of the example is, whatever the parameters, unless it pays to ignore the
# measurement: tau is all that is left to search for.
BEST_MULTIPLIERS = (1.0, 0.5, 0.0, 0.0)
SLOPES = np.linspace(-1.0, 0.0, 21)  # Delta_2 of the sweep
STEP, SHOWN, BEFORE = 0.4e-6, 100, 25  # of the sample path: s, steps that are shown, and before
SEED = 11  # of the sample path
DESIGNS = ("robust", "minimax", "classical", "tuned classical", "by hand")
_PAPER = rs.homodyne.PAPER


class Range(NamedTuple):
    """The values of a setting in the unit of its slider; its default must be one of them."""

    low: float
    high: float
    step: float
    exponent: int = 0  # the slider's unit is 10^exponent of SI

    def si(self, shown: float) -> float:
        """Return in SI what the slider shows, to the digits that it shows."""
        return float(f"{shown:.4g}e{self.exponent}")

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
    cost: str = COSTS[0]  # the error that a design keeps low, and that is judged
    design: str = DESIGNS[0]  # least V or certified worst, nominal, tuned, these tau and lambda
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
    def classical(self) -> "Settings":
        """The same loop with the classical smoother."""
        return replace(self, design="classical")

    @property
    def parameters(self) -> rs.homodyne.HomodyneParameters:
        """The optical loop: more noise is that of a weaker beam."""
        alpha = _PAPER.alpha / self.noise**0.5
        return replace(_PAPER, lam=self.lam, kappa=self.kappa, alpha=alpha, gamma=self.gamma)


_MOST_STATES = 2 + int(RANGES["order"].high)  # the phase and an estimator of the largest order
T = TypeVar("T")

# What is found of the settings' design and of the classical smoother.
Pair = namedtuple("Pair", "own classical")
# Mean square errors at each of `SLOPES`, rad^2, in a loop without the fictitious noise.
Sweep = namedtuple("Sweep", "filtered smoothed")
# A path of the phase, rad, and its estimates, made at the same times.
Path = namedtuple("Path", "time phase filtered smoothed")


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What there is to see at some settings."""

    settings: Settings
    filtering: float  # the Kalman-Bucy filter's error without uncertainty, rad^2
    optimum: float  # what no smoother with this lag can beat then
    estimator: rs.Estimator | str
    sweeps: Pair | str  # of `Sweep`
    predicted: Pair | str  # of `StatisticalLinearisation`: the errors with the sine
    path: Path | str
    judged: Pair | str  # of `Judgement`; before `judge` with the worst of the sweep, and NaN


def take_snapshot(settings: Settings) -> Snapshot:
    """Return what there is to see at some settings at once."""
    parameters = settings.parameters
    least = partial(rs.baselines.optimal_fixed_lag_error, parameters.uncertain_system())
    both = estimator, _ = [_found(design, each) for each in (settings, settings.classical)]
    sweeps = _pair(_sweep, both)
    return Snapshot(
        settings=settings,
        filtering=least(0.0).item(),
        optimum=least(settings.lag).item(),
        estimator=estimator,
        sweeps=sweeps,
        predicted=_pair(partial(rs.statistical_linearisation, parameters), both),
        path=_found(_path, estimator),
        judged=sweeps if isinstance(sweeps, str) else _pair(_worst, sweeps, output=settings.cost),
    )


def judge(snapshot: Snapshot) -> Snapshot:
    """Return a snapshot with the certified errors, which take longer."""
    settings = snapshot.settings
    return replace(snapshot, judged=_pair(_judgement, (settings, settings.classical)))


@lru_cache(maxsize=8)
def _judgement(settings: Settings) -> rs.Judgement:
    return rs.judge(design(settings), settings.cost)


def _worst(sweep: Sweep, output: str) -> rs.Judgement:
    errors = getattr(sweep, output)
    return rs.Judgement(errors[-1], errors.max(), math.nan)


@lru_cache(maxsize=8)
def design(settings: Settings) -> rs.Estimator:
    """Return the estimator that the settings ask for."""
    plant, cost = _plant(settings), settings.cost
    match settings.design:
        case "minimax":
            return rs.minimax_smoother(plant, cost)
        case "classical":
            arguments = plant.system, plant.delay, plant.order
            return rs.baselines.fixed_lag_smoother(*arguments, copies=True)
        case "tuned classical":
            return rs.baselines.tuned_fixed_lag_smoother(plant, output=cost)
    return rs.limiting_smoother(plant, *robust_arguments(settings), cost)


@lru_cache(maxsize=1)
def robust_arguments(settings: Settings) -> tuple[float, tuple[float, ...]]:
    """Return tau and the multipliers of the paper's design: as set, or with the least bound."""
    if settings.design == "by hand":
        multipliers = settings.lambda1, settings.lambda2, settings.lambda3, settings.lambda4
        return settings.tau, multipliers
    tau = best_tau(_plant(settings), BEST_MULTIPLIERS, settings.cost)
    return float(f"{tau:.6g}"), BEST_MULTIPLIERS


def _plant(settings: Settings) -> rs.AugmentedSystem:
    return rs.augment(settings.parameters.uncertain_system(), settings.lag, settings.order)


def _pair(find: Callable, both: Iterable, **options: object) -> Pair | str:
    return _found(Pair, *(_found(find, each, **options) for each in both))


def _found(find: Callable[..., T], *given: object, **options: object) -> T | str:
    """What is found; or the sentence that stands for something given, or says what is amiss."""
    for each in given:
        if isinstance(each, str):
            return each
    try:
        return find(*given, **options)
    except (rs.InfeasibleDesignError, rs.UnstableLoopError, ArithmeticError, RuntimeError) as error:
        return str(error)


def _sweep(estimator: rs.Estimator) -> Sweep:
    found = (rs.delta_sweep(estimator, SLOPES, output, loop="real") for output in Sweep._fields)
    return Sweep(*(errors[:, 0, 0] for errors in found))


def _path(estimator: rs.Estimator) -> Path:
    """Simulate one path, on the same noise whatever the loop, unlike `rs.sample_paths`."""
    loop = nonlinear_loop(estimator)
    integrator = ExponentialIntegrator(loop, STEP)
    noise = np.random.default_rng(SEED).standard_normal((1 + BEFORE + SHOWN, _MOST_STATES))
    start, *steps = noise[:, : loop.order, None]
    z = loop.stationary_root @ start
    states = []
    for normals in steps:
        z = integrator.advance(0.0, z, loop.arguments @ z, integrator.noise @ normals)
        states.append(z[:, 0])
    time = STEP * np.arange(1, SHOWN + 1)
    return Path(time, *loop.readout @ np.array(states[BEFORE:]).T)  # w and its two estimates
