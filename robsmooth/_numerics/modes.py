r"""Modes of a system that hardly decay, apart from the others.

With :math:`AV = VA_d` for the slow modes and :math:`AV_r = V_rA_r` for the rest,
:math:`x = Vz + V_rz_r`, and :math:`z = Wx,\ z_r = W_rx` move independently. Outputs that do not see
`V` have a stationary covariance even where the slow modes drift away, or grow.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import schur, solve_sylvester

from robsmooth._numerics.lyapunov import balanced_norm, covariances, deviations
from robsmooth._support.validation import Matrix

SLOW = 1e-6  # of the fastest rate: modes that decay by less are left out where none sees them
_STANDING = 1e-12  # of that rate: a mode that decays by less does not decay, to rounding
_UNSEEN = 1e-10  # of an output's size: what it shows of a mode then is rounding


@dataclass(frozen=True, eq=False)
class Modes:
    """The slow modes and the rest, in the units of x."""

    V: Matrix  # (n, d) ...
    W: Matrix  # (d, n) ... of the slow modes: W V = I
    A: Matrix  # (d, d) their drift
    V_rest: Matrix
    W_rest: Matrix
    A_rest: Matrix
    units: Matrix  # (n,) of the states: in which V and W are of order one
    standing: bool  # whether some slow mode does not decay

    def seen_by(self, rows: Matrix) -> np.ndarray:
        """Return which of some rows, outputs of x, see the slow modes."""
        seen = np.abs(rows @ self.V).max(axis=-1, initial=0.0)
        return seen > _UNSEEN * np.linalg.norm(rows * self.units, axis=-1)


def rates(A: Matrix) -> tuple[float, float]:
    """Return the decay rate of the slowest mode, which may be negative, and the fastest's rate."""
    poles = np.linalg.eigvals(A)
    return float(-poles.real.max(initial=-np.inf)), float(np.abs(poles).max(initial=0.0))


def is_stable(A: Matrix) -> bool:
    """Return whether all modes decay, to rounding."""
    slowest, fastest = rates(A)
    return slowest > _STANDING * fastest


def hardly_decays(A: Matrix) -> bool:
    """Return whether a mode of A, or of one of (N, n, n), decays by less than `SLOW` has it."""
    poles = np.linalg.eigvals(A)
    return bool((-poles.real.max(axis=-1) < SLOW * np.abs(poles).max(axis=-1)).any())


def natural_units(A: Matrix, B: Matrix) -> Matrix:
    """Return units of the states: what the noise makes of them while little else happens."""
    shift = 2.0 * balanced_norm(A)
    return deviations(covariances(A - shift * np.eye(len(A)), B).stationary)


def modes(A: Matrix, B: Matrix, slow: float = SLOW, rate: float = 0.0) -> Modes:
    """Return the modes of dx = A x dt + B dW that hardly decay, and the rest.

    They decay by less than `slow`, relative to A in natural units or another rate (1/s).
    """
    x = natural_units(A, B)
    A = A / x[:, None] * x
    size = np.linalg.norm(A, 2)
    T, U, d = schur(A, sort=lambda real, _: real >= -slow * max(size, rate))
    first, rest, mixing = T[:d, :d], T[d:, d:], np.zeros((d, len(A) - d))
    if mixing.size:
        mixing = solve_sylvester(first, -rest, -T[:d, d:])
    V, W = x[:, None] * U[:, :d], (U[:, :d] - U[:, d:] @ mixing.T).T / x
    V_rest, W_rest = x[:, None] * (U[:, :d] @ mixing + U[:, d:]), U[:, d:].T / x
    standing = d > 0 and np.linalg.eigvals(first).real.max() >= -_STANDING * size
    return Modes(V, W, first, V_rest, W_rest, rest, x, bool(standing))
