r"""The bound as the search sees it: a function of tau lambda alone.

With :math:`\theta = \tau\lambda`, neither :math:`X` nor :math:`Y/\tau` nor the estimator depends on
:math:`\tau`, and :math:`V = \tau\,v(\theta)`. Here v is half the entropy of the problem's central
H-infinity controller, for channels weighted by :math:`M(\theta)` and :math:`N(\theta)`. In a limit
(`robsmooth.estimators.limit`) the term of x is added. The equations are solved fast and not
certified: the design that a search ends with is, by `design_smoother`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, schur

from robsmooth._numerics.lyapunov import covariances, deviations
from robsmooth._support.validation import Matrix
from robsmooth.estimators.conditions import ASSUMPTION_X, ASSUMPTION_Y, check_nonnegative, refusal
from robsmooth.estimators.equations import DesignEquations
from robsmooth.estimators.problem import DesignProblem
from robsmooth.systems.augmented import AugmentedSystem, undelayed

_STABILITY_MARGIN = 1e-10  # of a Riccati equation's closed loop, relative to its Hamiltonian's norm

_LARGEST = 1e75  # a norm, so that products of four stay within the floats


@dataclass(frozen=True, eq=False)
class BoundFunction:
    """The function v of a plant."""

    problem: DesignProblem  # in units of time, states and measurements that make it of order one
    time: float  # the unit of time, s: tau is in this unit here

    @classmethod
    def of(cls, plant: AugmentedSystem, cost: str, positive: np.ndarray) -> "BoundFunction":
        """Return the function where the multipliers that `positive` marks are not zero."""
        if cost == "filtered":  # which does not see the delay model
            plant = undelayed(plant)
        # each state's deviation, where white noise of order one drives all channels
        inputs = np.hstack([plant.B_p1, plant.B1_tilde])
        x = deviations(covariances(plant.A_p, inputs).stationary)[:, None]
        y = np.linalg.norm(plant.system.D21, axis=1)[:, None]
        time = 1.0 / np.linalg.norm(plant.A_p / x * x.T, 2)
        return cls(DesignProblem.of(plant, cost, positive).in_units(time, x, y), time)

    def natural_tau(self, multipliers: np.ndarray) -> float:
        """Return the tau at which the cost weighs as much as the measurement in the Y equation."""
        equations = DesignEquations(self.problem, 1.0, multipliers, np.zeros_like(multipliers))
        _, _, C2, _ = self.problem.of_Y
        information = np.linalg.norm(C2.T @ np.linalg.solve(equations.E, C2), 2)
        cost = np.linalg.norm(self.problem.C, 2) ** 2
        return float(cost / information) if information > 0.0 < cost else 1.0

    @np.errstate(all="ignore")
    def __call__(self, theta: np.ndarray, rates: np.ndarray) -> float:
        """Return log v; the rates, (k + 3g,), are how fast zeros of theta are approached.

        Raises InfeasibleDesignError where there is no design, or numbers leave the range of floats.
        """
        try:
            v = self._value(theta, rates)
        except LinAlgError as error:
            raise refusal(ASSUMPTION_Y, str(error)) from None
        if not np.isfinite(v):
            raise refusal(ASSUMPTION_Y, "numbers leave the range of floats")
        return float(np.log(max(v, np.finfo(float).tiny)))

    def _value(self, theta: np.ndarray, rates: np.ndarray) -> float:
        """Return v."""
        equations = DesignEquations(self.problem, 1.0, theta, rates)
        Y = _stabilising(ASSUMPTION_Y, *equations.equation_Y)
        spectrum = np.linalg.eigvalsh(Y)
        check_nonnegative(ASSUMPTION_Y, spectrum[0] / (np.abs(spectrum).max() or 1.0))
        X = _stabilising(ASSUMPTION_X, *equations.equation_X())
        *_, v, _ = equations.solution(X, Y)
        if rates.any():
            A, Q, S = equations.equation_of_slope(X)
            v -= 0.5 * float(np.trace(S @ _stabilising(ASSUMPTION_X, A, Q, S)))
        return v


def _stabilising(condition: str, A: Matrix, Q: Matrix, S: Matrix) -> Matrix:
    """Return the stabilising solution of A'X + XA + Q - XSX = 0, which the condition asks for."""
    n = len(A)
    size_Q, size_S = np.linalg.norm(Q), np.linalg.norm(S)
    unit = np.sqrt(size_Q / size_S) if size_Q > 0.0 < size_S else 1.0
    hamiltonian = np.block([[A, -unit * S], [-Q / unit, -A.T]])
    size = np.linalg.norm(hamiltonian)
    if not size < _LARGEST:
        raise refusal(condition, "its coefficients leave the range of floats")
    try:
        form, basis, stable = schur(hamiltonian, sort="lhp")
        X = np.linalg.solve(basis[:n, :n].T, basis[n:, :n].T) * unit
    except (LinAlgError, ValueError) as error:
        raise refusal(condition, str(error)) from None
    rate = -form.diagonal()[:n].max()
    if stable != n or not rate > _STABILITY_MARGIN * size or not np.linalg.norm(X) < _LARGEST:
        raise refusal(condition, "there is no stabilising solution")
    return (X + X.T) / 2
