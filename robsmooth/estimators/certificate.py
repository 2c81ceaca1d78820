"""The certified error: the largest that the constraints on the uncertainty allow a loop.

It is tr B'PB, with the stabilising solution P of the Riccati equation of `docs/source/methods.md`
for multipliers theta, and holds for every admissible uncertainty. It is convex in theta.
"""

import math
import warnings
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, block_diag, null_space
from scipy.optimize import minimize

from robsmooth._numerics.modes import hardly_decays, is_stable, separations
from robsmooth._numerics.riccati import RiccatiError, solve_riccati
from robsmooth._numerics.schur import SchurForm
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.descent import Slopes
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OpenLoop, blocks_of, drifting_output, open_loop
from robsmooth.systems.augmented import AugmentedSystem

_LEAST_START = 1e-6  # of the nominal error: the least contribution of a multiplier at the start
_LEAST_ENERGY = 1e-12  # of an output that no noise excites, relative to the largest it could have
_LARGEST_CHANGE = 14.0  # of a multiplier in one search, in natural logarithms
_INFEASIBLE = 1e2  # the objective, a logarithm, where the Riccati equation has no solution
_RESTARTS = 8
_LEAST_DECREASE = 1e-10  # a search that lowers the bound by less, relatively, is the last
_CONTINUATION_ITERATIONS = 10  # of the search at a fraction of the uncertainty
_MULTIPLES = 4.0 ** np.arange(10)  # of theta
_SMALLEST_STEP = 1e-3  # in the fraction of the uncertainty
_FINISHED = 1e-4  # the gap of a search that has found the minimum
_MARGINS = (0.0, *10.0 ** np.arange(-9.0, -1.0))  # of theta, from the edge of what has a bound
_LEAST_RATIO = 1e-12  # of a multiplier to that before
_NEGLIGIBLE = 1e-7  # of an effect's terms: less is rounding
_LEAST_SHARE = 1e-4  # of a first multiplier: a smaller one next to vanishes
_LEAST_SLOPE = 1e-9  # of the bound, towards that share
NONE = np.empty(0)


class Certificate(NamedTuple):
    """The certified mean square error at one theta, with its gradients and the worst input."""

    mean_square: float
    slack: np.ndarray  # the gradient in theta: the energy that the worst input leaves unused
    feedback: Matrix  # the worst input
    slopes: Slopes


class ConstraintProblem:
    """The constraints of a loop without delay.

    A constraint whose right hand side is zero forbids its input: `free` spans the other inputs, and
    M (between these) and N (between states) are those of the `active` constraints. Constraints that
    are not `kept` have the multiplier zero. Inputs may then be `unbounded`: there is a certificate
    only where they have no effect on the error. Modes that hardly decay are left out where no
    output sees them; the constraint of one nonlinearity or copy may, and is then not kept.
    """

    def __init__(
        self, loop: OpenLoop, plant: AugmentedSystem, kept: np.ndarray | None = None
    ) -> None:
        constraints, inputs = len(plant.M_i), loop.inputs.shape[1]
        kept = np.ones(constraints, dtype=bool) if kept is None else kept
        loop, seen, self.states = _without_drift(loop, plant)
        M = np.reshape(plant.M_i, (constraints, inputs, inputs))
        between_outputs = np.reshape(plant.N_i, (constraints, *[len(loop.outputs)] * 2))
        N = loop.outputs.T @ between_outputs @ loop.outputs
        self.loop, self.A, self.B, self.C = loop, loop.A, loop.B, loop.truth - loop.estimate
        self.forbidding = ~N.any(axis=(1, 2)) & ~seen
        self.active = ~self.forbidding & ~seen & kept
        allowed = null_space(M[self.forbidding].sum(axis=0))
        unbounded = null_space(allowed.T @ M[self.active].sum(axis=0) @ allowed)
        self.free = allowed @ null_space(unbounded.T)
        self.inputs, self.unbounded = loop.inputs @ self.free, loop.inputs @ allowed @ unbounded
        self.M, self.N = self.free.T @ M[self.active] @ self.free, N[self.active]
        self._between_outputs = between_outputs[self.active]

    def at(self, theta: np.ndarray, fraction: float = 1.0) -> Certificate:
        """Certify the error for a fraction of the uncertainty, or raise a RiccatiError."""
        weighted = np.tensordot(theta, self.N, axes=1)
        gain = fraction * np.linalg.solve(np.tensordot(theta, self.M, axes=1), self.inputs.T)
        P = solve_riccati(self.A, self.C.T @ self.C + fraction * weighted, -self.inputs @ gain).X
        through = np.linalg.norm(P @ self.unbounded)
        if through > _NEGLIGIBLE * np.linalg.norm(P) * np.linalg.norm(self.loop.inputs):
            raise RiccatiError("inputs without a bound have an effect on the error")
        feedback = gain @ P
        covariance = SchurForm(self.A + self.inputs @ feedback).lyapunov(self.B @ self.B.T)
        allowed = fraction * np.tensordot(self.N, covariance, axes=2)
        used = np.tensordot(self.M, feedback @ covariance @ feedback.T, axes=2) / fraction
        both, between = 2.0 * P @ covariance, np.tensordot(theta, self._between_outputs, axes=1)
        slopes = Slopes(
            A=both,
            B=2.0 * P @ self.B,
            inputs=both @ (self.free @ feedback).T,
            outputs=2.0 * fraction * between @ self.loop.outputs @ covariance,
            estimate=-2.0 * self.C @ covariance,
        )
        mean_square = float(np.trace(self.B.T @ P @ self.B))
        return Certificate(mean_square, allowed - used, self.free @ feedback, slopes)

    @cached_property
    def initial_multipliers(self) -> np.ndarray:
        """The best theta for a vanishing uncertainty, each constraint by itself."""
        form = SchurForm(self.A)
        P = form.lyapunov(self.C.T @ self.C, transposed=True)
        covariance = form.lyapunov(self.B @ self.B.T)
        largest = np.trace(self.N, axis1=1, axis2=2) * np.trace(covariance)
        allowed = np.maximum(np.tensordot(self.N, covariance, axes=2), _LEAST_ENERGY * largest)
        sensitivity = self.inputs.T @ P
        used = np.tensordot(self.M, sensitivity @ covariance @ sensitivity.T, axes=2)
        nominal = np.tensordot(self.C.T @ self.C, covariance, axes=2)
        return np.sqrt(np.maximum(used, 0.0) / allowed) + _LEAST_START * nominal / allowed

    def all_multipliers(self, theta: np.ndarray) -> np.ndarray:
        """Return theta of all k + 3g constraints: infinite where the input is forbidden."""
        multipliers = np.where(self.forbidding, math.inf, 0.0)
        multipliers[self.active] = theta
        return multipliers

    def gap(self, theta: np.ndarray) -> float:
        """Return the energy that the worst input leaves unused, relative to the error."""
        found = self.at(theta)
        return float(theta @ np.maximum(found.slack, 0.0)) / found.mean_square


def _without_drift(loop: OpenLoop, plant: AugmentedSystem) -> tuple[OpenLoop, np.ndarray, Matrix]:
    """Return the loop without modes that hardly decay, if neither uncertainties nor error see them.

    Also which constraints do, and the states in those of the whole loop, (., N). An
    UnstableLoopError says that an uncertainty sees a mode that does not decay.
    """
    k, g, poles = plant.system.k, plant.system.g, np.linalg.eigvals(loop.A)
    whole, seeing = (loop, np.zeros(k + 3 * g, dtype=bool), np.eye(len(loop.A))), None
    first = len(loop.outputs) - 2 * g
    for found in separations(loop.A, loop.B) if hardly_decays(poles) else ():
        if found.seen_by(loop.truth, loop.estimate).any():
            continue
        sees = found.seen_by(loop.outputs)
        channels = [sees[block.places[0][1]].any() for block in blocks_of(plant)[:k]]
        differences = found.seen_by(loop.outputs[first : first + g], loop.outputs[first + g :])
        seen = np.array([*channels, *differences, *sees[first:]], dtype=bool)
        if not seen[: k + g].any():
            V, W = found.V_rest, found.W_rest
            new = {"A": found.A_rest, "B": W @ loop.B, "inputs": W @ loop.inputs}
            new |= {name: getattr(loop, name) @ V for name in ("outputs", "truth", "estimate")}
            return replace(loop, **new), seen, W
        seeing = seeing or (int(seen.argmax()), found.A)
    if seeing is None or is_stable(poles):
        return whole
    names = [f"uncertainties[{s}]" for s in range(k)]
    names += [f"nonlinearities[{i}], less its copy's," for i in range(g)]
    raise UnstableLoopError(drifting_output(names[seeing[0]], seeing[1]))


def problem_of(estimator: Estimator, kept: np.ndarray | None = None) -> ConstraintProblem:
    """Return the constraints of `model_loop`."""
    return ConstraintProblem(model_loop(estimator), estimator.plant, kept)


def model_loop(estimator: Estimator, loop: str = "real") -> OpenLoop:
    """Return the loop with the error of the smoothed estimate against the delay model's output."""
    truth, estimate = np.vsplit(block_diag(estimator.plant.C_a, estimator.C_a), 2)
    return replace(open_loop(estimator, "filtered", loop), truth=truth, estimate=estimate)


def _largest_fraction(problem: ConstraintProblem, theta: Matrix) -> tuple[float, np.ndarray]:
    """Return the largest fraction of the uncertainty, up to 1, that has a bound, and its theta."""
    if not np.linalg.eigvals(problem.A).real.max() < 0.0:
        return 0.0, NONE
    fraction, step = 0.0, 1.0
    theta = theta[problem.active] if theta.size and theta.all() else problem.initial_multipliers
    while fraction < 1.0 and step > _SMALLEST_STEP:  # each theta is the start of the next
        trial = min(1.0, fraction + step)
        for feasible in np.multiply.outer(_MULTIPLES, theta):
            with suppress(RiccatiError):
                problem.at(feasible, trial)
                break
        else:
            step /= 2.0
            continue
        theta = _quasi_newton(problem, feasible, trial, iterations=_CONTINUATION_ITERATIONS)
        fraction = trial
    if 0.0 < fraction < 1.0:  # where few theta have a bound, none may be near the last one
        found = _by_programme(problem, theta, fraction)
        with suppress(RiccatiError):
            problem.at(found)
            return 1.0, found
    return fraction, theta


def certify(problem: ConstraintProblem, start: Matrix = NONE) -> tuple[float, float, np.ndarray]:
    """Return the least bound, or infinity, the largest fraction with a bound, and its theta.

    The start is the multipliers of all k + 3g constraints, or none.
    """
    fraction, theta = _largest_fraction(problem, start)
    if fraction < 1.0:
        return math.inf, fraction, theta
    before, floor = math.inf, _LEAST_SHARE * problem.initial_multipliers
    for _ in range(_RESTARTS):  # while the search gains
        found, lifted = problem.at(theta), np.maximum(theta, floor)
        if found.mean_square > (1.0 - _LEAST_DECREASE) * before:
            break
        if found.slack @ (lifted - theta) < -_LEAST_SLOPE * found.mean_square:
            with suppress(RiccatiError):  # the search alone stays where a multiplier vanishes
                problem.at(lifted)
                theta = lifted
        before, theta = found.mean_square, _quasi_newton(problem, theta)
    if not problem.gap(theta) < _FINISHED:  # at the edge of what has a bound, near the minimum
        theta = min(theta, _by_programme(problem, theta), key=lambda t: problem.at(t).mean_square)
    return problem.at(theta).mean_square, fraction, theta


def _by_programme(problem: ConstraintProblem, theta: Matrix, fraction: float = 1.0) -> Matrix:
    """Return the best theta by the matrix inequality of the Riccati equation, or the given one."""
    import cvxpy as cp  # it takes long to import

    # the given theta has a bound for the fraction: P is in units of it, and theta relative
    unit, A, B, C = problem.at(theta, fraction).mean_square, problem.A, problem.B, problem.C
    root = np.linalg.inv(np.linalg.cholesky(np.tensordot(theta, problem.M, axes=1)))
    inputs = np.sqrt(unit) * problem.inputs @ root.T
    N = [t / unit * N_i for t, N_i in zip(theta, problem.N, strict=True)]
    M = [t * root @ M_i @ root.T for t, M_i in zip(theta, problem.M, strict=True)]
    P, relative = cp.Variable(A.shape, symmetric=True), cp.Variable(len(theta), nonneg=True)
    known = sum(r * N_i for r, N_i in zip(relative, N, strict=True))
    states = A.T @ P + P @ A + C.T @ C / unit + known
    worst = -sum(r * M_i for r, M_i in zip(relative, M, strict=True))
    inequality = cp.bmat([[states, P @ inputs], [inputs.T @ P, worst]])
    least = cp.Minimize(cp.trace(B.T @ P @ B))
    with warnings.catch_warnings(), suppress(cp.SolverError):
        warnings.simplefilter("ignore")  # the certificate shows the accuracy
        cp.Problem(least, [(inequality + inequality.T) / 2 << 0]).solve(solver=cp.CLARABEL)
    for margin in _MARGINS if relative.value is not None else ():
        with suppress(RiccatiError, LinAlgError):
            found = (1.0 + margin) * np.maximum(relative.value, _LEAST_RATIO) * theta
            problem.at(found)
            return found
    return theta


def _quasi_newton(
    problem: ConstraintProblem, theta: np.ndarray, fraction: float = 1.0, iterations: int = 200
) -> np.ndarray:
    """Return a theta with a lower bound, by a quasi-Newton search over its logarithm."""
    if not theta.size:
        return theta
    best = (math.inf, theta)  # certified

    def objective(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        trial = np.exp(logarithms)
        try:
            point = problem.at(trial, fraction)
        except (RiccatiError, LinAlgError):  # the latter of multipliers that are zero to rounding
            return _INFEASIBLE, np.zeros_like(trial)
        if point.mean_square < best[0]:
            best = point.mean_square, trial
        return math.log(point.mean_square), point.slack * trial / point.mean_square

    start, options = np.log(theta), {"maxiter": iterations, "ftol": 1e-15, "gtol": 1e-7}
    box = list(zip(start - _LARGEST_CHANGE, start + _LARGEST_CHANGE, strict=True))
    minimize(objective, start, jac=True, method="L-BFGS-B", bounds=box, options=options)
    return best[1]
