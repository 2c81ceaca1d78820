r"""The least bound: minimisation of V over tau and lambda.

SciPy's SLSQP minimises :math:`\log V` under the constraint :math:`J'M(\lambda)J \le I`, in natural
units, from several starts. The limit in which the multipliers of the mu and mu-tilde constraints
vanish (`limiting_smoother`) is searched, too. `docs/source/methods.md` has the reasons.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError
from scipy.optimize import minimize, minimize_scalar

from robsmooth._numerics.riccati import stabilising
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.estimators import conditions
from robsmooth.estimators.drift import Drift
from robsmooth.estimators.equations import DesignEquations, DesignProblem
from robsmooth.estimators.smoother import RobustSmoother, design_smoother, limiting_smoother
from robsmooth.estimators.units import Units
from robsmooth.systems.augmented import AugmentedSystem, undelayed

VANISHING = 1e-6  # the multipliers of a design near the infimum, relative to the largest
_EXCESS = 1e-3  # of that design's bound; where it is more, the multipliers are made smaller
_LARGEST_TAU = 1e20  # in natural units; the least is its inverse
_TAU_TOLERANCE = 1e-7  # relative

_SAMPLE = 4  # random multipliers for each start
_TAUS = 10.0 ** np.arange(-16.0, 7.0)  # of the starts
_LEAST = 1e-13  # a multiplier, relative to the largest that the constraint allows
_IGNORED = 1e-10  # the same, where a start ignores a channel
_SAME = 1e-9  # a difference of bounds, relative
_STEP = 1e-6  # of the differences, in logarithms
_REFUSED = 1e3  # more than the logarithm of any bound
_ROUNDING = 1e-18  # of the constraint's levels
_ROUGH = {"ftol": 1e-6, "maxiter": 50}  # SLSQP's options from each start ...
_FINE = {"ftol": 1e-14, "maxiter": 100}  # ... and from the best end
_STABILITY_MARGIN = 1e-10  # of a Riccati equation's closed loop, relative to its Hamiltonian's norm
_PASSES = 10  # of SLSQP, each from where the one before has stopped
_TIGHT = 1e-11  # a pass that lowers log V by less is the last


@one_thread
def minimize_bound(
    plant: AugmentedSystem, cost: str | None = None, *, starts: int = 4
) -> RobustSmoother:
    r"""Design the smoother with the least bound V over :math:`\tau` and :math:`\lambda`.

    Where the bound falls as the multipliers of the mu and mu-tilde constraints vanish, these are at
    most a millionth of the largest, and `bound_infimum` and `limit` of the result are the limits of
    bound and design. `best_lag` and `choose_lag` choose the delay and the order, too.

    Parameters
    ----------
    plant, cost : as in `design_smoother`; by default "smoothed" where the plant has a delay
    starts : int, the number of starting points, the best of a random sample over decades

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.minimize_bound(plant, cost="smoothed")
    >>> round(smoother.mean_square_bound, 4), round(smoother.bound_infimum, 5)
    (0.1399, 0.06994)
    """
    conditions.check_plant(plant, "filtered" if cost is None else cost)
    if cost is None:
        cost = "smoothed" if plant.delay > 0.0 else "filtered"
    most = {"high": 1000, "why": ": each takes a second, and more than 16 rarely find better"}
    starts = validation.integer("starts", starts, low=1, **most)
    conditions.check_stable(plant)
    search, alone = _Search.of(plant, cost), conditions.of_measurements(plant)
    value, tau, multipliers = search.least(starts)
    if alone.size and alone.all():
        positive = np.arange(len(search.levels)) < plant.system.k + plant.system.g
        there = replace(search, positive=positive).least(starts)
        if there[0] < value + _SAME:
            value, tau, multipliers = there
    if value >= _REFUSED:
        raise InfeasibleDesignError(
            "Assumption 3",
            "no design was found; with smaller uncertainty outputs or Lipschitz constants there "
            "may be one, and minimax_smoother needs fewer conditions",
            verb="failed where the search ended",
        )
    level = conditions.multiplier_level(plant, multipliers)
    tau, multipliers = tau * search.tau * level, multipliers / level
    if multipliers.all():
        return design_smoother(plant, tau, multipliers, cost)
    design = limit = limiting_smoother(plant, tau, multipliers, cost)
    for fraction in VANISHING * 0.1 ** np.arange(7):
        near = np.where(multipliers > 0.0, multipliers, fraction * multipliers.max())
        near /= conditions.multiplier_level(plant, near)
        with suppress(InfeasibleDesignError):
            design = design_smoother(plant, best_tau(plant, near, cost), near, cost)
            if design.bound < (1.0 + _EXCESS) * limit.bound:
                break
    return replace(design, bound_infimum=limit.bound, limit=limit)


@one_thread
def best_tau(plant: AugmentedSystem, multipliers: ArrayLike, cost: str) -> float:
    """Return the tau, s (unit of w)^2, with the least bound at multipliers, or in their limit.

    Above the least tau that has a design, the bound falls and then grows. Where no tau has one,
    `design_smoother` at the result says why.
    """
    search, multipliers = _Search.of(plant, cost), np.asarray(multipliers, dtype=float)

    def log_of(log_tau: float) -> float:
        value = log_tau + log_bound(search.problem, math.exp(log_tau) * multipliers)
        return min(value, _REFUSED - log_tau)  # tau is too small

    ends, options = np.log([1.0 / _LARGEST_TAU, _LARGEST_TAU]), {"xatol": _TAU_TOLERANCE}
    return search.tau * math.exp(minimize_scalar(log_of, bounds=ends, options=options).x)


@dataclass(frozen=True, eq=False)
class _Search:
    """The bound as a function of a point: the logarithms of tau and the positive multipliers."""

    problem: DesignProblem  # in natural units
    tau: float  # the unit of tau, s (unit of w)^2
    levels: np.ndarray  # (k + 3g, q + g, q + g) J'M_iJ
    positive: np.ndarray  # (k + 3g,) which multipliers are

    @classmethod
    def of(cls, plant: AugmentedSystem, cost: str) -> "_Search":
        """Return the bound where all multipliers are positive."""
        if cost == "filtered":
            plant = undelayed(plant)
        units = Units.of(Drift.of(plant).plant.system)
        problem = DesignProblem.of(units.plant(plant), cost)
        levels = plant.J.T @ np.array(plant.M_i) @ plant.J
        return cls(problem, units.time * units.w**2, levels, np.ones(len(levels), dtype=bool))

    def arguments(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return tau and all multipliers."""
        multipliers = np.zeros(len(self.positive))
        multipliers[self.positive] = np.exp(point[1:])
        return math.exp(point[0]), multipliers

    def objective(self, point: np.ndarray) -> float:
        """Return log V at a point, or `_REFUSED` where there is no design."""
        tau, multipliers = self.arguments(point)
        return min(math.log(tau) + log_bound(self.problem, tau * multipliers), _REFUSED)

    def gradient(self, point: np.ndarray) -> np.ndarray:
        """Return the slopes of the objective, zero near points without a design."""
        steps = _STEP * np.eye(len(point))
        low, high = ([self.objective(each) for each in point + side] for side in (-steps, steps))
        return np.where(np.maximum(low, high) < _REFUSED, np.subtract(high, low), 0.0) / (2 * _STEP)

    def slack(self, point: np.ndarray) -> np.ndarray:
        """Return the eigenvalues of I - J'M(lambda)J."""
        return 1.0 - np.linalg.eigvalsh(np.tensordot(self.arguments(point)[1], self.levels, 1))

    def slopes(self, point: np.ndarray) -> np.ndarray:
        """Return the slopes of `slack`, exact: differences fail where eigenvalues cross."""
        _, u = np.linalg.eigh(np.tensordot(self.arguments(point)[1], self.levels, 1))
        change = np.einsum("ij,aik,kj->ja", u, self.levels[self.positive], u)
        return np.hstack([np.zeros((len(u), 1)), -np.exp(point[1:]) * change])

    def natural(self) -> np.ndarray:
        """Return the largest positive multipliers that the constraint allows, else one."""
        sizes = np.linalg.norm(self.levels, 2, axis=(1, 2))[self.positive]
        return 1.0 / np.where(sizes > _ROUNDING, sizes, 1.0)

    def least(self, starts: int) -> tuple[float, float, np.ndarray]:
        """Return the least log V found, tau and the multipliers."""
        found = [self.descent(start, _ROUGH) for start in self.starts(starts)]
        if not found:
            return _REFUSED, 1.0, np.zeros(len(self.positive))
        lowest, best = min(found, key=itemgetter(0))
        for _ in range(_PASSES):  # SLSQP stops where eigenvalues cross
            value, point = self.descent(best, _FINE)
            before, lowest, best = lowest, *min((lowest, best), (value, point), key=itemgetter(0))
            if before - lowest < _TIGHT:
                break
        return lowest, *self.arguments(best)

    def descent(self, point: np.ndarray, options: dict[str, float]) -> tuple[float, np.ndarray]:
        """Return log V and the point on the constraint where SLSQP stops."""
        high = np.log([_LARGEST_TAU, *self.natural()])
        low = np.log([1.0 / _LARGEST_TAU, *_LEAST * self.natural()])
        how = {"method": "SLSQP", "options": options, "jac": self.gradient}
        how |= {"bounds": np.transpose([low, high])}
        how |= {"constraints": {"type": "ineq", "fun": self.slack, "jac": self.slopes}}
        point = np.clip(minimize(self.objective, point, **how).x, low, high)
        largest = math.log(1.0 - self.slack(point).min() or 1.0)
        point = point + largest * np.r_[1.0, -np.ones(len(point) - 1)]  # onto the constraint
        return self.objective(point), point

    def starts(self, count: int) -> list[np.ndarray]:
        """Return the lowest points of a random sample, and one for each channel ignored."""
        rng, k, natural = np.random.default_rng(0), self.problem.k, self.natural()
        of_pairs = np.arange(k, k + len(self.problem.lipschitz))
        channels = np.concatenate([np.arange(k), np.tile(of_pairs, 3)])[self.positive]

        def start(ignored: int | None = None) -> tuple[float, np.ndarray]:
            multipliers = natural * 10.0 ** rng.uniform(-4.0, 0.0, len(natural))
            multipliers[channels == ignored] *= _IGNORED
            point = np.log([1.0, *multipliers])
            point[1:] -= math.log(1.0 - self.slack(point).min() or 1.0)
            points = [np.array([math.log(tau), *point[1:]]) for tau in _TAUS]
            return min(((self.objective(each), each) for each in points), key=itemgetter(0))

        sample = sorted((start() for _ in range(_SAMPLE * count)), key=itemgetter(0))[:count]
        sample += [start(each) for each in range(channels.max() + 1)]
        return [point for value, point in sample if value < _REFUSED]


@np.errstate(all="ignore")
def log_bound(problem: DesignProblem, theta: np.ndarray) -> float:
    """Return log v of a problem in natural units, or infinity where there is no design."""
    with suppress(LinAlgError, InfeasibleDesignError):
        equations = DesignEquations(problem, 1.0, theta)
        Y = stabilising(*equations.equation_Y, _STABILITY_MARGIN)
        spectrum = np.linalg.eigvalsh(Y)
        if spectrum[0] < -conditions.EQUALITY_SLACK * np.abs(spectrum).max():
            return math.inf
        *_, v, _ = equations.solution(stabilising(*equations.equation_X(), _STABILITY_MARGIN), Y)
        if np.isfinite(v):
            return float(np.log(max(v, np.finfo(float).tiny)))
    return math.inf
