r"""The estimator whose certified error is the least: by convex optimisation, or by descent.

The programme of `robsmooth.estimators.programme` gives it for plants of a moderate size in which
the copies' outputs drive no state that an uncertainty sees. Elsewhere the certified error of the
best known estimator is made smaller by descent on all its matrices and multipliers; it is then the
least near by. Either way the answer has the certificate of `robsmooth.estimators.certificate`.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, block_diag, null_space, orth

from robsmooth._numerics.lyapunov import covariances
from robsmooth._numerics.riccati import RiccatiError
from robsmooth._support import notation, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix, frozen
from robsmooth.estimators.baselines import fixed_lag_smoother
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.certificate import ConstraintProblem, largest_fraction, least_certificate
from robsmooth.estimators.conditions import check_stable
from robsmooth.estimators.descent import descend
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import matrices, open_loop
from robsmooth.estimators.programme import NoSolution, copies_are_known, least_certified
from robsmooth.estimators.units import Units
from robsmooth.systems.augmented import AugmentedSystem, check_noise
from robsmooth.systems.delay import pade_delay

OUTPUTS = ("smoothed", "filtered")
LARGEST = 20  # states of a plant for the programme: it takes about 10 s there, and 0.1 s for 6
CONDITION = "A finite guarantee"
ROUTES = ("semidefinite programme", "descent")
_LEAST_SEEN = 1e-4  # of an estimate's size, relative to the largest
_ROUNDING = 1e-9  # of a row, relative to others
_ROUNDS = 3  # of descent, each from coordinates balanced anew


@dataclass(frozen=True, eq=False, kw_only=True)
class MinimaxSmoother(Estimator):
    """An estimator with the least certified error.

    Attributes
    ----------
    certified : float
        The mean square error that no admissible uncertainty exceeds, in the squared unit of w. The
        error is that of w-hat against the output of the delay model, or against w ("filtered").
    multipliers : (k + 3g,) array
        theta of the certificate, in the squared unit of w times seconds.
    cost : {"smoothed", "filtered"}
        Which error it is.
    route : {"semidefinite programme", "descent"}
        How it was found: the first is the least over all linear estimators, with copies in the
        limit in which the multipliers of mu and mu-tilde vanish; the second is a local minimum.

    See Also
    --------
    minimax_smoother : makes it.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> rs.minimax_smoother(plant)
    MinimaxSmoother(certified=0.088669, cost='smoothed', delay=3.1e-06 s, order=2)
    """

    certified: float
    multipliers: NDArray[np.float64]
    cost: str
    route: str

    def __post_init__(self) -> None:
        super().__post_init__()
        frozen(self.multipliers)

    @property
    def mean_square_bound(self) -> float:
        """The guarantee: `certified`, by the name that it has for a `RobustSmoother`."""
        return self.certified

    def __repr__(self) -> str:
        return (
            f"MinimaxSmoother(certified={self.certified:.5g}, cost={self.cost!r}, "
            f"delay={self.plant.delay:g} s, order={self.plant.order})"
        )

    def _repr_html_(self) -> str:
        rows = [
            (f"certified {self.cost} error, (unit of $w$)²", self.certified),
            (r"multipliers $\theta$, s (unit of $w$)²", f"${notation.vector(self.multipliers)}$"),
            ("found by", self.route),
        ]
        return self._sheet("Minimax smoother", rows)


@one_thread
def minimax_smoother(plant: AugmentedSystem, output: str = "smoothed") -> MinimaxSmoother:
    """Design the estimator whose certified error is the least.

    Parameters
    ----------
    plant : AugmentedSystem
        Made by `augment`. Noise need not enter through uncertainty channels, and J_21 is not used.
    output : {"smoothed", "filtered"}
        The error: of the smoothed estimate against the delay model's output, or the filtered one.

    Returns
    -------
    MinimaxSmoother
        With its certificate: the Riccati equation of `analysis_bound` was solved for it.

    Raises
    ------
    InfeasibleDesignError
        Where no estimator has a finite guarantee; it says with which fraction of the uncertainty
        one has. Where the plant is not stable, or a measurement has no noise.
    RuntimeError
        Where the solver fails on a problem that has a solution.
    ValueError, TypeError
        For an argument that is not as described.

    See Also
    --------
    minimize_bound : the paper's design, with the least bound V.
    analysis_bound : the certified error of any estimator.

    References
    ----------
    J. C. Geromel, "Optimal linear filtering under parameter uncertainty", IEEE Trans. Signal
    Process. 47(1), 1999.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> round(rs.minimax_smoother(plant).certified, 4)
    0.0887
    """
    hint = "; augment(system, delay, order) makes one"
    validation.instance("plant", plant, AugmentedSystem, hint)
    validation.choice("output", output, OUTPUTS)
    check_noise("A measurement's noise", plant.system.D21)
    check_stable(plant)
    units = Units.of(plant.system)
    natural = units.plant(plant)
    if output == "filtered":  # which does not see the delay model
        natural = AugmentedSystem(natural.system, pade_delay(0.0, 0, plant.system.m), plant.J_21)
    route, found = ROUTES[0], None
    if natural.n <= LARGEST and copies_are_known(natural):
        with suppress(NoSolution, RiccatiError, LinAlgError):
            estimator, theta = least_certified(natural, natural.C_a)
            positive = theta > 0.0
            found = _problem(estimator, positive).at(theta[positive]).mean_square
    if found is None:
        route = ROUTES[1]
        estimator, theta, found = _by_descent(natural)
    estimator = _of_plant(estimator, units.plant(plant), output)
    return MinimaxSmoother(
        **units.restored(estimator, plant),
        certified=units.w**2 * found,
        multipliers=units.w**2 * units.time * theta,
        cost=output,
        route=route,
    )


def certified_error(smoother: MinimaxSmoother) -> float:
    """Return the error that the smoother's multipliers certify, in the squared unit of w."""
    theta = smoother.multipliers
    loop = open_loop(smoother, "guaranteed", "real")
    problem = ConstraintProblem(loop, smoother.plant, theta > 0.0)
    return problem.at(theta[problem.active]).mean_square


def _problem(estimator: Estimator, kept: np.ndarray | None = None) -> ConstraintProblem:
    """Return the loop with the error of w-hat against the delay model's output."""
    plant, none = estimator.plant, np.zeros_like(estimator.C_a)
    loop = replace(
        open_loop(estimator, "filtered", "real"),
        truth=np.hstack([plant.C_a, none]),
        estimate=np.hstack([np.zeros_like(plant.C_a), estimator.C_a]),
    )
    return ConstraintProblem(loop, plant, kept)


def _by_descent(plant: AugmentedSystem) -> tuple[Estimator, np.ndarray, float]:
    """Return a local minimum, with theta and its certified error, from the best candidate.

    Raises
    ------
    InfeasibleDesignError
        Where no candidate has a guarantee for all of the uncertainty.
    """
    fraction, best = 0.0, None
    for candidate in _candidates(plant):
        problem = _problem(candidate)
        reached, theta = largest_fraction(problem)
        fraction = max(fraction, reached)
        if reached == 1.0:
            theta = least_certificate(problem, theta)
            found = problem.at(theta).mean_square
            if best is None or found < best[0]:
                multipliers = problem.all_multipliers(theta)
                multipliers[problem.forbidding] = theta.max(initial=1.0)
                best = found, candidate, multipliers
    if best is None:
        raise InfeasibleDesignError(
            CONDITION,
            "an uncertainty of this size, varying in time, could destabilise the plant, so that no "
            f"estimator has one; {fraction:.3g} of the uncertainty has one (scale its outputs C or "
            "the Lipschitz constants down)",
        )
    found, estimator, theta = best
    for _ in range(_ROUNDS):
        estimator, logarithms, found = descend(estimator, _objective, np.log(theta))
        theta = np.exp(logarithms)
    return estimator, theta, math.exp(found)


def _objective(estimator: Estimator, logarithms: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the logarithm of the certified error, and its gradient."""
    problem, theta = _problem(estimator), np.exp(logarithms)
    certificate = problem.at(theta[problem.active])
    in_theta = np.zeros_like(theta)
    in_theta[problem.active] = certificate.slack * theta[problem.active]
    gradient = np.concatenate([certificate.slopes.of_estimator(estimator), in_theta])
    return math.log(certificate.mean_square), gradient / certificate.mean_square


def _candidates(plant: AugmentedSystem) -> Iterator[Estimator]:
    """Yield classical smoothers, those that the paper's theory gives, and the estimate zero."""
    n, m, g = plant.n, plant.system.m, plant.system.g
    with suppress(InfeasibleDesignError):
        for copies in {False, g > 0}:
            yield _of_w_hat(fixed_lag_smoother(plant.system, plant.delay, plant.order, copies))
    for cost in ("smoothed", "filtered"):
        with suppress(InfeasibleDesignError):
            yield _of_w_hat(minimize_bound(plant, cost))
    zeros = {"B_c": np.zeros((n, plant.system.l + g)), "C_c": np.zeros((m + g, n))}
    none = np.zeros((m, n))
    yield Estimator(plant=plant, A_c=-np.eye(n), C_a=none, C_f=none, **zeros)


def _of_w_hat(estimator: Estimator) -> Estimator:
    """Return an estimator whose w-hat is its smoothed estimate."""
    arguments = estimator.C_c[estimator.plant.system.m :]
    matrices = {name: getattr(estimator, name) for name in ("A_c", "B_c", "C_a")}
    C_c = np.vstack([estimator.C_a, arguments])
    return Estimator(plant=estimator.plant, C_c=C_c, C_f=estimator.C_a, **matrices)


def _of_plant(estimator: Estimator, plant: AugmentedSystem, output: str) -> Estimator:
    """Return the estimator of a plant whose first n states estimate those of the plant.

    A filter is followed by the delay model, so that there is something to smooth with.
    """
    n, m, model, delayed = (
        estimator.plant.n,
        plant.system.m,
        plant.delay_model,
        output == "filtered",
    )
    to_plant = _to_plant_states(estimator)
    back, C_c = np.linalg.inv(to_plant), estimator.C_c
    parts = {"A_c": estimator.A_c, "B_c": estimator.B_c, "C_c": C_c}
    if delayed:
        at = np.r_[:n, len(back) : len(back) + len(model.F), n : len(back)]  # the model's after n
        A_c = np.block(
            [[estimator.A_c, np.zeros((len(back), len(model.F)))], [model.G @ C_c[:m], model.F]]
        )
        B_c = np.pad(estimator.B_c, ((0, len(model.F)), (0, 0)))
        parts = {"A_c": A_c, "B_c": B_c, "C_c": np.pad(C_c, ((0, 0), (0, len(model.F))))}
        to_plant, back = (block_diag(T, np.eye(len(model.F)))[at] for T in (to_plant, back.T))
        back = back.T
    A_c, C_c = to_plant @ parts["A_c"] @ back, parts["C_c"] @ back
    none = np.zeros((m, len(A_c) - plant.n))
    reads = {"C_a": C_c[:m], "C_f": np.hstack([plant.C_p0, none])}
    if delayed:
        reads = {"C_f": C_c[:m], "C_a": np.hstack([plant.C_a, none])}
    return Estimator(plant=plant, A_c=A_c, B_c=to_plant @ parts["B_c"], C_c=C_c, **reads)


def _to_plant_states(estimator: Estimator) -> Matrix:
    """Return coordinates in which C_2 and C_p0 times the first n states are nominal estimates.

    They are those of the measurement to come and of w. The other directions are of no account, and
    make the coordinates as well conditioned as can be. What the copies' outputs do to the plant's
    state, in the states behind the first n, is a part of them.
    """
    plant, n = estimator.plant, estimator.plant.n
    A, B, _, _ = matrices(estimator, "real")
    covariance, own = covariances(A, B).stationary, slice(n, 2 * n)
    estimate = np.linalg.lstsq(covariance[own, own], covariance[own, :n], rcond=None)[0].T
    rows = orth(np.vstack([plant.C2_tilde[: plant.system.l], plant.C_p0]).T, rcond=_ROUNDING).T
    U, sizes, V = np.linalg.svd(rows @ estimate, full_matrices=False)
    size = sizes.max(initial=0.0) or 1.0
    known = U * np.maximum(sizes, _LEAST_SEEN * size) @ V
    to_plant = rows.T @ known + size * null_space(rows) @ null_space(known).T
    more = len(A) - 2 * n
    return np.block([[to_plant, np.eye(n, more)], [np.zeros((more, n)), np.eye(more)]])
