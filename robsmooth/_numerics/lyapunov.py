r"""Covariances of linear stochastic systems, and their roots, by doubling of time.

For :math:`dx = A x\,dt + B\,dW`, started at zero, :math:`W(2t) = W(t) + E(t)\,W(t)\,E(t)'` is the
covariance and `E` the transition matrix. Slow modes keep their digits, as :math:`F = E - I` is
doubled: :math:`F(2t) = 2F + F^2` (`docs/source/numerics.md`).
"""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgebal

from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix

ERROR_TOLERANCE = 1e-6
_FIRST_STEP = 1 / 4  # times the norm of A
_TERMS = 15  # of a series in steps of that size, to all digits
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(_TERMS)  # exact for the square of the series
_DOUBLINGS = 60  # for time constants up to 2^60 apart
_FORGOTTEN = 1e-6  # the share of a state that is left: its square is rounding
_SETTLED = 1e-12  # the share of a variance that an increment is: the next one is its square


class Covariances(NamedTuple):
    """Covariances of the state of dx = A x dt + B dW; all are (..., n, n)."""

    stationary: Matrix  # P, the limit of W
    grown: Matrix  # W, a span of time after the state was known
    transition: Matrix  # E over the span
    error: Matrix  # estimated, of P: what one step of refinement would change


def covariances(A: Matrix, B: Matrix, span: float = 0.0) -> Covariances:
    """Return P of a stable A (..., n, n) and B (..., n, q) or (n, q), and W and E after a span, s.

    An UnstableLoopError says that the system, to rounding, is not stable.
    """
    P, grown, transition, first, transitions = _settled(A, B, span, root=False)
    half = A @ P  # the error is roughly the solution for the residual of P
    error = (half + half.mT + _squared(B)) * first
    for E in transitions:
        error = error + E @ error @ E.mT
    return Covariances(P, grown, transition, error)


def stationary_root(A: Matrix, B: Matrix) -> Matrix:
    """Return the root of `covariances`' P, in the form that `noise_root` has."""
    return _with_signs(_settled(A, B, 0.0, root=True)[0])


def noise_root(A: Matrix, B: Matrix, span: float) -> Matrix:
    r"""Return R with :math:`RR' = W = \int_0^t e^{As}BB'e^{A's}\,ds` for a span t > 0 and any A.

    R is lower triangular and has no negative entry on its diagonal.
    """
    first, doublings = _first_step(A, span)
    steps = itertools.islice(_doubled(A, B, first, root=True), max(doublings, 0), None)
    return _with_signs(next(steps)[0])


def check_certainty(what: str, P: Matrix, error: Matrix) -> None:
    """Raise an ArithmeticError where the estimated error is too large a part of a variance."""
    variances, errors = np.linalg.diagonal(P), np.abs(np.linalg.diagonal(error))
    lost = ~(errors <= ERROR_TOLERANCE * variances)
    if lost.any():
        variance, error = variances[lost][0], errors[lost][0]
        found = f"a variance of {variance:.2g} has an estimated error of {error:.2g}"
        raise ArithmeticError(f"{what} is lost in rounding: {found}")


def deviations(P: Matrix) -> Matrix:
    """Return the states' standard deviations, one in the place of zero."""
    variances = np.diag(P)
    return np.sqrt(np.where(variances > 0.0, variances, 1.0))


def square_root(P: Matrix) -> Matrix:
    """Return an L with P = L L', of an (n, n) covariance; no digit depends on its units."""
    units = deviations(P)
    weights, directions = np.linalg.eigh(P / np.outer(units, units))
    return units[:, None] * directions * np.sqrt(np.maximum(weights, 0.0))


def _settled(A: Matrix, B: Matrix, span: float, root: bool) -> tuple:
    """Return P, W and E after the span, the first step and all E; roots of P and W if so asked."""
    first, doublings = _first_step(A, span)
    grown, transition = np.zeros_like(A), np.broadcast_to(np.eye(A.shape[-1]), A.shape)
    transitions = []
    with np.errstate(over="ignore", invalid="ignore"):  # of an unstable system
        steps = itertools.islice(_doubled(A, B, first, root), abs(doublings) + _DOUBLINGS)
        for count, (W, E, moved) in enumerate(steps):
            transitions.append(E)
            if span > 0.0 and count == max(doublings, 0):
                grown, transition = W, E
            if count < doublings:
                continue
            forgotten = (np.abs(np.linalg.diagonal(E)) <= _FORGOTTEN).all()  # of undriven states
            variances, increments = (
                (each**2).sum(axis=-1) if root else np.linalg.diagonal(each) for each in (W, moved)
            )
            if forgotten and (increments <= _SETTLED * variances).all():
                return _sum(W, moved, root), grown, transition, first, transitions
    raise UnstableLoopError(
        "the stationary covariance does not exist: to rounding, the system is not stable"
    )


def _first_step(A: Matrix, span: float) -> tuple[float, int]:
    """Return a first step that is short for all A, and its doublings to the span, if above zero."""
    speed = balanced_norm(np.abs(A).max(axis=tuple(range(A.ndim - 2)))) if A.size else 1.0
    if span > 0.0:
        doublings = math.ceil(math.log2(span * speed / _FIRST_STEP))
        return span * 2.0 ** -max(doublings, 0), doublings
    return 2.0 ** math.floor(math.log2(_FIRST_STEP / speed)), 0


def balanced_norm(A: Matrix) -> float:
    """Return the norm of A in the units of the states that make it small; one for zero."""
    return float(np.linalg.norm(dgebal(A, scale=1)[0], 1)) or 1.0


def _doubled(A: Matrix, B: Matrix, first: float, root: bool) -> Iterator[tuple]:
    """Yield W, E and E W E', or R, E and E R, after the first step, after twice that, and so on."""
    F, R = _after(first * A, math.sqrt(first) * B)
    identity, W = np.eye(A.shape[-1]), _compressed(R) if root else _squared(R)
    while True:
        E = identity + F
        moved = E @ W if root else E @ W @ E.mT
        yield W, E, moved
        W = _sum(W, moved, root)
        F = 2.0 * F + F @ F


def _sum(W: Matrix, moved: Matrix, root: bool) -> Matrix:
    return _compressed(W, moved) if root else W + (moved + moved.mT) / 2


def _after(A: Matrix, B: Matrix) -> tuple[Matrix, Matrix]:
    """Return E - I and a root of W after a unit of time by the series of e^{At} of a small A."""
    term, F = A, A
    moved = [np.broadcast_to(B, (*A.shape[:-1], B.shape[-1]))]
    for order in range(1, _TERMS):
        moved.append(A @ moved[-1] / order)
        term = A @ term / (1 + order)
        F = F + term
    powers = ((1.0 + _NODES) / 2.0)[:, None] ** np.arange(_TERMS)
    parts = np.tensordot(powers * np.sqrt(_WEIGHTS / 2.0)[:, None], np.array(moved), axes=1)
    return F, np.concatenate(parts, axis=-1)


def _compressed(*parts: Matrix) -> Matrix:
    """Return a lower triangular R, (..., n, n), with R R' the sum of the parts' squares."""
    R = np.linalg.qr(np.concatenate(parts, axis=-1).mT, mode="r").mT
    missing = R.shape[-2] - R.shape[-1]
    return np.pad(R, [(0, 0)] * (R.ndim - 1) + [(0, missing)]) if missing else R


def _with_signs(R: Matrix) -> Matrix:
    """Return R with its columns' signs such that no entry on the diagonal is negative."""
    return R * np.where(np.linalg.diagonal(R) < 0.0, -1.0, 1.0)[..., None, :]


def _squared(root: Matrix) -> Matrix:
    W = root @ root.mT
    return (W + W.mT) / 2
