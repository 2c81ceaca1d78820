r"""The estimator whose certified error is the least: by convex optimisation, or by descent.

`robsmooth.estimators.programme` finds it for plants of moderate size in which no uncertainty sees
a state that the copies' outputs drive. Elsewhere a descent on all matrices and multipliers of the
best known estimator ends in a local minimum. `robsmooth.estimators.certificate` certifies both.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.certificate import ConstraintProblem, certify, problem_of
from robsmooth.estimators.conditions import COSTS
from robsmooth.estimators.descent import descend
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import open_loop
from robsmooth.estimators.programme import copies_are_known, least_certified
from robsmooth.estimators.tuned import classical, tuned_fixed_lag_smoother
from robsmooth.estimators.units import Natural, in_plant_states
from robsmooth.systems.augmented import AugmentedSystem

LARGEST = 20  # states of a plant for the programme: it takes about 10 s there, and 0.1 s for 6
ROUTES = ("semidefinite programme", "descent")
_STIFF = 1e3  # between a plant's rates
_LOST = 1e-5  # relative
_ROUNDS = 3  # of descent, each from coordinates balanced anew


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MinimaxSmoother(Estimator):
    """The estimator with the least certified error, as `minimax_smoother` designs it.

    Attributes
    ----------
    certified : float
        Bound on the mean square error for every admissible uncertainty, in the squared unit of w:
        that of w-hat against the output of the delay model, or against w ("filtered").
    multipliers : (k + 3g,) array
        theta of the certificate, in the squared unit of w times seconds.
    cost : {"smoothed", "filtered"}, which error it is
    route : {"semidefinite programme", "descent"}
        The programme finds the least error of all linear estimators, with copies in the limit where
        the multipliers of mu and mu-tilde vanish. The descent finds a local minimum.
    """

    certified: float
    multipliers: NDArray[np.float64]
    cost: str
    route: str

    @property
    def mean_square_bound(self) -> float:
        """The guarantee: `certified`, by the name that it has for a `RobustSmoother`."""
        return self.certified

    @property
    def _figures(self) -> str:
        return f"certified={self.certified:.5g}, cost={self.cost!r}"


@one_thread
def minimax_smoother(plant: AugmentedSystem, output: str = "smoothed") -> MinimaxSmoother:
    """Design the estimator whose certified error is the least.

    Parameters
    ----------
    plant : AugmentedSystem
        Noise need not enter through uncertainty channels. J_21 is not used.
    output : {"smoothed", "filtered"}, which error
        It is that of `analysis_bound` with loop="real", against the plant's own delay model.

    Raises
    ------
    InfeasibleDesignError
        Where no estimator has a guarantee: the message says for which fraction of the uncertainty
        one has. Where a measurement has no noise. Where a mode does not decay and no measurement
        sees it, or an uncertainty does.

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> round(rs.minimax_smoother(plant).certified, 4)
    0.0887
    """
    natural = Natural.of(plant, output)
    route, found = ROUTES[0], None
    if is_convex(natural.plant):
        with suppress(ArithmeticError, LinAlgError):
            estimator, theta = least_certified(natural.plant)
            positive = theta > 0.0
            found = problem_of(estimator, positive).at(theta[positive]).mean_square
            if found > (1.0 + _LOST) * _classical_error(natural):
                found = None  # the solver is inaccurate for rates that are far apart
    if found is None:
        route = ROUTES[1]
        estimator, theta, found = _by_descent(natural)
    units = natural.units
    return MinimaxSmoother(
        **natural.restored(in_plant_states(estimator)),
        certified=units.w**2 * found,
        multipliers=units.w**2 * units.time * theta,
        cost=output,
        route=route,
    )


def _classical_error(natural: Natural) -> float:
    """Return the classical smoother's certified error, or infinity where no rates are far apart."""
    plant = natural.plant
    rates = np.abs(np.linalg.eigvals(plant.A_p))
    if rates.max() < _STIFF * rates.min():
        return math.inf
    return certify(problem_of(classical(plant, plant.system.g > 0), natural.drift.kept))[0]


def is_convex(plant: AugmentedSystem) -> bool:
    """Return whether the semidefinite programme makes the design."""
    return plant.n <= LARGEST and copies_are_known(plant)


def certified_error(smoother: MinimaxSmoother) -> float:
    """Return the error that the smoother's multipliers certify, in the squared unit of w."""
    theta = smoother.multipliers
    loop = open_loop(smoother, "guaranteed", "real")
    problem = ConstraintProblem(loop, smoother.plant, theta > 0.0)
    return problem.at(theta[problem.active]).mean_square


def _by_descent(natural: Natural) -> tuple[Estimator, np.ndarray, float]:
    """Return an estimator by descent from the best candidate, its theta and certified error."""
    fraction, least, best = 0.0, math.inf, None
    kept = natural.drift.kept
    for candidate in _candidates(natural.plant):
        problem = problem_of(candidate, kept)
        found, reached, theta = certify(problem)
        fraction = max(fraction, reached)
        if found < least:
            multipliers = problem.all_multipliers(theta)
            multipliers[problem.forbidding | ~kept] = theta.max(initial=1.0)
            least, best = found, (candidate, multipliers)
    if best is None:
        raise InfeasibleDesignError(
            "A finite guarantee",
            "an uncertainty of this size, varying in time, could destabilise the plant, so that no "
            f"estimator has one; {fraction:.3g} of the uncertainty has one (scale its outputs C or "
            "the Lipschitz constants down)",
        )

    def objective(estimator: Estimator, logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        problem, theta = problem_of(estimator, kept), np.exp(logarithms)
        certificate = problem.at(theta[problem.active])
        in_theta = np.zeros_like(theta)
        in_theta[problem.active] = certificate.slack * theta[problem.active]
        gradient = np.concatenate([certificate.slopes.of_estimator(estimator), in_theta])
        return math.log(certificate.mean_square), gradient / certificate.mean_square

    estimator, theta = best
    for _ in range(_ROUNDS):
        trial, logarithms, found = descend(estimator, objective, np.log(theta))
        if found > math.log(least):
            break  # in new coordinates, rounding can take the certificate
        estimator, theta, least = trial, np.exp(logarithms), math.exp(found)
    return estimator, np.where(kept, theta, 0.0), least


def _candidates(plant: AugmentedSystem) -> Iterator[Estimator]:
    """Yield the classical smoothers, the tuned one, the paper's designs, and the estimate zero."""
    n, m, g = plant.n, plant.system.m, plant.system.g
    with suppress(InfeasibleDesignError):
        for copies in sorted({False, g > 0}):
            yield classical(plant, copies)
        yield tuned_fixed_lag_smoother(plant, "admissible")
    for cost in COSTS:
        with suppress(InfeasibleDesignError):
            yield minimize_bound(plant, cost, starts=1)
    zeros = {"B_c": np.zeros((n, plant.system.l + g)), "C_c": np.zeros((m + g, n))}
    none = np.zeros((m, n))
    yield Estimator(plant=plant, A_c=-np.eye(n), C_a=none, C_f=none, **zeros)
