r"""The least bound: minimisation of V over tau and lambda.

SciPy's SLSQP minimises :math:`\log V`, whose slopes are differences, under the constraint
:math:`J'M(\lambda)J \le I`. What is known of the minimiser says where it is
sought:

- :math:`V(s\lambda, \tau/s) = V(\lambda, \tau)/s`: the least bound lies on the boundary of the
  constraint, and the step onto it is exact.
- Some multipliers are zero there. Where that makes :math:`M(\lambda)` singular, the least bound is
  an infimum that no design attains: the search is for the limit (`robsmooth.estimators.limit`), and
  its answer is a design next to it. So it is in the paper's example, for both costs, at
  :math:`\lambda = (1, \tfrac12, 0, 0)`. Known zeros are tried, and then those multipliers that are
  small where a search ends.
- V has more than one local minimum, so that there are several starts.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize, minimize_scalar

from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.bound_function import BoundFunction
from robsmooth.estimators.conditions import check_plant, check_stable, multiplier_level, singular
from robsmooth.estimators.limit import limiting_smoother
from robsmooth.estimators.smoother import RobustSmoother, design_smoother
from robsmooth.systems.augmented import AugmentedSystem

VANISHING = 1e-6  # stands for zero beside an infimum, relative to the largest multiplier
_EXCESS = 1e-3  # of a bound beside an infimum; for less of it, smaller multipliers are taken
_ANY_TAU = 1e10  # the best tau is nearer to the natural one than this factor ...
_TAU_TOLERANCE = 1e-7  # ... and found to this, relatively

_SAMPLE = 4  # random multipliers for each start
_TAUS = 10.0 ** np.arange(-1.0, 7.0)  # relative to the natural one
_LEAST, _LARGEST = 1e-12, 1e8  # a multiplier, relative to its natural size; if no noise bounds it
_SMALL = (1e-1, 1e-3, 1e-6)  # multipliers that may be zero, relative to their natural size
_SAME = 1e-9  # bounds that differ by less, relatively
_STEP = 1e-6  # of the differences, in logarithms
_REFUSED = 1e3  # more than the logarithm of any bound
_ROUNDING = 1e-9  # a level of the constraint that is smaller, relatively, is rounding
_OPTIONS = {"ftol": 1e-14, "maxiter": 100}  # of SLSQP
_PASSES = 10  # of it, each from where the one before has stopped
_TIGHT = 1e-11  # a pass that takes less off log V is the last

Found = tuple[float, "RestrictedBound", np.ndarray]  # log V, and the problem and point that have it


@one_thread
def minimize_bound(
    plant: AugmentedSystem, cost: str | None = None, *, starts: int = 4, seed: int = 0
) -> RobustSmoother:
    r"""Design the smoother with the least bound V over :math:`\tau` and :math:`\lambda`.

    Parameters
    ----------
    plant, cost
        As in `design_smoother`; by default the smoothed error's where the plant has a delay.
    starts, seed : int
        Number of starting points, the best of a random sample over decades, and its seed.

    Returns
    -------
    RobustSmoother
        The best design found. Where the bound falls as some multipliers go to zero, so that no
        design attains the least one, they are at most a millionth of the largest, `bound_infimum`
        is the limit of the bound, and `limit` that of the designs; otherwise these two are None.

    Raises
    ------
    InfeasibleDesignError
        Where no design was found.

    See Also
    --------
    design_smoother, best_lag, choose_lag : at given tau and lambda; the delay and the order, too.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.minimize_bound(plant, cost="smoothed")
    >>> round(smoother.mean_square_bound, 4), round(smoother.bound_infimum, 5)
    (0.1399, 0.06994)
    """
    check_plant(plant, "filtered" if cost is None else cost)
    if cost is None:
        cost = "smoothed" if plant.delay > 0.0 else "filtered"
    starts = validation.integer("starts", starts, low=1)
    seed = validation.integer("seed", seed, low=0)
    check_stable(plant)
    problems = []
    for zero in _known_zeros(plant):
        with suppress(InfeasibleDesignError):  # it has no design whatever tau is
            problems.append(RestrictedBound.of(plant, cost, zero))
    found = _descents(problems, starts, seed)
    if not found:
        raise _not_found(problems[0])
    _, problem, point = _reduced(min(found, key=itemgetter(0)), plant, cost)
    tau, multipliers, rates = problem.arguments(point)
    if not rates.any():
        rates = 1.0 * singular(plant, multipliers)
    # scaling lambda up to the constraint, and tau down with it, lowers V by that factor
    level = multiplier_level(plant, multipliers)
    tau, multipliers = tau * problem.v.time * level, multipliers / level
    limit = limiting_smoother(plant, tau, multipliers, cost, rates=rates)
    if not rates.any():  # M(lambda) is positive: it is a design like others
        return limit
    return replace(_design_near(limit, rates), bound_infimum=limit.bound, limit=limit)


@one_thread
def best_tau(plant: AugmentedSystem, multipliers: ArrayLike, cost: str) -> float:
    """Return the tau, s (unit of w)^2, with the least bound at multipliers, or in their limit.

    The bound falls with tau, from the least one that has a design, and then grows. Where no tau has
    a design, the design at this one says why.
    """
    multipliers = np.asarray(multipliers, dtype=float)
    v = BoundFunction.of(plant, cost, multipliers > 0.0)
    return v.time * _best_tau(v, multipliers, v.natural_tau(multipliers))


def _best_tau(v: BoundFunction, multipliers: np.ndarray, guess: float) -> float:
    """Return the same in the unit of `v`, from a guess."""
    rates = 1.0 * (multipliers == 0.0)

    def log_bound(log_tau: float) -> float:
        with suppress(InfeasibleDesignError):
            return log_tau + v(math.exp(log_tau) * multipliers, rates)
        return _REFUSED - log_tau  # tau is too small

    ends = np.log([guess / _ANY_TAU, guess * _ANY_TAU])
    options = {"xatol": _TAU_TOLERANCE}
    return math.exp(minimize_scalar(log_bound, bounds=ends, options=options).x)


@dataclass(frozen=True, eq=False)
class RestrictedBound:
    """The bound where some multipliers are zero, as a function of a point.

    That holds the logarithms of tau, the positive multipliers, and the rates that matter of others.
    """

    v: BoundFunction  # in whose unit of time tau is
    positive: np.ndarray  # (k + 3g,) which multipliers are
    vanishing: np.ndarray  # (k + 3g,) of which the rates matter
    idle: np.ndarray  # (k + 3g,) those of copies that do nothing, as the differences' are zero
    levels: np.ndarray  # (k + 3g, q, q) J'M_iJ
    natural: np.ndarray  # (k + 3g,) the largest multiplier that noise allows, or one of its size
    box: np.ndarray  # (2, length of a point)

    @classmethod
    def of(cls, plant: AugmentedSystem, cost: str, zero: np.ndarray) -> "RestrictedBound":
        """Return the bound where the multipliers are zero that `zero` marks."""
        v, k, g = BoundFunction.of(plant, cost, ~zero), plant.system.k, plant.system.g
        levels = plant.J.T @ np.array(plant.M_i) @ plant.J
        sizes = np.linalg.norm(levels, 2, axis=(1, 2))
        # what a channel brings, of the measurement's noise and of the states' deviations
        effects = np.square(np.vstack([v.problem.B, v.problem.D])).sum(axis=0)
        effects = np.bincount(v.problem.channels, effects)
        effects = np.concatenate([effects[:k], np.tile(effects[k:], 3)])
        free = sizes * effects < _ROUNDING**2  # no noise enters through the channel
        free[k : k + g] = free[k + 2 * g :] = False  # but it does through its copy
        levels[free] = 0.0
        natural = np.where(free, np.where(effects > 0.0, effects, 1.0), 1.0 / (sizes + free))
        vanishing = singular(plant, 1.0 * ~zero) & v.problem.B[:, v.problem.unbounded].any()
        idle = np.concatenate([np.zeros(k + 2 * g, dtype=bool), zero[k : k + g]]) & ~zero
        tau = v.natural_tau(np.where(zero, 0.0, natural))
        largest = np.where(free, _LARGEST, 1.0) * natural
        low = [tau / _ANY_TAU, *_LEAST * natural[~zero], *np.full(vanishing.sum(), _LEAST)]
        high = [tau * _ANY_TAU, *largest[~zero], *np.ones(vanishing.sum())]
        return cls(v, ~zero, vanishing, idle, levels, natural, np.log([low, high]))

    def point(self, tau: float, multipliers: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the point in the box that is next to these arguments."""
        multipliers = np.where(self.idle, self.natural / 2.0, multipliers)
        values = np.array([tau, *multipliers[self.positive], *rates[self.vanishing]])
        return np.clip(np.log(np.maximum(values, np.finfo(float).tiny)), *self.box)

    def arguments(self, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return tau in the unit of `v`, all multipliers, and the proportions of all rates."""
        values = np.exp(point)
        multipliers, rates = np.zeros((2, len(self.positive)))
        multipliers[self.positive], fast = np.split(values[1:], [self.positive.sum()])
        rates[self.vanishing] = fast / (fast.sum() or 1.0)
        return values[0], multipliers, rates

    def log_bound(self, point: np.ndarray) -> float:
        """Return log V."""
        tau, multipliers, rates = self.arguments(point)
        return point[0] + self.v(tau * multipliers, rates)

    def objective(self, point: np.ndarray) -> float:
        """Return the same, or more than any bound where there is no design."""
        with suppress(InfeasibleDesignError):
            return self.log_bound(point)
        return _REFUSED

    def gradient(self, point: np.ndarray) -> np.ndarray:
        """Return the slopes of the objective, zero next to points without a design."""
        ends = [np.clip(point + sign * _STEP * np.eye(len(point)), *self.box) for sign in (-1, 1)]
        low, high = (np.array([self.objective(each) for each in side]) for side in ends)
        run = np.diag(ends[1] - ends[0])
        return np.where(np.maximum(low, high) < _REFUSED, (high - low) / run, 0.0)

    def level(self, multipliers: np.ndarray) -> Matrix:
        """Return J'M(lambda)J."""
        return np.tensordot(multipliers, self.levels, 1)

    def minimum(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return log V at a local minimum, and the minimum, from a feasible point."""
        own = slice(1, 1 + int(self.positive.sum()))  # where in a point the multipliers are

        def slack(point: np.ndarray) -> np.ndarray:
            return 1.0 - np.linalg.eigvalsh(self.level(self.arguments(point)[1]))

        def slopes(point: np.ndarray) -> np.ndarray:
            _, u = np.linalg.eigh(self.level(self.arguments(point)[1]))
            result = np.zeros((len(u), len(point)))
            change = np.einsum("ij,aik,kj->ja", u, self.levels[self.positive], u)
            result[:, own] = -np.exp(point[own]) * change
            return result

        how = {"method": "SLSQP", "options": _OPTIONS, "jac": self.gradient, "bounds": self.box.T}
        how["constraints"] = {"type": "ineq", "fun": slack, "jac": slopes}
        lowest, best = self.objective(point), point
        for _ in range(_PASSES):  # SLSQP stops at the kinks of the eigenvalues, and goes on anew
            found = minimize(self.objective, point, **how)
            point = np.clip(found.x, *self.box)
            largest = 1.0 - slack(point).min()
            if largest > 0.0:  # the step onto the constraint
                point[0] += math.log(largest)
                point[own] -= math.log(largest)
            before, value = lowest, self.objective(point)
            if value < lowest:
                lowest, best = value, point.copy()
            if before - lowest < _TIGHT:
                break
        return lowest, best

    def starts(self, count: int, rng: np.random.Generator) -> list[np.ndarray]:
        """Return feasible points at the constraint, the lowest of a random sample."""
        found = []
        for _ in range(_SAMPLE * count):
            multipliers = self.natural * 10.0 ** rng.uniform(-4.0, 0.0, len(self.natural))
            multipliers[~self.positive] = 0.0
            multipliers /= np.linalg.norm(self.level(multipliers), 2) or 1.0
            natural, lowest = self.v.natural_tau(multipliers), _REFUSED
            for tau in natural * _TAUS:
                point = self.point(tau, multipliers, self.vanishing * 1.0)
                value = self.objective(point)
                if value > lowest:
                    break
                lowest, best = value, point
            if lowest < _REFUSED:
                found.append((lowest, best))
        return [point for _, point in sorted(found, key=itemgetter(0))[:count]]

    def small(self, point: np.ndarray, threshold: float) -> np.ndarray:
        """Return which multipliers are small; a copy's stays where the difference's is zero."""
        k = self.v.problem.k
        small = self.arguments(point)[1] < threshold * self.natural
        difference, own, copy = np.split(small[k:], 3)
        return np.concatenate([small[:k], difference, own, copy & ~difference])


def _known_zeros(plant: AugmentedSystem) -> Iterator[np.ndarray]:
    """Yield zeros to try: none; a channel is ignored; all copies are trusted, or of no use."""
    k, g = plant.system.k, plant.system.g
    yield np.zeros(k + 3 * g, dtype=bool)
    for one in np.eye(k + g, dtype=bool):
        yield np.concatenate([one, one[k:], one[k:]])
    if g:
        yield np.repeat([False, True], [k + g, 2 * g])
        yield np.repeat([False, True, False], [k, g, 2 * g])


def _descents(problems: list[RestrictedBound], starts: int, seed: int) -> list[Found]:
    """Return local minima: several from the first problem, one from each other."""
    rng, counts = np.random.default_rng(seed), [starts] + [1] * len(problems)
    points = [(p, p.starts(count, rng)) for p, count in zip(problems, counts, strict=False)]
    minima = [(problem, problem.minimum(start)) for problem, found in points for start in found]
    return [(value, problem, end) for problem, (value, end) in minima]


def _not_found(problem: RestrictedBound) -> InfeasibleDesignError:
    """Return the error of a search without a feasible start, with the condition at its middle."""
    try:
        problem.log_bound(problem.box.mean(axis=0))
        condition = "A design"
    except InfeasibleDesignError as error:
        condition = error.condition
    detail = (
        "no design was found; with smaller uncertainty outputs or Lipschitz constants there may be "
        "one, and minimax_smoother needs less"
    )
    return InfeasibleDesignError(condition, detail, verb="failed where the search ended")


def _reduced(best: Found, plant: AugmentedSystem, cost: str) -> Found:
    """Return the minimum with multipliers that are small at this one at zero, if it is as low."""
    tried = [~best[1].positive]
    for threshold in _SMALL:
        value, problem, point = best
        zero = problem.small(point, threshold)
        if any((zero == other).all() for other in tried):
            continue
        tried.append(zero)
        with suppress(InfeasibleDesignError):
            reduced = RestrictedBound.of(plant, cost, zero)
            tau, multipliers, rates = problem.arguments(point)
            start = reduced.point(tau, multipliers, np.maximum(multipliers, rates))
            lower, end = reduced.minimum(start)
            if lower < value + _SAME:
                best = lower, reduced, end
    return best


def _design_near(limit: RobustSmoother, rates: np.ndarray) -> RobustSmoother:
    """Return a design next to a limit."""
    plant, design = limit.plant, limit
    v = BoundFunction.of(plant, limit.cost, limit.multipliers + rates > 0.0)
    for fraction in VANISHING * 0.1 ** np.arange(7):
        multipliers = limit.multipliers + fraction * limit.multipliers.max() * rates / rates.max()
        multipliers /= multiplier_level(plant, multipliers)
        tau = _best_tau(v, multipliers, limit.tau / v.time)
        with suppress(InfeasibleDesignError):
            design = design_smoother(plant, v.time * tau, multipliers, limit.cost)
            if design.bound < (1.0 + _EXCESS) * limit.bound:
                break
    return design
