"""From settings to everything that the panels show: pure functions, quick enough for a slider.

Where the theory, or the loop itself, does not allow something, its place is taken by the sentence
that says so.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from robsmooth._numerics.exponential import responses
from robsmooth._numerics.lyapunov import noise_root
from robsmooth._support.errors import InfeasibleDesignError, UnstableLoopError
from robsmooth.analysis.covariance import delta_sweep
from robsmooth.analysis.statistical_linearisation import (
    StatisticalLinearisation,
    statistical_linearisation,
)
from robsmooth.estimators import baselines
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.limit import limiting_smoother
from robsmooth.estimators.smoother import RobustSmoother
from robsmooth.explorer.settings import Settings
from robsmooth.homodyne.certificate import least_tau, scalar_bound
from robsmooth.homodyne.loop import Loop, homodyne_loop
from robsmooth.homodyne.montecarlo import (
    LossOfLockWarning,
    MonteCarloResult,
    monte_carlo,
)
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.systems.augmented import augment

# Where the least bound of the example is, whatever the parameters, unless it pays to ignore the
# measurement: tau is all that is left to search for.
BEST_MULTIPLIERS = (1.0, 0.5, 0.0, 0.0)
SLOPES = np.linspace(-1.0, 0.0, 21)  # Delta_2 of the sweep
ADMISSIBLE = np.linspace(-1.0, 1.0, 13)  # Delta_2 of what the bound is compared with
RUNS = 128  # paths of the simulation
STEP, SHOWN, BEFORE = 0.2e-6, 200, 150  # of the sample path: s, steps that are shown, and before
SEED = 8  # of the sample path

_TAU_DECADES = 6.0  # above the least tau, in which the best one is
_TAU_OF_SMOOTHED = (0.4, 1.05)  # where the best tau is for the smoothed cost, relative to that

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Guarantee:
    """The error that a design's bound is for, with the fictitious noise that the bound counts.

    Attributes
    ----------
    errors : (len(ADMISSIBLE),) array
        Mean squares, rad^2.
    bound : float
        On them, rad^2: twice V. Infinity for a design that comes without.
    """

    errors: NDArray[np.float64]
    bound: float


@dataclass(frozen=True, eq=False)
class Sweep:
    """Mean square errors at each of `SLOPES`, rad^2, in a loop without the fictitious noise."""

    filtered: NDArray[np.float64]
    smoothed: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Path:
    """A path of the phase, rad, and its estimates at the same times."""

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


def look(settings: Settings) -> Snapshot:
    """Return what there is to see at some settings."""
    parameters = settings.parameters
    system = parameters.uncertain_system()
    estimator = _or_sentence(lambda: design(settings))

    def of_estimator(find: Callable[[Estimator], T]) -> T | str:
        return estimator if isinstance(estimator, str) else _or_sentence(lambda: find(estimator))

    return Snapshot(
        settings=settings,
        parameters=parameters,
        filtering=float(baselines.optimal_fixed_lag_error(system, 0.0)[0, 0]),
        optimum=float(baselines.optimal_fixed_lag_error(system, settings.lag)[0, 0]),
        estimator=estimator,
        poles=of_estimator(lambda found: _poles(parameters, found)),
        sweep=of_estimator(_sweep),
        classical=_or_sentence(lambda: _sweep(_classical(settings))),
        guarantee=of_estimator(_guarantee),
        predicted=of_estimator(
            lambda found: statistical_linearisation(found, parameters.equivalent_slope)
        ),
        path=of_estimator(lambda found: _path(homodyne_loop(parameters, found))),
    )


def simulate(snapshot: Snapshot) -> MonteCarloResult | str:
    """Simulate the nonlinear loop of a snapshot, many times."""
    if isinstance(snapshot.estimator, str):
        return snapshot.estimator

    def run() -> MonteCarloResult:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LossOfLockWarning)  # the slips are counted
            return monte_carlo(snapshot.parameters, snapshot.estimator, runs=RUNS)

    return _or_sentence(run)


def design(settings: Settings) -> Estimator:
    """Return the estimator that the settings ask for.

    Raises
    ------
    InfeasibleDesignError
        Where there is none.
    """
    if settings.design == "classical":
        return _classical(settings)
    tau, multipliers = robust_arguments(settings)
    return _robust(settings, tau, multipliers)


@lru_cache(maxsize=1)
def robust_arguments(settings: Settings) -> tuple[float, tuple[float, ...]]:
    """Return tau and the multipliers of a robust design: as set, or with the least bound."""
    if settings.design == "by hand":
        return settings.tau, settings.multipliers
    parameters, p = settings.parameters, sum(BEST_MULTIPLIERS[1:3])
    least = least_tau(parameters, p)
    tau = _best_tau(
        lambda tau: float(scalar_bound(parameters, p, tau)), least, 10.0**_TAU_DECADES * least, 1e-6
    )
    if settings.cost == "smoothed":  # a search that takes its time
        low, high = (factor * tau for factor in _TAU_OF_SMOOTHED)
        tau = _best_tau(lambda tau: _bound(settings, tau), low, high, 3e-3)
    return float(f"{tau:.6g}"), BEST_MULTIPLIERS


def _best_tau(bound: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Return the tau with the least bound, which may be infinite at some."""
    found = minimize_scalar(
        lambda logarithm: -1.0 / bound(math.exp(logarithm)),
        bounds=(math.log(low), math.log(high)),
        method="bounded",
        options={"xatol": tolerance},
    )
    return math.exp(found.x)


def _bound(settings: Settings, tau: float) -> float:
    try:
        return _robust(settings, tau, BEST_MULTIPLIERS).bound
    except InfeasibleDesignError:
        return math.inf


def _robust(settings: Settings, tau: float, multipliers: tuple[float, ...]) -> RobustSmoother:
    plant = augment(settings.parameters.uncertain_system(), settings.lag, settings.order)
    return limiting_smoother(plant, tau, multipliers, settings.cost)


def _classical(settings: Settings) -> Estimator:
    system = settings.parameters.uncertain_system()
    return baselines.fixed_lag_smoother(system, settings.lag, settings.order, copies=True)


def _or_sentence(find: Callable[[], T]) -> T | str:
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
    return np.array(
        [np.linalg.eigvals(loop.linearised_drift(slope, slope)[1:, 1:]) for slope in slopes]
    )


def _path(loop: Loop) -> Path:
    """Simulate one path on the same noise, whatever the loop: a change moves it, no more.

    The linear part of the estimator is exact; the sines are held over a step.
    """
    drive, noise = _normals()
    transition, held, _ = responses(loop.drift, loop.gains()[1:], STEP)
    measured, copied = held.T
    decay = math.exp(-loop.phase_decay * STEP)
    phase_noise = np.array([[loop.phase_diffusion]])
    spread = noise_root(np.array([[-loop.phase_decay]]), phase_noise, STEP)[0, 0]
    phase, state = 0.0, np.zeros(loop.order)
    phases, states = np.empty(len(drive)), np.empty((len(drive), loop.order))
    for k, (kick, shot) in enumerate(zip(drive, loop.sine_noise / STEP**0.5 * noise, strict=True)):
        seen = math.sin(phase - loop.reference @ state) + shot
        copy = math.sin(loop.copy @ state)
        state = transition @ state + seen * measured + copy * copied
        phase = decay * phase + spread * kick
        phases[k], states[k] = phase, state
    shown = slice(BEFORE, None)
    time = STEP * np.arange(1, SHOWN + 1)
    return Path(time, phases[shown], states[shown] @ loop.filtered, states[shown] @ loop.smoothed)


@cache
def _normals() -> NDArray[np.float64]:
    return np.random.default_rng(SEED).standard_normal((2, BEFORE + SHOWN))
