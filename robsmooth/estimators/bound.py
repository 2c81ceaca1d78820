r"""The least bound: minimisation of V over tau and lambda.

The search follows paths of barrier problems (`robsmooth.estimators.bound_search`). It knows of the
structure of the minimiser:

- :math:`V(s\lambda, \tau/s) = V(\lambda, \tau)/s`, so that the least bound lies on the boundary of
  the constraint :math:`M(\lambda)^{-1} \ge JJ'`, and the step onto it is exact.
- Multipliers that fall to zero along a path are zero at its end, and the search goes on with them
  at zero, on a *face*. Where :math:`M(\lambda)` is positive there, the bound is attained. Where it
  is singular, the least bound is an infimum that no design attains: the search goes on with the
  limit itself (`robsmooth.estimators.limit`), and its answer is a design next to it. So it is in
  the paper's example, for both costs: the multipliers of the nonlinearity and of its copy vanish,
  and the others are the largest that are allowed, :math:`\lambda = (1, \tfrac12, 0, 0)`. Then X is
  zero, and a search over :math:`\tau` is all that is left.
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
from scipy.optimize import minimize_scalar

from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.estimators.bound_search import UNBOUNDED, Face, face_where
from robsmooth.estimators.limit import default_rates, limiting_smoother
from robsmooth.estimators.smoother import (
    COSTS,
    MAKE_A_PLANT,
    RobustSmoother,
    check_measurement_noise,
    check_stable_plant,
    design_smoother,
    multiplier_level,
)
from robsmooth.systems.augmented import AugmentedSystem

VANISHING = 1e-6  # stands for zero beside an infimum, relative to the largest multiplier
_CLOSE = 1e-3  # how close to an infimum a design is, if need be with smaller multipliers
_REACH = 3.0  # how far its tau is from that of the search, in natural logarithms
_TINY = 1e-300  # stands for zero in a logarithm
_REFUSED = 1e2  # more than the logarithm of any bound
_COARSE = 10.0 ** -np.arange(1.0, 5.0)  # the barrier's weights mu for every start ...
_MIDDLE = 10.0 ** -np.arange(4.0, 7.0)  # ... for the best, until its zeros show ...
_FINE = 10.0 ** -np.arange(6.0, 12.0)  # ... and to the end
_FALLEN = 0.36  # a multiplier of which less is left as mu falls by ten goes with its root at least
_SAME = 1e-5  # the least difference between the logarithms of two local minima's bounds
_BEHIND = 0.3  # a larger one cannot be made up for on the way that is left
_SAMPLES = 32
_EXTREME = 1e-8  # a multiplier of an extreme start, relative to the others
_TAU_DECADES = np.arange(-2.0, 8.0, 1.0)
_SHRINK = 2.0 ** -np.arange(1.0, 12.0)  # of an uncertainty that is too large
_CONTINUED = 4  # how many designs for it are followed as it grows back ...
_HELD = 1e-2  # ... at which mu ...
_GROWING = 8  # ... with how many iterations for each of its sizes ...
_GROWTH = 1e-3  # ... and the least by which it grows


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
    """
    validation.instance("plant", plant, AugmentedSystem, MAKE_A_PLANT)
    cost = validation.choice("cost", cost, COSTS)
    starts = validation.integer("starts", starts, low=1)
    seed = validation.integer("seed", seed, low=0)
    check_measurement_noise(plant)
    check_stable_plant(plant)
    face = face_where(plant, cost)
    # The start that is lowest need not be the one that leads lowest, nor need half of a path.
    searched, extreme = _starts(plant, face, starts, seed)
    halfway = [face.follow(start, _COARSE)[-1] for start in searched]
    halfway += [face.minimum(start, _COARSE[-1]) for start in extreme]  # a large mu leads away
    ends = [_end(plant, cost, face, point) for point in _different(face, halfway)]
    best, end, beside = min(ends, key=lambda found: found[0].log_bound(found[1])[0])
    tau, multipliers, rates = _arguments(plant, best, end)
    limit = limiting_smoother(plant, tau, multipliers, cost, rates=rates)
    if not rates.any():  # M(lambda) is positive: it is a design like others
        return limit
    design = _beside(limit, rates, face, beside[0])
    return replace(design, bound_infimum=limit.bound, limit=limit)


def _different(face: Face, points: list[np.ndarray]) -> list[np.ndarray]:
    """Return one of each group of points that are the same, if it may still be the best."""
    found: list[tuple[float, np.ndarray]] = []
    values = ((face.log_bound(point)[0], point) for point in points)
    for value, point in sorted(values, key=itemgetter(0)):
        if not found or (value > found[-1][0] + _SAME and value < found[0][0] + _BEHIND):
            found.append((value, point))
    return [point for _, point in found]


def _end(
    plant: AugmentedSystem, cost: str, face: Face, point: np.ndarray
) -> tuple[Face, np.ndarray, np.ndarray]:
    """Return the face that a path ends on, its end, and a point of the path next to that."""
    *_, before, point = face.follow(point, _MIDDLE)
    zero = point[1:] - before[1:] < math.log(_FALLEN)
    if zero.any():
        with suppress(InfeasibleDesignError):
            edge = face_where(plant, cost, zero)
            kept = (point[:1], point[1 + edge.v.active], point[1 + edge.v.vanishing])
            end = edge.follow(np.concatenate(kept), _FINE)[-1]
            if edge.log_bound(end)[0] < face.log_bound(point)[0]:
                return edge, end, point
    return face, face.follow(point, _FINE)[-1], point


def _arguments(
    plant: AugmentedSystem, face: Face, point: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return tau, all multipliers, on the constraint's boundary, and how fast some vanish."""
    tau, active, proportions = face.split(point)
    multipliers, rates = np.zeros((2, len(plant.M_i)))
    multipliers[face.v.active], rates[face.v.vanishing] = active, proportions
    if not rates.any():
        rates = default_rates(plant, multipliers)
    # scaling lambda up to the constraint, and tau down with it, lowers V by that factor
    level = multiplier_level(plant, plant.M(multipliers))
    return tau * face.v.time * level, multipliers / level, rates


def _beside(limit: RobustSmoother, rates: np.ndarray, face: Face, log_tau: float) -> RobustSmoother:
    """Return a design next to a limit, with the best tau that is near a given one."""
    plant, design = limit.plant, limit
    for fraction in VANISHING * 0.1 ** np.arange(7):
        multipliers = limit.multipliers + fraction * limit.multipliers.max() * rates / rates.max()
        multipliers /= multiplier_level(plant, plant.M(multipliers))
        found = minimize_scalar(
            _log_bound, bounds=(log_tau - _REACH, log_tau + _REACH), args=(face, multipliers)
        )
        tau = face.v.time * math.exp(found.x)
        with suppress(InfeasibleDesignError):
            design = design_smoother(plant, tau, multipliers, limit.cost)
            if design.bound < (1.0 + _CLOSE) * limit.bound:
                break
    return design


def _log_bound(log_tau: float, face: Face, multipliers: np.ndarray) -> float:
    """Return log V, or more than any where there is no design."""
    logarithms = np.log(np.maximum(multipliers, _TINY))
    try:
        return face.log_bound(np.concatenate([[log_tau], logarithms]))[0]
    except InfeasibleDesignError:
        return _REFUSED


def _starts(
    plant: AugmentedSystem, face: Face, starts: int, seed: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return feasible points: the best of random ones, and extreme ones.

    Those ignore one uncertainty or nonlinearity each, or trust all copies.
    """
    k, g = plant.system.k, plant.system.g
    rng = np.random.default_rng(seed)
    levels = np.linalg.norm(face.levels[: k + g], 2, axis=(1, 2))
    units = 1.0 / np.where(levels > UNBOUNDED, levels, 1.0)

    def along_tau(shares: np.ndarray, own: np.ndarray) -> list[np.ndarray]:
        multipliers = np.concatenate([units * shares, np.tile((units * shares)[k:], 2) * own])
        multipliers *= 0.5 / np.linalg.norm(np.tensordot(multipliers, face.levels, 1), 2)
        taus = face.v.natural_tau(multipliers) * 10.0**_TAU_DECADES
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
    searched, extreme = _feasible(face, sample)[:starts], _feasible(face, extreme)
    if not searched and not extreme:
        searched = [_by_continuation(face, sample)]
    return searched, extreme


def _feasible(face: Face, sample: list[list[np.ndarray]]) -> list[np.ndarray]:
    """Return the lowest point of each list that has a feasible one, the lowest first."""
    found = []
    for points in sample:
        bounds = [face.objective(point, 0.0)[0] for point in points]
        if math.isfinite(lowest := min(bounds)):
            found.append((lowest, points[bounds.index(lowest)]))
    return [point for _, point in sorted(found, key=itemgetter(0))]


def _by_continuation(face: Face, sample: list[list[np.ndarray]]) -> np.ndarray:
    """Return a feasible point, reached from designs for a smaller uncertainty.

    Raises
    ------
    InfeasibleDesignError
        Where none is found; it says how much smaller.
    """
    reached, last = 0.0, sample[0][0]
    for size in _SHRINK:
        if found := _feasible(face.scaled(size), sample):
            grown = [_grown(face, size, point) for point in found[:_CONTINUED]]
            reached, last = max(grown, key=itemgetter(0))
            break
    try:
        face.log_bound(last)
    except InfeasibleDesignError as error:
        raise InfeasibleDesignError(
            error.condition,
            f"no design was found; the largest uncertainty for which one was is {reached:.3g} of "
            "that given (scale the uncertainty outputs or the Lipschitz constants down)",
        ) from None
    return last


def _grown(face: Face, size: float, point: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the largest size of the uncertainty that a path of designs reaches, and its end."""
    growth = 2.0
    while size < 1.0 and growth > 1.0 + _GROWTH:
        ahead = face.scaled(min(1.0, growth**2 * size))
        if math.isfinite(ahead.objective(point, _HELD)[0]):  # further than the step that follows
            size = min(1.0, growth * size)
            point = face.scaled(size).minimum(point, _HELD, _GROWING)
        else:
            growth = math.sqrt(growth)
    return size, point
