"""From settings to everything that the panels show: pure functions, quick enough for a slider.

Where the theory, or the loop itself, does not allow something, its place is taken by the sentence
that says so.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from robsmooth._support.errors import InfeasibleDesignError, UnstableLoopError
from robsmooth.analysis.covariance import delta_sweep
from robsmooth.analysis.statistical_linearisation import (
    StatisticalLinearisation,
    statistical_linearisation,
)
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import best_tau
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.limit import limiting_smoother
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.explorer.settings import RANGES, Settings
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.montecarlo import (
    LossOfLockWarning,
    MonteCarloResult,
    monte_carlo,
)
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.simulation.integrator import ExponentialIntegrator
from robsmooth.simulation.loop import nonlinear_loop
from robsmooth.systems.augmented import AugmentedSystem, augment

# Where the least bound of the example is, whatever the parameters, unless it pays to ignore the
# measurement: tau is all that is left to search for.
BEST_MULTIPLIERS = (1.0, 0.5, 0.0, 0.0)
SLOPES = np.linspace(-1.0, 0.0, 21)  # Delta_2 of the sweep
ADMISSIBLE = np.linspace(-1.0, 1.0, 13)  # Delta_2 of what the bound is compared with
RUNS = 128  # paths of the simulation
STEP, SHOWN, BEFORE = 0.4e-6, 100, 25  # of the sample path: s, steps that are shown, and before
SEED = 11  # of the sample path
_MOST_STATES = 2 + int(RANGES["order"].high)  # the phase and an estimator of the largest order

T = TypeVar("T")


class Guarantee(NamedTuple):
    """The error that a design's bound is for, with the fictitious noise that the bound counts."""

    errors: NDArray[np.float64]  # mean squares at each of `ADMISSIBLE`, rad^2
    bound: float  # on them, rad^2: twice V; infinity for a design that comes without


class Sweep(NamedTuple):
    """Mean square errors at each of `SLOPES`, rad^2, in a loop without the fictitious noise."""

    filtered: NDArray[np.float64]
    smoothed: NDArray[np.float64]


class Path(NamedTuple):
    """A path of the phase, rad, and its estimates, made at the same times."""

    time: NDArray[np.float64]
    phase: NDArray[np.float64]
    filtered: NDArray[np.float64]
    smoothed: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What there is to see at some settings, but for the simulation of many paths.

    A sentence stands for what there is not.

    Attributes
    ----------
    settings : Settings
    parameters : HomodyneParameters
    filtering, optimum : float
        The Kalman-Bucy filter's error, and what no smoother with this lag can beat; both without
        uncertainty, rad^2.
    estimator : Estimator or str
    poles : (2, n) complex array or str
        Of the estimator in its loop, 1/s, at the tangent of the sine and at the sector's edge.
    sweep, classical : Sweep or str
        Of the estimator, and of the classical fixed-lag smoother.
    guarantee : Guarantee or str
    predicted : StatisticalLinearisation or str
        The errors with the sine, by statistical linearisation.
    path : Path or str
    """

    settings: Settings
    parameters: HomodyneParameters
    filtering: float
    optimum: float
    estimator: Estimator | str
    poles: NDArray[np.complex128] | str
    sweep: Sweep | str
    classical: Sweep | str
    guarantee: Guarantee | str
    predicted: StatisticalLinearisation | str
    path: Path | str


def take_snapshot(settings: Settings) -> Snapshot:
    """Return what there is to see at some settings."""
    parameters = settings.parameters
    system = parameters.uncertain_system()
    estimator = _or_message(lambda: design(settings))

    def of_estimator(find: Callable[[Estimator], T]) -> T | str:
        return estimator if isinstance(estimator, str) else _or_message(lambda: find(estimator))

    return Snapshot(
        settings=settings,
        parameters=parameters,
        filtering=float(baselines.optimal_fixed_lag_error(system, 0.0)[0, 0]),
        optimum=float(baselines.optimal_fixed_lag_error(system, settings.lag)[0, 0]),
        estimator=estimator,
        poles=of_estimator(lambda found: _poles(parameters, found)),
        sweep=of_estimator(_sweep),
        classical=_or_message(lambda: _sweep(_classical(settings))),
        guarantee=of_estimator(_guarantee),
        predicted=of_estimator(
            lambda found: statistical_linearisation(found, parameters.equivalent_slope)
        ),
        path=of_estimator(_path),
    )


def simulate(snapshot: Snapshot) -> MonteCarloResult | str:
    """Simulate the nonlinear loop of a snapshot, many times."""
    if isinstance(snapshot.estimator, str):
        return snapshot.estimator
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LossOfLockWarning)  # the slips are counted
        return _or_message(lambda: monte_carlo(snapshot.parameters, snapshot.estimator, runs=RUNS))


def design(settings: Settings) -> Estimator:
    """Return the estimator that the settings ask for.

    Raises
    ------
    InfeasibleDesignError
        Where there is none.
    """
    if settings.design == "classical":
        return _classical(settings)
    return limiting_smoother(_plant(settings), *robust_arguments(settings), settings.cost)


@lru_cache(maxsize=1)
def robust_arguments(settings: Settings) -> tuple[float, tuple[float, ...]]:
    """Return tau and the multipliers of a robust design: as set, or with the least bound."""
    if settings.design == "by hand":
        return settings.tau, settings.multipliers
    tau = best_tau(_plant(settings), BEST_MULTIPLIERS, settings.cost)
    return float(f"{tau:.6g}"), BEST_MULTIPLIERS


def _plant(settings: Settings) -> AugmentedSystem:
    return augment(settings.parameters.uncertain_system(), settings.lag, settings.order)


def _classical(settings: Settings) -> Estimator:
    system = settings.parameters.uncertain_system()
    return baselines.fixed_lag_smoother(system, settings.lag, settings.order, copies=True)


def _or_message(find: Callable[[], T]) -> T | str:
    """Return what is found, or the message of the error that says why there is nothing."""
    try:
        return find()
    except (InfeasibleDesignError, UnstableLoopError, ArithmeticError, RuntimeError) as error:
        return str(error)


def _sweep(estimator: Estimator) -> Sweep:
    filtered, smoothed = (
        delta_sweep(estimator, SLOPES, output, loop="real")[:, 0, 0]
        for output in ("filtered", "smoothed")
    )
    return Sweep(filtered, smoothed)


def _guarantee(estimator: Estimator) -> Guarantee:
    """Find the error that the bound is for: against w, or against the output of the delay model."""
    robust = isinstance(estimator, RobustSmoother)
    output = "guaranteed" if robust else "filtered"
    return Guarantee(
        delta_sweep(estimator, ADMISSIBLE, output)[:, 0, 0],
        estimator.mean_square_bound if robust else math.inf,
    )


def _poles(parameters: HomodyneParameters, estimator: Estimator) -> NDArray[np.complex128]:
    loop = homodyne_loop(parameters, estimator)
    slopes = parameters.beta, parameters.lower_slope
    drifts = [loop.linearised_drift(slope, slope)[1:, 1:] for slope in slopes]
    return np.linalg.eigvals(drifts)


def _path(estimator: Estimator) -> Path:
    """Simulate one path, on the same noise whatever the loop: a change moves it, no more.

    That of `sample_paths` depends on the lag, which its step divides, and on the order.
    """
    loop = nonlinear_loop(estimator)
    integrator = ExponentialIntegrator(loop, STEP)
    start, *steps = _normals()[:, : loop.order, None]
    z = loop.stationary_root @ start
    states = []
    for normals in steps:
        z = integrator.advance(0.0, z, loop.arguments @ z, integrator.noise @ normals)
        states.append(z[:, 0])
    time = STEP * np.arange(1, SHOWN + 1)
    return Path(time, *loop.readout @ np.array(states[BEFORE:]).T)  # w and its two estimates


@cache
def _normals() -> NDArray[np.float64]:
    """Return the noise of each state at the start and in each step."""
    return np.random.default_rng(SEED).standard_normal((1 + BEFORE + SHOWN, _MOST_STATES))
