r"""The bound as the search sees it: a function of tau lambda alone, with its gradient.

With :math:`\theta = \tau\lambda`, neither :math:`X` nor :math:`Y/\tau` nor the estimator depends on
:math:`\tau`, and :math:`V = \tau\,v(\theta)`. Here v is half the entropy of the problem's central
H-infinity controller, for channels weighted by :math:`M(\theta)` and :math:`N(\theta)`. In the
notation of `robsmooth.estimators.equations`, with :math:`\tau = 1`, :math:`Z = XT` and
:math:`U = KEK' + B(\Lambda_X^{-1} - \Lambda_Y^{-1})B'`,

.. math:: v = \tfrac12\operatorname{tr}(YR + UZ).

Both Riccati equations hold for every :math:`\theta`, so that their Lagrange multipliers give the
gradient. With :math:`P_Y`, :math:`P_X` from one Lyapunov equation each, and :math:`H = B - KD`, the
channels' way into the estimation error,

.. math::

    \frac{\partial v}{\partial\Lambda_Y} &= C_1(\tfrac12 Y + YP_YY)C_1'
      - \Lambda_Y^{-1}H'(P_Y - \tfrac12 Z)H\Lambda_Y^{-1},\\
    \frac{\partial v}{\partial\Lambda_X} &= C_1P_XC_1'
      - \Lambda_X^{-1}B'(XP_XX + \tfrac12 Z)B\Lambda_X^{-1},

of which the diagonals count. In a limit (`robsmooth.estimators.limit`) the term of x is added, with
the multiplier of its equation. The equations are solved fast and not certified: the design that a
search ends with is, by `design_smoother`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, schur
from scipy.linalg.lapack import dtrsyl

from robsmooth._numerics.lyapunov import covariances
from robsmooth._support.validation import Matrix
from robsmooth.estimators.conditions import ASSUMPTION_X, ASSUMPTION_Y, check_nonnegative, refusal
from robsmooth.estimators.equations import DesignEquations
from robsmooth.estimators.problem import DesignProblem
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.delay import pade_delay

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
            system = plant.system
            plant = AugmentedSystem(system, pade_delay(0.0, 0, system.m), plant.J_21)
        # each state's deviation, where white noise of order one drives all channels
        inputs = np.hstack([plant.B_p1, plant.B1_tilde])
        variances = np.diag(covariances(plant.A_p, inputs).stationary)
        x = np.sqrt(np.where(variances > 0.0, variances, 1.0))[:, None]
        y = np.linalg.norm(plant.system.D21, axis=1)[:, None]
        time = 1.0 / np.linalg.norm(plant.A_p / x * x.T, 2)
        return cls(DesignProblem.of(plant, cost, positive).in_units(time, x, y), time)

    def scaled(self, size: float) -> "BoundFunction":
        """Return the function for uncertainty whose outputs are `size` times as large."""
        return replace(self, problem=self.problem.scaled(size))

    def natural_tau(self, multipliers: np.ndarray) -> float:
        """Return the tau at which the cost weighs as much as the measurement in the Y equation."""
        equations = DesignEquations(self.problem, 1.0, multipliers, np.zeros_like(multipliers))
        _, _, C2, _ = self.problem.of_Y
        information = np.linalg.norm(C2.T @ np.linalg.solve(equations.E, C2), 2)
        cost = np.linalg.norm(self.problem.C, 2) ** 2
        return float(cost / information) if information > 0.0 < cost else 1.0

    @np.errstate(all="ignore")
    def __call__(self, theta: np.ndarray, rates: np.ndarray) -> tuple[float, np.ndarray]:
        """Return log v, and its gradient in theta and in the rates, (2, k + 3g).

        Raises InfeasibleDesignError where there is no design, or numbers leave the range of floats.
        """
        try:
            v, gradient = self._value(theta, rates)
        except LinAlgError as error:
            raise refusal(ASSUMPTION_Y, str(error)) from None
        if not (np.isfinite(v) and np.isfinite(gradient).all()):
            raise refusal(ASSUMPTION_Y, "numbers leave the range of floats")
        v = max(v, np.finfo(float).tiny)
        return float(np.log(v)), gradient / v

    def _value(self, theta: np.ndarray, rates: np.ndarray) -> tuple[float, np.ndarray]:
        """Return v and its gradient."""
        equations = DesignEquations(self.problem, 1.0, theta, rates)
        weights = equations.weights
        Y = _stabilising(ASSUMPTION_Y, *equations.equation_Y)
        spectrum = np.linalg.eigvalsh(Y)
        check_nonnegative(ASSUMPTION_Y, spectrum[0] / (np.abs(spectrum).max() or 1.0))
        X = _stabilising(ASSUMPTION_X, *equations.equation_X())
        K, U, T, v, _ = equations.solution(X, Y)
        A, B_Y, C2, D = self.problem.of_Y
        B, Z = self.problem.B, X @ T

        A_X = self.problem.A + equations.worst_noise @ X
        from_X, on_noise = T @ U @ T.T / 2, Z / 2
        gradient_x = np.zeros_like(weights.rates)
        if rates.any():
            A_x, Q, S = equations.equation_of_slope(X)
            x = _stabilising(ASSUMPTION_X, A_x, Q, S)
            v -= 0.5 * float(np.trace(S @ x))
            P = _lyapunov(A_X - S @ x, -S / 2)
            from_X += equations.worst_noise @ x @ P + P @ x @ equations.worst_noise
            on_noise = on_noise + X @ P @ x + x @ P @ X
            on_noise_x = x / 2 + x @ P @ x
            gradient_x = self._per_weight(P, B * equations.unbounded_noise, on_noise_x)
        P_X = _lyapunov(A_X, from_X)
        half = Z @ K @ C2
        from_Y = (equations.R + half + half.T + Z @ U @ Z) / 2
        P_Y = _lyapunov((A + Y @ equations.R - K @ C2).T, from_Y)
        H = B_Y - K @ D
        gradient_Y = self._per_weight(Y / 2 + Y @ P_Y @ Y, H * equations.noise_Y, P_Y - Z / 2)
        gradient_X = self._per_weight(P_X, B * equations.noise_X, X @ P_X @ X + on_noise)
        in_rates = weights.gradient(np.zeros_like(gradient_x), gradient_x)
        return v, np.array([weights.gradient(gradient_Y, gradient_X), in_rates])

    def _per_weight(self, on_outputs: Matrix, B: Matrix, on_inputs: Matrix) -> np.ndarray:
        """Return diag(C1 F C1') - diag(B' G B), of the F and G given, summed by constraint."""
        problem, C1 = self.problem, self.problem.C1
        count = problem.channels[-1] + 1
        outputs = np.bincount(problem.rows, (C1 @ on_outputs * C1).sum(axis=1), count)
        return outputs - np.bincount(problem.channels, (B * (on_inputs @ B)).sum(axis=0), count)


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


def _lyapunov(A: Matrix, Q: Matrix) -> Matrix:
    """Return the solution of A X + X A' + Q = 0."""
    form, basis = schur(A)
    X, scale, _ = dtrsyl(form, form, -basis.T @ Q @ basis, tranb="T")
    return basis @ (X / scale) @ basis.T
