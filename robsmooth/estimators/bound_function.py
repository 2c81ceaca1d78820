r"""The bound as the search sees it: a function of tau lambda alone, with its gradient.

With :math:`\theta = \tau\lambda`, neither :math:`X` nor :math:`Y/\tau` nor the estimator depends on
:math:`\tau`, and :math:`V = \tau\,v(\theta)`. Here v is half the entropy of the problem's central
H-infinity controller, for channels weighted by :math:`M(\theta)` and :math:`N(\theta)`. With
:math:`\tau = 1`, :math:`K = \tilde B_c`, :math:`Z = X(I - YX)^{-1}` and
:math:`T = (I - YX)^{-1}`,

.. math:: v = \tfrac12\operatorname{tr}(YR + KEK'Z).

Both Riccati equations hold for every :math:`\theta`, so that their multipliers give the gradient:
with :math:`\Lambda_Y`, :math:`\Lambda_X` from one Lyapunov equation each, H the channels' way into
the estimation error, :math:`H = \tilde B_1 - K\tilde D_{21}`, and
:math:`C_k = \tilde C_1 + \tilde D_{12}k` the outputs under the feedback k of the known state,

.. math::

    \frac{\partial v}{\partial\theta_i} =
    \Bigl\langle N_i,\ \tilde C_1(\tfrac12 Y + Y\Lambda_YY)\tilde C_1' + C_k\Lambda_XC_k'
    \Bigr\rangle - \Bigl\langle M_i,\ M^{-1}\bigl[H'(\Lambda_Y - \tfrac12Z)H
      + \tilde B_1'(X\Lambda_XX + \tfrac12 Z)\tilde B_1\bigr]M^{-1}\Bigr\rangle .

Where multipliers vanish, the same is done for the reduced system of `robsmooth.estimators.limit`,
and the term of x is added. Time, states and measurements are brought to units of order one; the
equations are solved fast and not certified: the design that a search ends with is, by
`design_smoother`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, schur, solve_continuous_lyapunov

from robsmooth._support.errors import InfeasibleDesignError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.limit import Reduction, reduction
from robsmooth.estimators.smoother import ASSUMPTION_X, ASSUMPTION_Y, inverse, sum_of_squares
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.delay import pade_delay
from robsmooth.systems.system import Nonlinearity, UncertainSystem, Uncertainty

_NONNEGATIVE = 1e-9  # slack of Y >= 0
_MARGIN = 1e-10  # of stability, relative to the norm of a Hamiltonian
_ORTHOGONAL = 1e-9  # slack of X b = 0


@dataclass(frozen=True, eq=False)
class Entropy:
    """The function v of a plant, on the face where some multipliers are zero.

    Made by `entropy`, in its units of time, states and measurements.

    Attributes
    ----------
    time : float
        The unit of time, s: tau is in this unit here.
    active, vanishing : (a,), (z,) arrays of int
        Which multipliers are positive, and which vanish at rates that matter.
    A, B1, C2, D21 : arrays
        The system that the estimator sees, reduced where M is singular.
    A_p, B_p : arrays
        Its drift and its channels' inputs before that, which the X equation has.
    C, C1, copies : arrays
        Outputs of the cost and of the channels, and how the copies' arguments enter the latter.
    M, N : (a, r, r), (a, h, h) arrays
        The matrices of the active multipliers, on the channels that are left.
    entering, spread : (n, c), (z, c, c) arrays
        How the vanishing channels enter the state, and their M_i.
    N_vanishing : (z, h, h) array
        Their N_i.
    """

    time: float
    active: np.ndarray
    vanishing: np.ndarray
    A: Matrix
    B1: Matrix
    C2: Matrix
    D21: Matrix
    A_p: Matrix
    B_p: Matrix
    C: Matrix
    C1: Matrix
    copies: Matrix
    M: np.ndarray
    N: np.ndarray
    entering: Matrix
    spread: np.ndarray
    N_vanishing: np.ndarray

    def scaled(self, size: float) -> "Entropy":
        """Return the function for uncertainty whose outputs are `size` times as large."""
        return replace(self, N=size**2 * self.N, N_vanishing=size**2 * self.N_vanishing)

    def natural_tau(self, multipliers: np.ndarray) -> float:
        """Return the tau at which the cost weighs as much as the measurement in the Y equation."""
        M_inverse = inverse(np.tensordot(multipliers, self.M, 1))
        E = self.D21 @ M_inverse @ self.D21.T
        information = np.linalg.norm(self.C2.T @ np.linalg.solve(E, self.C2), 2)
        cost = np.linalg.norm(self.C, 2) ** 2
        return float(cost / information) if information > 0.0 < cost else 1.0

    def __call__(self, theta: np.ndarray, rates: np.ndarray) -> tuple[float, np.ndarray]:
        """Return log v and its gradient in theta, then in the rates.

        Raises
        ------
        InfeasibleDesignError
            Where there is no design.
        """
        A, B1, C2, D21, C1 = self.A, self.B1, self.C2, self.D21, self.C1
        identity = np.eye(len(A))
        M_inverse = inverse(np.tensordot(theta, self.M, 1))
        N, N_rates = np.tensordot(theta, self.N, 1), np.tensordot(rates, self.N_vanishing, 1)
        outputs = C1 + self.copies @ self._feedback(N, N_rates)
        R = self.C.T @ self.C + C1.T @ N @ C1
        W, correlation = B1 @ M_inverse @ B1.T, B1 @ M_inverse @ D21.T
        E = D21 @ M_inverse @ D21.T
        gain, information = np.linalg.solve(E, correlation.T), np.linalg.solve(E, C2)

        W_p = self.B_p @ M_inverse @ self.B_p.T
        Y = _stabilising(
            ASSUMPTION_Y,
            (A - correlation @ information).T,
            W - correlation @ gain,
            C2.T @ information - R,
        )
        spectrum = np.linalg.eigvalsh(Y)
        if spectrum[0] < -_NONNEGATIVE * np.abs(spectrum).max():
            raise InfeasibleDesignError(ASSUMPTION_Y, "its solution is not nonnegative definite")
        X = _stabilising(ASSUMPTION_X, self.A_p, sum_of_squares(self.N, theta, outputs), -W_p)
        if not np.abs(np.linalg.eigvals(Y @ X)).max() < 1.0:
            raise InfeasibleDesignError("Assumption 3.3", "rho(YX) is not below tau")
        innovation = Y @ C2.T + correlation
        K = np.linalg.solve(E, innovation.T).T
        T = np.linalg.inv(identity - Y @ X)
        Z, KEK = X @ T, K @ innovation.T
        v = 0.5 * np.trace(Y @ R + KEK @ Z)

        closed_X = self.A_p + W_p @ X
        from_X = T @ KEK @ T.T / 2
        gradient_rates = np.zeros(len(rates))
        into_W = np.zeros_like(X)
        if len(rates):
            x, multiplier, extra, gradient_rates = self._first_order(X, closed_X, outputs, rates)
            v += extra
            product = multiplier @ x
            from_X = from_X + W_p @ product.T + product @ W_p
            into_W = X @ product + product.T @ X
        from_Y = (R + C2.T @ K.T @ Z + Z @ K @ C2 + Z @ KEK @ Z) / 2
        multiplier_Y = _lyapunov((A + Y @ R - K @ C2).T, from_Y)
        multiplier_X = _lyapunov(closed_X, from_X)

        H = B1 - K @ D21
        on_N = C1 @ (Y / 2 + Y @ multiplier_Y @ Y) @ C1.T + outputs @ multiplier_X @ outputs.T
        on_M = H.T @ (multiplier_Y - Z / 2) @ H
        on_M += self.B_p.T @ (X @ multiplier_X @ X + Z / 2 + into_W) @ self.B_p
        gradient = _inner(self.N, on_N) - _inner(self.M, M_inverse @ on_M @ M_inverse)
        v = max(v, np.finfo(float).tiny)
        return float(np.log(v)), np.concatenate([gradient, gradient_rates]) / v

    def _feedback(self, N: Matrix, N_rates: Matrix) -> Matrix:
        """Return the arguments of the copies that minimise the constraints' outputs."""
        on_copies = self.copies.T @ N
        if (none_left := (on_copies @ self.copies).diagonal() == 0.0).any():
            on_copies[none_left] = self.copies.T[none_left] @ N_rates
        weight = (on_copies @ self.copies).diagonal()[:, None]
        wanted = on_copies @ self.C1
        return -np.divide(wanted, weight, out=np.zeros_like(wanted), where=weight > 0.0)

    def _first_order(self, X, closed_X, outputs, rates):
        """Return x, its multiplier, its term of v and that term's gradient in the rates."""
        S_inverse = inverse(np.tensordot(rates, self.spread, 1))
        b = self.entering
        bb = b @ S_inverse @ b.T
        if np.trace(bb @ X) > _ORTHOGONAL * np.sum(np.abs(bb) * np.abs(X)):
            raise InfeasibleDesignError(ASSUMPTION_X, "the bound grows as multipliers vanish")
        x = _stabilising(
            ASSUMPTION_X, closed_X, sum_of_squares(self.N_vanishing, rates, outputs), -bb
        )
        multiplier = _lyapunov(closed_X + bb @ x, bb / 2)
        inner = S_inverse @ b.T @ (x / 2 + x @ multiplier @ x) @ b @ S_inverse
        gradient = _inner(self.N_vanishing, outputs @ multiplier @ outputs.T)
        gradient -= _inner(self.spread, inner)
        return x, multiplier, 0.5 * float(np.trace(bb @ x)), gradient


def entropy(plant: AugmentedSystem, cost: str, zero: np.ndarray | None = None) -> Entropy:
    """Return the function v of a plant, where the multipliers that `zero` marks are zero.

    Raises
    ------
    InfeasibleDesignError
        Where noise without bound would enter the state, and no measurement would tell of it.
    """
    if zero is None:
        zero = np.zeros(len(plant.M_i), dtype=bool)
    plant, time = _natural_units(plant, cost)
    reduced = reduction(plant, ~zero)
    on_kernel = [reduced.kernel.T @ M @ reduced.kernel for M in plant.M_i]
    matters = bool(reduced.entering.any())
    vanishing = [i for i in np.flatnonzero(zero) if matters and on_kernel[i].any()]
    active = np.flatnonzero(~zero)
    rest, C2, D21 = _seen(plant, reduced)
    h, c = len(plant.C1_tilde), reduced.kernel.shape[1]
    return Entropy(
        time=time,
        active=active,
        vanishing=np.array(vanishing, dtype=int),
        A=reduced.A,
        B1=reduced.B1 @ rest,
        C2=C2,
        D21=D21 @ rest,
        A_p=plant.A_p,
        B_p=plant.B1_tilde @ rest,
        C=plant.C_p0 if cost == "filtered" else plant.C_a,
        C1=plant.C1_tilde,
        copies=plant.D12_tilde[:, plant.system.m :],
        M=np.array([rest.T @ plant.M_i[i] @ rest for i in active]),
        N=np.array([plant.N_i[i] for i in active]),
        entering=reduced.entering,
        spread=np.array([on_kernel[i] for i in vanishing]).reshape(len(vanishing), c, c),
        N_vanishing=np.array([plant.N_i[i] for i in vanishing]).reshape(len(vanishing), h, h),
    )


def _seen(plant: AugmentedSystem, reduced: Reduction) -> tuple[Matrix, Matrix, Matrix]:
    """Return a basis of the channels that are left, C2 and D21, so that small numbers do no harm.

    Where both multipliers of a nonlinearity and its copy are small but not zero, their common part
    is large, in both. With their difference and the copy as channels, and without the copy in the
    measurements, large and small numbers are apart.
    """
    if reduced.kernel.size:
        return reduced.rest, reduced.C2, reduced.D21
    l, g = plant.system.l, plant.system.g  # noqa: E741 - the paper's letter
    C2, D21 = plant.C2_tilde, plant.D21_tilde
    channels, measurements = np.eye(D21.shape[1]), np.eye(l + g)
    copies = len(channels) - g  # where they begin, after the nonlinearities
    channels[copies - g : copies, copies:] = np.eye(g)
    measurements[:l, l:] = -D21[:l, copies - g : copies]
    return channels, measurements @ C2, measurements @ D21


def _natural_units(plant: AugmentedSystem, cost: str) -> tuple[AugmentedSystem, float]:
    """Return the plant with time, states and measurements of order one, and its unit of time.

    Without the delay model where the cost does not see it.
    """
    system, model = plant.system, plant.delay_model
    if cost == "filtered":
        model = pade_delay(0.0, 0, system.m)
    time = 1.0 / np.linalg.norm(AugmentedSystem(system, model, plant.J_21).A_p, 2)
    variance = np.diag(solve_continuous_lyapunov(system.A, -system.B1 @ system.B1.T))
    x = np.sqrt(np.where(variance > 0.0, variance, 1.0))[:, None]
    y = np.linalg.norm(system.D21, axis=1)[:, None]
    root = np.sqrt(time)
    return AugmentedSystem(
        UncertainSystem(
            A=time * system.A / x * x.T,
            B1=root * system.B1 / x,
            C0=system.C0 * x.T,
            C2=root * system.C2 / y * x.T,
            D21=system.D21 / y,
            uncertainties=[
                Uncertainty(root * c.B / x, root * c.C * x.T, c.D / y) for c in system.uncertainties
            ],
            nonlinearities=[
                Nonlinearity(root * c.B / x, root * c.C * x.T, c.D / y, c.lipschitz)
                for c in system.nonlinearities
            ],
        ),
        replace(model, F=time * model.F, G=time * model.G, delay=model.delay / time),
        plant.J_21,
    ), time


def _stabilising(condition: str, A: Matrix, Q: Matrix, S: Matrix) -> Matrix:
    """Return the stabilising solution of A'X + XA + Q - XSX = 0, which the condition asks for."""
    n = len(A)
    size_Q, size_S = np.linalg.norm(Q), np.linalg.norm(S)
    unit = np.sqrt(size_Q / size_S) if size_Q > 0.0 < size_S else 1.0
    hamiltonian = np.block([[A, -unit * S], [-Q / unit, -A.T]])
    try:
        form, basis, stable = schur(hamiltonian, sort="lhp")
        if stable != n or form.diagonal()[:n].max() > -_MARGIN * np.linalg.norm(hamiltonian):
            raise InfeasibleDesignError(condition, "there is no stabilising solution")
        X = np.linalg.solve(basis[:n, :n].T, basis[n:, :n].T) * unit
    except (LinAlgError, ValueError) as error:
        raise InfeasibleDesignError(condition, str(error)) from None
    return (X + X.T) / 2


def _lyapunov(A: Matrix, Q: Matrix) -> Matrix:
    """Return the solution of A X + X A' + Q = 0."""
    return solve_continuous_lyapunov(A, -Q)


def _inner(matrices: np.ndarray, weight: Matrix) -> np.ndarray:
    """Return the inner product of each matrix with one."""
    return np.einsum("aij,ij->a", matrices, weight)
