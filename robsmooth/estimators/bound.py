r"""The least bound: minimisation of V over tau and lambda.

The search follows paths of barrier problems (`robsmooth.estimators.bound_search`). It knows of the
structure of the minimiser:

- :math:`V(s\lambda, \tau/s) = V(\lambda, \tau)/s`, so that the least bound lies on the boundary of
  the constraint :math:`M(\lambda)^{-1} \ge JJ'`, and the step onto it is exact.
- Multipliers that fall to zero along a path are zero at its end, and the search goes on with them
  at zero. Where :math:`M(\lambda)` is positive there, the bound is attained. Where it is singular,
  the least bound is an infimum that no design attains: the search goes on with the limit itself
  (`robsmooth.estimators.limit`), and its answer is a design next to it. So it is in the paper's
  example, for both costs: the multipliers of the nonlinearity and of its copy vanish, and the
  others are the largest that are allowed, :math:`\lambda = (1, \tfrac12, 0, 0)`. Then X is zero,
  and a search over :math:`\tau` is all that is left.
- Where the copy is of no use, it is the multiplier of the difference that vanishes, and where a
  measurement is, the multiplier of its uncertainty.
- V has more than one local minimum: to ignore the measurement may be one. Several starts are
  followed. Where no start is feasible, the uncertainty is made small until one is, and brought back
  along the way.
"""

import math
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, minimize_scalar

from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.estimators.bound_function import BoundFunction, bound_function
from robsmooth.estimators.bound_search import FREE_LEVEL, BarrierProblem, barrier_problem
from robsmooth.estimators.conditions import check_plant, check_stable, multiplier_level, singular
from robsmooth.estimators.limit import limiting_smoother
from robsmooth.estimators.smoother import RobustSmoother, design_smoother
from robsmooth.systems.augmented import AugmentedSystem

VANISHING = 1e-6  # stands for zero beside an infimum, relative to the largest multiplier
_EXCESS = 1e-3  # of a bound beside an infimum; for less of it, smaller multipliers are taken
_TAU_RANGE = 3.0  # how far tau there is from that of the search, in natural logarithms
_REFUSED = 1e2  # more than the logarithm of any bound

# Weights mu of the barrier: for every start, for the best until its zeros show, and to the end.
_COARSE, _MIDDLE, _FINE = (
    10.0 ** -np.arange(*range) for range in ((1.0, 5.0), (4.0, 7.0), (6.0, 12.0))
)
_GOES_TO_ZERO = (
    0.36  # a multiplier of which less is left as mu falls by ten goes with its root at least
)
_SAME_MINIMUM = 1e-5  # the least difference between the logarithms of two local minima's bounds
_HOPELESS = 0.3  # a larger one to the best is not made up for on the rest of a path

_SAMPLES = 32
_ANY_TAU = math.log(1e8)  # the best tau is closer to the natural one, in natural logarithms ...
_TAU_TOLERANCE = 1e-7  # ... and found to this
_EXTREME = 1e-8  # a multiplier of an extreme start, relative to the others
_TAU_DECADES = np.arange(-2.0, 8.0, 1.0)

# Where no start is feasible, designs for less uncertainty are continued to all of it.
_FRACTIONS = 2.0 ** -np.arange(1.0, 12.0)  # of the uncertainty, to start with
_CONTINUED = 4  # how many of the designs
_CONTINUATION_WEIGHT = 1e-2  # mu
_CONTINUATION_ITERATIONS = 8  # at each fraction
_LEAST_GROWTH = 1e-3  # of the fraction


@one_thread
def minimize_bound(
    plant: AugmentedSystem, cost: str = "filtered", *, starts: int = 4, seed: int = 0
) -> RobustSmoother:
    r"""Design the smoother with the least bound V over :math:`\tau` and :math:`\lambda`.

    Parameters
    ----------
    plant : AugmentedSystem
        Made by `augment`.
    cost : {"filtered", "smoothed"}
        The error that the bound is for, as in `design_smoother`.
    starts : int
        Number of starting points to descend from, the best of a random sample over decades.
    seed : int
        Seed of that sample.

    Returns
    -------
    RobustSmoother
        The best design found. Where the bound falls as some multipliers go to zero, so that no
        design attains the least one, those multipliers are at most `VANISHING` of the largest,
        `bound_infimum` is the limit of the bound, and `limit` that of the designs
        (`limiting_smoother`); otherwise these two are None.

    Raises
    ------
    InfeasibleDesignError
        Where no feasible design was found; it says which condition fails, and up to how much of
        the uncertainty there are designs.

    See Also
    --------
    design_smoother : the design at given tau and lambda.
    best_lag, choose_lag : the delay and the order, too.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.minimize_bound(plant, cost="smoothed")
    >>> round(smoother.mean_square_bound, 4), round(smoother.bound_infimum, 5)
    (0.1399, 0.06994)
    """
    check_plant(plant, cost)
    starts = validation.integer("starts", starts, low=1)
    seed = validation.integer("seed", seed, low=0)
    check_stable(plant)
    problem = barrier_problem(plant, cost)
    # The start that is lowest need not be the one that leads lowest, nor need half of a path.
    searched, extreme = _starts(plant, problem, starts, seed)
    halfway = [problem.central_path(start, _COARSE)[-1] for start in searched]
    halfway += [problem.minimum(start, _COARSE[-1]) for start in extreme]  # a large mu leads away
    ends = [_local_minimum(plant, cost, problem, point) for point in _distinct(problem, halfway)]
    best, end, before = min(ends, key=lambda found: found[0].log_bound(found[1])[0])
    tau, multipliers, rates = best.arguments(end)
    if not rates.any():
        rates = 1.0 * singular(plant, multipliers)
    # scaling lambda up to the constraint, and tau down with it, lowers V by that factor
    level = multiplier_level(plant, multipliers)
    tau, multipliers = tau * problem.v.time * level, multipliers / level
    limit = limiting_smoother(plant, tau, multipliers, cost, rates=rates)
    if not rates.any():  # M(lambda) is positive: it is a design like others
        return limit
    design = _design_beside(limit, rates, problem.v, before[0])
    return replace(design, bound_infimum=limit.bound, limit=limit)


@one_thread
def best_tau(plant: AugmentedSystem, multipliers: ArrayLike, cost: str) -> float:
    """Return the tau with the least bound at given multipliers, in their limit at zeros.

    The bound falls with tau, from the least one that has a design, and then grows: its slope, which
    `minimize_bound` knows, has one zero.

    Parameters
    ----------
    plant, multipliers, cost
        As in `limiting_smoother`.

    Returns
    -------
    float
        In seconds times the squared unit of w. Where no tau has a design, the design at this one
        says why.
    """
    multipliers = np.asarray(multipliers, dtype=float)
    v = bound_function(plant, cost, multipliers > 0.0)
    rates = 1.0 * singular(plant, multipliers)

    def slope(log_tau: float) -> float:
        theta = math.exp(log_tau) * multipliers
        try:
            return 1.0 + float(v(theta, rates)[1][0] @ theta)
        except InfeasibleDesignError:  # tau is too small
            return -1.0

    natural = math.log(v.natural_tau(multipliers))
    low, high = natural - _ANY_TAU, natural + _ANY_TAU
    log_tau = brentq(slope, low, high, xtol=_TAU_TOLERANCE) if slope(high) > 0.0 else high
    return v.time * math.exp(log_tau)


def _distinct(problem: BarrierProblem, points: list[np.ndarray]) -> list[np.ndarray]:
    """Return one of each group of points that are the same, if it may still be the best."""
    found: list[tuple[float, np.ndarray]] = []
    values = ((problem.log_bound(point)[0], point) for point in points)
    for value, point in sorted(values, key=itemgetter(0)):
        if not found or (value > found[-1][0] + _SAME_MINIMUM and value < found[0][0] + _HOPELESS):
            found.append((value, point))
    return [point for _, point in found]


def _local_minimum(
    plant: AugmentedSystem, cost: str, problem: BarrierProblem, point: np.ndarray
) -> tuple[BarrierProblem, np.ndarray, np.ndarray]:
    """Return the end of the path through a point, its problem, and a point before the end.

    Where multipliers go to zero along the path, the problem is that in which they are zero.
    """
    *_, before, point = problem.central_path(point, _MIDDLE)
    zero = point[1:] - before[1:] < math.log(_GOES_TO_ZERO)
    if zero.any():
        with suppress(InfeasibleDesignError):
            reduced = barrier_problem(plant, cost, zero)
            tau, multipliers, _ = problem.arguments(point)
            start = reduced.point(tau, multipliers, rates=multipliers)
            end = reduced.central_path(start, _FINE)[-1]
            if reduced.log_bound(end)[0] < problem.log_bound(point)[0]:
                return reduced, end, point
    return problem, problem.central_path(point, _FINE)[-1], point


def _design_beside(
    limit: RobustSmoother, rates: np.ndarray, v: BoundFunction, log_tau: float
) -> RobustSmoother:
    """Return a design next to a limit, with the best tau that is near a given one."""
    plant, design = limit.plant, limit
    for fraction in VANISHING * 0.1 ** np.arange(7):
        multipliers = limit.multipliers + fraction * limit.multipliers.max() * rates / rates.max()
        multipliers /= multiplier_level(plant, multipliers)
        found = minimize_scalar(
            _log_bound, bounds=(log_tau - _TAU_RANGE, log_tau + _TAU_RANGE), args=(v, multipliers)
        )
        with suppress(InfeasibleDesignError):
            design = design_smoother(plant, v.time * math.exp(found.x), multipliers, limit.cost)
            if design.bound < (1.0 + _EXCESS) * limit.bound:
                break
    return design


def _log_bound(log_tau: float, v: BoundFunction, multipliers: np.ndarray) -> float:
    """Return log V, or more than any where there is no design."""
    try:
        return log_tau + v(math.exp(log_tau) * multipliers, np.zeros_like(multipliers))[0]
    except InfeasibleDesignError:
        return _REFUSED


def _starts(
    plant: AugmentedSystem, problem: BarrierProblem, starts: int, seed: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return feasible points: the best of random ones, and extreme ones.

    Those ignore one uncertainty or nonlinearity each, or trust all copies.
    """
    k, g = plant.system.k, plant.system.g
    rng = np.random.default_rng(seed)
    levels = np.linalg.norm(problem.levels[: k + g], 2, axis=(1, 2))
    units = 1.0 / np.where(levels > FREE_LEVEL, levels, 1.0)

    def along_tau(shares: np.ndarray, own: np.ndarray) -> list[np.ndarray]:
        multipliers = np.concatenate([units * shares, np.tile((units * shares)[k:], 2) * own])
        multipliers *= 0.5 / np.linalg.norm(np.tensordot(multipliers, problem.levels, 1), 2)
        taus = problem.v.natural_tau(multipliers) * 10.0**_TAU_DECADES
        return [np.log([tau, *multipliers]) for tau in taus]

    sample = [
        along_tau(10.0 ** rng.uniform(-4, 0, k + g), 10.0 ** rng.uniform(-8, 1, 2 * g))
        for _ in range(_SAMPLES)
    ]
    extreme = [
        along_tau(np.where(one, _EXTREME, 1.0), np.ones(2 * g)) for one in np.eye(k + g, dtype=bool)
    ]
    if g:
        extreme.append(along_tau(np.ones(k + g), np.full(2 * g, _EXTREME)))
    searched, extreme = _feasible(problem, sample)[:starts], _feasible(problem, extreme)
    if not searched and not extreme:
        searched = [_start_by_continuation(problem, sample)]
    return searched, extreme


def _feasible(problem: BarrierProblem, sample: list[list[np.ndarray]]) -> list[np.ndarray]:
    """Return the lowest point of each list that has a feasible one, the lowest first."""
    found = []
    for points in sample:
        bounds = [problem.objective(point, 0.0)[0] for point in points]
        if math.isfinite(lowest := min(bounds)):
            found.append((lowest, points[bounds.index(lowest)]))
    return [point for _, point in sorted(found, key=itemgetter(0))]


def _start_by_continuation(problem: BarrierProblem, sample: list[list[np.ndarray]]) -> np.ndarray:
    """Return a feasible point, reached from designs for a smaller uncertainty.

    Raises
    ------
    InfeasibleDesignError
        Where none is found; it says how much smaller.
    """
    reached, last = 0.0, sample[0][0]
    for size in _FRACTIONS:
        if found := _feasible(problem.scaled(size), sample):
            grown = [_continued(problem, size, point) for point in found[:_CONTINUED]]
            reached, last = max(grown, key=itemgetter(0))
            break
    try:
        problem.log_bound(last)
    except InfeasibleDesignError as error:
        raise InfeasibleDesignError(
            error.condition,
            f"no design was found; the largest uncertainty for which one was is {reached:.3g} of "
            "that given (scale the uncertainty outputs or the Lipschitz constants down)",
        ) from None
    return last


def _continued(problem: BarrierProblem, size: float, point: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the largest size of the uncertainty that a path of designs reaches, and its end."""
    growth = 2.0
    while size < 1.0 and growth > 1.0 + _LEAST_GROWTH:
        ahead = problem.scaled(min(1.0, growth**2 * size))
        # further than the step that follows
        if math.isfinite(ahead.objective(point, _CONTINUATION_WEIGHT)[0]):
            size = min(1.0, growth * size)
            here = problem.scaled(size)
            point = here.minimum(point, _CONTINUATION_WEIGHT, _CONTINUATION_ITERATIONS)
        else:
            growth = math.sqrt(growth)
    return size, point
