r"""The modes of a system that hardly decay, and the rest.

With :math:`AV = VA_d` for the slow modes and :math:`AV_r = V_rA_r` for the rest,
:math:`x = Vz + V_rz_r`, and :math:`z = Wx,\ z_r = W_rx` are independent. Outputs that do not see
`V` have a stationary covariance even where the slow modes drift or grow.
"""

from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, schur, solve_sylvester
from scipy.linalg.lapack import dgebal

from robsmooth._numerics.lyapunov import balanced_norm, covariances, deviations
from robsmooth._support.validation import Matrix

_GAP = 1e2  # between the decay rates of modes that hardly decay, and of the next
_STANDING = 1e-12  # of the fastest mode's rate: slower decays are rounding
_DECAY = 0.01  # of A's norm, so that all modes decay
_LOST = 1e-6  # how far the products of V and W may be from one and zero
_UNREACHED = 1e-3  # of the noise
_SLOW = 1e-9  # of that rate
_ROUNDING = 1e-13  # of that rate
_NEGLIGIBLE = 1e-9  # of the terms of a matrix product: less is rounding
_UNSEEN = 1e-8  # of an output's size: less is rounding


class Modes(NamedTuple):
    """The slow modes and the rest, in the units of x."""

    V: Matrix  # (n, d) the slow modes
    W: Matrix  # (d, n) with W V = I
    A: Matrix  # (d, d) their drift
    V_rest: Matrix
    W_rest: Matrix
    A_rest: Matrix
    units: Matrix  # (n,) of the states, in which V and W are of order one

    def seen_by(self, rows: Matrix, less: Matrix | None = None) -> np.ndarray:
        """Return which outputs of x see the slow modes; `less` are rows to subtract."""
        size = _UNSEEN * np.linalg.norm(rows * self.units, axis=-1)
        rows = rows if less is None else rows - less
        return ~(np.abs(rows @ self.V).max(axis=-1, initial=0.0) <= size)  # true of NaN


def rates(A: Matrix) -> tuple[float, float]:
    """Return the decay rate of the slowest mode, or minus its growth, and the fastest's rate."""
    poles = np.linalg.eigvals(A)
    return float(-poles.real.max(initial=-np.inf)), float(np.abs(poles).max(initial=0.0))


def is_stable(poles: Matrix) -> bool:
    """Return whether all modes decay, to rounding."""
    return not hardly_decays(poles, _STANDING)


def hardly_decays(poles: Matrix, slow: float = _SLOW) -> bool:
    """Return whether a mode, (n,) or (N, n), decays at less than a `slow` part of the fastest."""
    return bool((-poles.real.max(axis=-1) <= slow * np.abs(poles).max(axis=-1)).any())


def natural_units(A: Matrix, B: Matrix) -> Matrix:
    """Return units of the states: their deviations if A were shifted so that all modes decay."""
    shift = _DECAY * balanced_norm(A) + max(0.0, np.linalg.eigvals(A).real.max())
    balance = dgebal(A, scale=1)[3]
    reached = np.linalg.norm(B / balance[:, None]) or 1.0
    noise = np.hstack([B, np.diag(_UNREACHED * reached * balance)])  # some reaches every state
    return deviations(covariances(A - shift * np.eye(len(A)), noise).stationary)


def separations(A: Matrix, B: Matrix) -> Iterator[Modes]:
    """Yield `modes` for a limit in each wide gap between the decay rates, the highest first."""
    x = natural_units(A, B)
    poles = np.linalg.eigvals(A / x[:, None] * x)
    decays = np.sort(-poles.real)
    decays[decays < _ROUNDING * np.abs(poles).max()] = 0.0
    for faster, slower in pairwise(decays[::-1]):
        if faster > _GAP * slower:
            with suppress(LinAlgError):  # where rounding has split a pair of poles
                yield modes(A, x, faster / 2.0)


def modes(A: Matrix, x: Matrix, limit: float) -> Modes:
    """Return the modes of A that decay by less than a limit, 1/s, and the rest; x are units."""
    T, U, d = schur(A / x[:, None] * x, sort=lambda real, _: -real <= limit)
    first, rest, mixing = T[:d, :d], T[d:, d:], np.zeros((d, len(A) - d))
    if mixing.size:
        mixing = solve_sylvester(first, -rest, -T[:d, d:])
    V, W = x[:, None] * U[:, :d], (U[:, :d] - U[:, d:] @ mixing.T).T / x
    V_rest, W_rest = x[:, None] * (U[:, :d] @ mixing + U[:, d:]), U[:, d:].T / x
    lost = np.abs(W @ V - np.eye(d)).max(initial=0.0)
    if not lost <= _LOST:
        raise LinAlgError("the modes are too close to each other to be told apart")
    return Modes(V, W, first, V_rest, W_rest, rest, x)


def reaches(A: Matrix, B: Matrix, C: Matrix) -> bool:
    """Return whether inputs B of x' = A x + B u have any effect on C x."""
    size = np.abs(B)
    for _ in range(len(A)):
        if (np.abs(C @ B) > _NEGLIGIBLE * (np.abs(C) @ size)).any():
            return True
        largest = size.max(initial=0.0) or 1.0
        B, size = A @ B / largest, np.abs(A) @ size / largest
    return False
