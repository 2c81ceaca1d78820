r"""The bound under its constraint, and the path of barrier problems that leads to its minimum.

The constraint :math:`M(\lambda)^{-1} \ge JJ'` is the linear matrix inequality
:math:`I - J'M(\lambda)J \ge 0`. For a falling sequence of :math:`\mu`,

.. math:: \log V - \mu\bigl[\log\det(I - J'M(\lambda)J) + \textstyle\sum_i\log\lambda_i\bigr]

is minimised by Newton's method, with the gradient of `robsmooth.estimators.bound_function`. Its
minimum is within about :math:`\mu` times the number of constraints of one of :math:`\log V`, and
tends to it as a smooth function of :math:`\sqrt\mu`. Multipliers that fall to zero with it do so in
proportion to :math:`\mu`, or to its root: a little of a difference multiplier acts, to first order,
as more of the other two, so that the bound is flat where it vanishes.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.bound_function import BoundFunction, bound_function
from robsmooth.estimators.conditions import singular
from robsmooth.systems.augmented import AugmentedSystem

FREE_LEVEL = 1e-8  # a multiplier that no noise bounds may reach the inverse of this
# From the minima at three weights of the barrier, which fall by tens, to the next: a parabola in
# the root of the weight.
_EXTRAPOLATION = np.linalg.solve(np.vander(10.0 ** np.array([1.5, 1.0, 0.5])).T, np.ones(3))
_LEAST_LEFT = 0.05  # the least part of a multiplier that an extrapolation leaves of it
_ITERATIONS = 30
_DECREMENT = 1e-3  # of mu: a Newton step that promises less ends a minimisation
_LONGEST_STEP = 2.0  # relative or in natural logarithms
_TO_BOUNDARY = 0.95  # the longest step of a multiplier, as a fraction of the way to zero
_SUFFICIENT_DECREASE = 1e-4  # of what a step's slope promises
_HALVINGS = 20
_LEAST_CURVATURE = 1e-14  # relative to the largest: what is below is rounding
_DIFFERENCE = 1e-6  # for second derivatives, in natural logarithms


@dataclass(frozen=True, eq=False)
class BarrierProblem:
    """The bound over the multipliers that are not zero, with a barrier at their constraints.

    Made by `barrier_problem`. A point holds log tau, the logarithms of the positive multipliers,
    then of the rates at which the others vanish, where these matter.

    Attributes
    ----------
    v : BoundFunction
        The bound as a function of tau lambda, in whose unit of time tau is.
    positive, vanishing : (k + 3g,) arrays of bool
        Which multipliers are positive, and which vanish at rates that matter.
    levels : (a, q, q) array
        J'M_iJ of the positive multipliers, with a row more for each of those that no noise bounds.
    """

    v: BoundFunction
    positive: np.ndarray
    vanishing: np.ndarray
    levels: np.ndarray

    def scaled(self, size: float) -> "BarrierProblem":
        """Return the problem for uncertainty whose outputs are `size` times as large."""
        return replace(self, v=self.v.scaled(size))

    def point(self, tau: float, multipliers: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the point of a tau in the unit of `v`, all multipliers and all rates."""
        return np.log([tau, *multipliers[self.positive], *rates[self.vanishing]])

    def arguments(self, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return tau in the unit of `v`, all multipliers, and the proportions of all rates."""
        values = np.exp(point)
        multipliers, rates = np.zeros((2, len(self.positive)))
        multipliers[self.positive], fast = np.split(values[1:], [len(self.levels)])
        if fast.size:
            rates[self.vanishing] = fast / fast.sum()
        return values[0], multipliers, rates

    def log_bound(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return log V and its gradient."""
        tau, multipliers, rates = self.arguments(point)
        value, gradient = self.v(tau * multipliers, rates)
        in_theta, in_rates = gradient * (tau * multipliers, rates)
        slopes = (1.0 + in_theta.sum(), *in_theta[self.positive], *in_rates[self.vanishing])
        return point[0] + value, np.array(slopes)

    def barrier(self, point: np.ndarray) -> tuple[float, np.ndarray, Matrix]:
        """Return what keeps the multipliers inside, with its derivatives; infinity outside."""
        _, multipliers, rates = self.arguments(point)
        multipliers, rates = multipliers[self.positive], rates[self.vanishing]
        weighted = multipliers[:, None, None] * self.levels
        spectrum, basis = np.linalg.eigh(np.eye(self.levels.shape[1]) - weighted.sum(axis=0))
        first, second = np.zeros(len(point)), np.zeros((len(point), len(point)))
        if not spectrum.min() > 0.0:
            return math.inf, first, second
        value = -np.log(spectrum).sum() - np.log(multipliers).sum() - np.log(rates).sum()
        root = basis / np.sqrt(spectrum)
        whitened = root.T @ weighted @ root
        traces = np.einsum("aii->a", whitened)
        a = 1 + len(multipliers)
        first[1:a] = traces - 1.0
        first[a:] = len(rates) * rates - 1.0
        second[1:a, 1:a] = np.einsum("aij,bij->ab", whitened, whitened) + np.diag(traces)
        second[a:, a:] = len(rates) * (np.diag(rates) - np.outer(rates, rates))
        return value, first, second

    def objective(self, point: np.ndarray, mu: float) -> tuple[float, np.ndarray]:
        """Return log V with the barrier of weight mu, and its gradient; infinity outside."""
        value, first, _ = self.barrier(point)
        try:
            log_bound, gradient = self.log_bound(point)
        except InfeasibleDesignError:
            return math.inf, first
        return log_bound + mu * value, gradient + mu * first

    def hessian(self, point: np.ndarray, mu: float, gradient: np.ndarray) -> Matrix:
        """Return the second derivatives of `objective`, whose gradient there is given.

        Those of log V are differences of its gradients.
        """
        _, first, second = self.barrier(point)
        gradient = gradient - mu * first
        result = np.zeros((len(point), len(point)))
        for i in range(1, len(point)):
            for step in (-_DIFFERENCE, _DIFFERENCE):
                trial = point.copy()
                trial[i] += step
                with suppress(InfeasibleDesignError):
                    result[i] = (self.log_bound(trial)[1] - gradient) / step
                    break
        # tau does what all positive multipliers do together
        result[0] = result[1 : 1 + len(self.levels)].sum(axis=0)
        return (result + result.T) / 2 + mu * second

    def minimum(self, point: np.ndarray, mu: float, iterations: int = _ITERATIONS) -> np.ndarray:
        """Return a local minimum of `objective`, by Newton's method from a feasible point."""
        multipliers = slice(1, 1 + len(self.levels))
        value, gradient = self.objective(point, mu)
        for _ in range(iterations):
            # Steps are relative for multipliers, which the constraint is linear in, and of
            # logarithms for the others.
            hessian = self.hessian(point, mu, gradient)
            hessian[multipliers, multipliers] -= np.diag(gradient[multipliers])
            curvatures, basis = np.linalg.eigh(hessian)
            # where the function curves down, go down as far as where it curves up
            curvatures = np.maximum(np.abs(curvatures), _LEAST_CURVATURE * np.abs(curvatures).max())
            step = -basis @ ((basis.T @ gradient) / curvatures)
            if -gradient @ step < _DECREMENT * mu:
                break
            step *= min(1.0, _LONGEST_STEP / np.abs(step).max())
            step *= _TO_BOUNDARY / max(-step[multipliers].min(), _TO_BOUNDARY)
            for _ in range(_HALVINGS):
                trial = point + step
                trial[multipliers] = point[multipliers] + np.log1p(step[multipliers])
                lower, slope = self.objective(trial, mu)
                if lower < value + _SUFFICIENT_DECREASE * gradient @ step:
                    break
                step = step / 2
            else:
                break  # as low as rounding lets it
            point, value, gradient = trial, lower, slope
        return point

    def central_path(self, point: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
        """Return the minima at weights of the barrier that fall by tens."""
        path: list[np.ndarray] = []
        for mu in weights:
            if len(path) > 2:  # lambda and tau are smooth in the root of mu
                ahead = _EXTRAPOLATION @ np.exp(path[-3:])
                ahead = np.log(np.maximum(ahead, _LEAST_LEFT * np.exp(path[-1])))
                if self.objective(ahead, mu)[0] < self.objective(point, mu)[0]:
                    point = ahead
            point = self.minimum(point, mu)
            path.append(point)
        return path


def barrier_problem(
    plant: AugmentedSystem, cost: str, zero: np.ndarray | None = None
) -> BarrierProblem:
    """Return the problem in which the multipliers that `zero` marks are zero."""
    positive = np.ones(len(plant.M_i), dtype=bool) if zero is None else ~zero
    v = bound_function(plant, cost, positive)
    vanishing = singular(plant, positive) & v.problem.B[:, v.problem.unbounded].any()
    levels = plant.J.T @ np.array(plant.M_i)[positive] @ plant.J
    free = [i for i, level in enumerate(levels) if not level.any()]
    q = levels.shape[1]
    levels = np.pad(levels, ((0, 0), (0, len(free)), (0, len(free))))
    for row, i in enumerate(free, start=q):
        levels[i, row, row] = FREE_LEVEL
    return BarrierProblem(v, positive, vanishing, levels)
