r"""The least bound: minimisation of V over tau and lambda.

Sequential quadratic programming from several starts, under the constraint
:math:`M(\lambda)^{-1} \ge JJ'`, which is the linear matrix inequality
:math:`I - J'M(\lambda)J \ge 0`. V has more than one local minimum: where noise is strong, ignoring
the measurement is one. Two facts about V help:

- :math:`V(s\lambda, \tau/s) = V(\lambda, \tau)/s`, so that the least bound lies on the boundary of
  the constraint, and a step onto it is exact;
- V often falls all the way to the edge where the multipliers of a nonlinearity and of its copy
  vanish. There M is singular: the least bound is an infimum that no design attains. The search
  keeps every multiplier at or above a stated small fraction of the largest, `VANISHING`. Where some
  end at that fraction, it extrapolates the bound to zero, by a power of the fraction.
"""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from robsmooth import validation
from robsmooth.augmented import AugmentedSystem
from robsmooth.blas import one_thread
from robsmooth.errors import InfeasibleDesignError
from robsmooth.smoother import (
    COSTS,
    RobustSmoother,
    check_measurement_noise,
    check_stable_plant,
    design_equations,
    design_smoother,
    multiplier_level,
)

VANISHING = 1e-6  # stands for zero, relative to the largest multiplier
_CANDIDATE = 1e-2  # a multiplier found below this may be on its way to zero
_REFUSED = 1e2  # the objective, a logarithm, where there is no design
_REACH = 10.0  # how far from its start the search may go, in natural logarithms
_ROUNDS = 5  # of quadratic programming, each in units of its start
_PROGRESS = 1e-7  # a round that lowers the bound by less, relatively, is the last
_TAU_REACH = 3.0  # how far tau may move as multipliers vanish, in natural logarithms
_SAMPLES = 32
_TAU_DECADES = np.arange(-2.0, 8.0, 1.0)


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
        design attains the least one, those multipliers are `VANISHING` of the largest and
        `bound_infimum` is the limit; otherwise `bound_infimum` is None.

    Raises
    ------
    InfeasibleDesignError
        Where no feasible design was found; it names the condition that failed most often.
    """
    validation.instance("plant", plant, AugmentedSystem)
    cost = validation.choice("cost", cost, COSTS)
    starts = validation.integer("starts", starts, low=1)
    seed = validation.integer("seed", seed, low=0)
    check_measurement_noise(plant)
    check_stable_plant(plant)
    points = _starting_points(plant, cost, starts, seed)
    # The start that is lowest need not be the one that leads lowest.
    polished = [_polish(plant, cost, point) for point in points]
    best = _try_edge(plant, cost, min(polished, key=lambda point: _objective(plant, cost, point)))
    design = design_smoother(plant, *_split(best), cost)
    return replace(design, bound_infimum=_infimum(plant, cost, best))


def _split(point: np.ndarray) -> tuple[float, np.ndarray]:
    """Return tau and lambda from a point of the search, which holds log tau and lambda."""
    return math.exp(point[0]), point[1:]


def _onto_boundary(plant: AugmentedSystem, point: np.ndarray) -> np.ndarray:
    """Scale lambda up to the constraint and tau down with it, which lowers V by that factor."""
    level = multiplier_level(plant, plant.M(point[1:]))
    return np.concatenate([point[:1] + math.log(level), point[1:] / level])


def _try_bound(plant: AugmentedSystem, cost: str, point: np.ndarray) -> float:
    """Return V at a point, or infinity where there is no design."""
    try:
        return design_smoother(plant, *_split(point), cost).bound
    except InfeasibleDesignError:
        return math.inf


def _objective(plant: AugmentedSystem, cost: str, point: np.ndarray) -> float:
    bound = _try_bound(plant, cost, point)
    return math.log(bound) if math.isfinite(bound) else _REFUSED


def _gap(plant: AugmentedSystem, point: np.ndarray) -> np.ndarray:
    """Return I - J'M(lambda)J, which the constraint wants nonnegative definite."""
    return np.eye(plant.J.shape[1]) - plant.J.T @ plant.M(point[1:]) @ plant.J


def _box(point: np.ndarray) -> list[tuple[float, float]]:
    """Return the bounds of a search from a point: no multiplier below `VANISHING`."""
    largest = point[1:].max()
    tau = (point[0] - _REACH, point[0] + _REACH)
    return [tau, *((min(VANISHING * largest, value), 10.0 * largest) for value in point[1:])]


def _starting_points(plant: AugmentedSystem, cost: str, starts: int, seed: int) -> list[np.ndarray]:
    """Return the best feasible points of a random sample of multipliers and a grid of tau."""
    k, g = plant.system.k, plant.system.g
    rng = np.random.default_rng(seed)
    found: list[tuple[float, np.ndarray]] = []
    failures: Counter[str] = Counter()
    for _ in range(_SAMPLES):
        exponents = np.concatenate([rng.uniform(-4, 0, k + g), rng.uniform(-6, -1, 2 * g)])
        multipliers = 10.0**exponents
        multipliers *= 0.5 / multiplier_level(plant, plant.M(multipliers))
        unit = _natural_tau(plant, cost, multipliers)
        along = []
        for tau in unit * 10.0**_TAU_DECADES:
            try:
                bound = design_smoother(plant, tau, multipliers, cost).bound
            except InfeasibleDesignError as error:
                failures[error.condition] += 1
                continue
            along.append((bound, np.array([math.log(tau), *multipliers])))
        if along:
            found.append(min(along, key=lambda entry: entry[0]))
    if not found:
        condition, times = failures.most_common(1)[0]
        raise InfeasibleDesignError(
            condition,
            f"no design was found at any of {failures.total()} values of tau and lambda, and this "
            f"condition failed at {times} of them; the uncertainty may be too large (scale the "
            "uncertainty outputs or Lipschitz constants down)",
        )
    found.sort(key=lambda entry: entry[0])
    return [point for _, point in found[:starts]]


def _natural_tau(plant: AugmentedSystem, cost: str, multipliers: np.ndarray) -> float:
    """Return the tau at which the cost weighs as much as the measurement in the Y equation."""
    equations = design_equations(plant, 1.0, multipliers, cost)
    C2 = plant.C2_tilde
    information = np.linalg.norm(C2.T @ np.linalg.solve(equations.E, C2), 2)
    return float(np.linalg.norm(plant.C_p0, 2) ** 2 / information) if information > 0.0 else 1.0


def _polish(plant: AugmentedSystem, cost: str, point: np.ndarray) -> np.ndarray:
    """Minimise log V under the constraint itself."""
    point = _onto_boundary(plant, point)
    for _ in range(_ROUNDS):
        before = _objective(plant, cost, point)
        point = _quadratic_programming(plant, cost, point)
        if _objective(plant, cost, point) > before - _PROGRESS:
            break
    return _best_tau(plant, cost, point)


def _quadratic_programming(plant: AugmentedSystem, cost: str, point: np.ndarray) -> np.ndarray:
    """Return a point on the boundary with a lower bound, or the same point."""
    units = np.ones(point.size)  # tau is a logarithm; multipliers may span decades
    units[1:] = np.maximum(point[1:], _CANDIDATE * point[1:].max())

    def at(steps: np.ndarray) -> np.ndarray:
        return point + steps * units

    def objective(steps: np.ndarray) -> float:
        trial = at(steps)  # it steps outside the constraint now and then: judge it on the boundary
        if np.linalg.eigvalsh(_gap(plant, trial)).min() < 0.0:
            trial = _onto_boundary(plant, trial)
        return _objective(plant, cost, trial)

    box = (np.array(_box(point)) - point[:, None]) / units[:, None]
    result = minimize(
        objective,
        np.zeros(point.size),
        method="SLSQP",
        jac="3-point",
        bounds=box,
        constraints={"type": "ineq", "fun": lambda v: np.linalg.eigvalsh(_gap(plant, at(v)))},
        options={"ftol": 1e-10, "maxiter": 60},
    )
    found = at(result.x)
    found[1:] = np.maximum(found[1:], VANISHING * found[1:].max())
    found = _onto_boundary(plant, found)
    return found if _objective(plant, cost, found) < _objective(plant, cost, point) else point


def _try_edge(plant: AugmentedSystem, cost: str, point: np.ndarray) -> np.ndarray:
    """Return a better point with the small multipliers put to `VANISHING`, or the same point."""
    largest = point[1:].max()
    small = np.flatnonzero(point[1:] < _CANDIDATE * largest) + 1
    edge = point.copy()
    edge[small] = VANISHING * largest
    edge = _polish(plant, cost, edge)
    return edge if _objective(plant, cost, edge) < _objective(plant, cost, point) else point


def _infimum(plant: AugmentedSystem, cost: str, point: np.ndarray) -> float | None:
    """Return the limit of the bound as the multipliers at `VANISHING` go to zero.

    None where there are none, or where the bound does not fall towards zero.
    """
    largest = point[1:].max()
    vanishing = np.flatnonzero(point[1:] < 2 * VANISHING * largest) + 1
    if not vanishing.size:
        return None
    bounds = []
    for fraction in (1e-2 * VANISHING, 1e-1 * VANISHING, VANISHING):
        beside = point.copy()
        beside[vanishing] = fraction * largest
        # the others are at their best already, but for a change in proportion to the fraction
        beside = _best_tau(plant, cost, _onto_boundary(plant, beside), reach=_TAU_REACH)
        bounds.append(_try_bound(plant, cost, beside))
    first, second = np.diff(bounds)
    if not second > 0.0:
        return None
    below = first**2 / (second - first) if 0.0 < first < second else 0.0  # else it is rounding
    return float(bounds[0] - below)


def _best_tau(
    plant: AugmentedSystem, cost: str, point: np.ndarray, reach: float = 0.1
) -> np.ndarray:
    """Minimise over log tau alone, to more digits than a search over everything gives."""

    def at(log_tau: float) -> np.ndarray:
        return np.concatenate([[log_tau], point[1:]])

    result = minimize_scalar(
        lambda log_tau: _objective(plant, cost, at(log_tau)),
        bounds=(point[0] - reach, point[0] + reach),
        method="bounded",
        options={"xatol": 1e-9},
    )
    found = at(result.x)
    return found if _objective(plant, cost, found) < _objective(plant, cost, point) else point
