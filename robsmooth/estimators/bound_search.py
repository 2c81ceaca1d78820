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
from robsmooth.estimators.bound_function import Entropy, entropy
from robsmooth.systems.augmented import AugmentedSystem

UNBOUNDED = 1e-8  # a multiplier that no noise bounds may reach the inverse of this
# From the values at three weights, which fall by tens, to the next: a parabola in their root.
_AHEAD = np.linalg.solve(np.vander(10.0 ** np.array([1.5, 1.0, 0.5])).T, np.ones(3))
_LEAST = 0.05  # the least part of a multiplier that this leaves of it
_ITERATIONS = 30
_DECREMENT = 1e-3  # of mu: a Newton step that promises less ends a minimisation
_STRIDE = 2.0  # the longest step, relative or in natural logarithms
_FRACTION = 0.95  # of the way to zero, the longest step of a multiplier
_HALVINGS = 20
_FLAT = 1e-14  # curvatures below this, relative to the largest, are rounding
_DIFFERENCE = 1e-6  # for second derivatives, in natural logarithms


@dataclass(frozen=True, eq=False)
class Face:
    """The bound over the multipliers that are not zero, as a function of logarithms.

    Made by `face_where`. A point holds log tau, the logarithms of the active multipliers, then of
    the rates at which the others vanish, where these matter.

    Attributes
    ----------
    v : Entropy
        The bound as a function of tau lambda, in whose unit of time tau is.
    levels : (a, q, q) array
        J'M_iJ of the active multipliers, with a row more for each of those that no noise bounds.
    """

    v: Entropy
    levels: np.ndarray

    def scaled(self, size: float) -> "Face":
        """Return the bound for uncertainty whose outputs are `size` times as large."""
        return replace(self, v=self.v.scaled(size))

    def split(self, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return tau in the unit of `v`, the active multipliers, and the rates' proportions."""
        values = np.exp(point)
        a = 1 + len(self.v.active)
        rates = values[a:]
        return values[0], values[1:a], rates / rates.sum() if rates.size else rates

    def log_bound(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return log V and its gradient."""
        tau, multipliers, rates = self.split(point)
        value, gradient = self.v(tau * multipliers, rates)
        gradient = gradient * np.concatenate([tau * multipliers, rates])
        along_tau = 1.0 + gradient[: len(multipliers)].sum()
        return point[0] + value, np.concatenate([[along_tau], gradient])

    def barrier(self, point: np.ndarray) -> tuple[float, np.ndarray, Matrix]:
        """Return what keeps the multipliers inside, with its derivatives; infinity outside."""
        _, multipliers, rates = self.split(point)
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

    def curvature(self, point: np.ndarray, mu: float) -> Matrix:
        """Return the second derivatives of `objective`, those of log V by differences."""
        gradient = self.log_bound(point)[1]
        result = np.zeros((len(point), len(point)))
        for i in range(1, len(point)):
            for step in (-_DIFFERENCE, _DIFFERENCE):
                beside = point.copy()
                beside[i] += step
                with suppress(InfeasibleDesignError):
                    result[i] = (self.log_bound(beside)[1] - gradient) / step
                    break
        # tau does what all active multipliers do together
        result[0] = result[1 : 1 + len(self.v.active)].sum(axis=0)
        return (result + result.T) / 2 + mu * self.barrier(point)[2]

    def minimum(self, point: np.ndarray, mu: float, iterations: int = _ITERATIONS) -> np.ndarray:
        """Return a local minimum of `objective`, by Newton's method from a feasible point."""
        multipliers = slice(1, 1 + len(self.v.active))
        value, gradient = self.objective(point, mu)
        for _ in range(iterations):
            # Steps are relative for multipliers, which the constraint is linear in, and of
            # logarithms for the others.
            hessian = self.curvature(point, mu)
            hessian[multipliers, multipliers] -= np.diag(gradient[multipliers])
            curvatures, basis = np.linalg.eigh(hessian)
            # where the function curves down, go down as far as where it curves up
            curvatures = np.maximum(np.abs(curvatures), _FLAT * np.abs(curvatures).max())
            step = -basis @ ((basis.T @ gradient) / curvatures)
            if -gradient @ step < _DECREMENT * mu:
                break
            step *= min(1.0, _STRIDE / np.abs(step).max())
            step *= _FRACTION / max(-step[multipliers].min(), _FRACTION)
            for _ in range(_HALVINGS):
                beside = point + step
                beside[multipliers] = point[multipliers] + np.log1p(step[multipliers])
                trial, slope = self.objective(beside, mu)
                if trial < value + 1e-4 * gradient @ step:
                    break
                step = step / 2
            else:
                break  # as low as rounding lets it
            point, value, gradient = beside, trial, slope
        return point

    def follow(self, point: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
        """Return the minima at weights of the barrier that fall by tens."""
        path: list[np.ndarray] = []
        for mu in weights:
            if len(path) > 2:  # lambda and tau are smooth in the root of mu
                ahead = _AHEAD @ np.exp(path[-3:])
                ahead = np.log(np.maximum(ahead, _LEAST * np.exp(path[-1])))
                if self.objective(ahead, mu)[0] < self.objective(point, mu)[0]:
                    point = ahead
            point = self.minimum(point, mu)
            path.append(point)
        return path


def face_where(plant: AugmentedSystem, cost: str, zero: np.ndarray | None = None) -> Face:
    """Return the bound where the multipliers that `zero` marks are zero."""
    v = entropy(plant, cost, zero)
    levels = np.array([plant.J.T @ plant.M_i[i] @ plant.J for i in v.active])
    free = [i for i, level in enumerate(levels) if not level.any()]
    q = levels.shape[1]
    levels = np.pad(levels, ((0, 0), (0, len(free)), (0, len(free))))
    for row, i in enumerate(free, start=q):
        levels[i, row, row] = UNBOUNDED
    return Face(v, levels)
