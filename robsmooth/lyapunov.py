r"""Covariances of linear stochastic systems, by doubling the time that they run.

For :math:`dx = A x\,dt + dN` with noise of intensity `Q`, started at zero, the covariance `W` and
the transition matrix `E` after a time `t` give those after twice the time,

.. math:: W(2t) = W(t) + E(t)\,W(t)\,E(t)', \qquad E(2t) = E(t)^2,

and `W` tends to the stationary covariance, which solves :math:`AP + PA' + Q = 0`. A short first
step, by Taylor's series, starts it. This is Smith's squared method with an exact transition matrix.
Two things make it fit for systems whose variances and time constants lie decades apart:

- Only sums of products are formed, and of covariances that cannot be negative. So no digit depends
  on the units of the states, and a small variance keeps its digits beside a large one.
- The doubling is done on :math:`F = E - I`, as :math:`F(2t) = 2F + F^2`: a slow mode is not
  rounded off against one.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dgebal

from robsmooth.errors import UnstableLoopError
from robsmooth.validation import Matrix

ERROR_TOLERANCE = 1e-6
_FIRST_STEP = 1 / 4  # times the norm of A
_TERMS = 15  # of a series in steps of that size, to all digits
_ROUGH_TERMS = 4  # to three
_DOUBLINGS = 60  # further apart than 2^60 no time constants are
_FORGOTTEN = 1e-6  # the share of a state, below which a doubling leaves nothing of it
_SETTLED = 1e-12  # the share of a variance that the last increment may be: the next, its square


@dataclass(frozen=True, eq=False)
class Covariances:
    """Of the state of dx = A x dt + dN.

    Attributes
    ----------
    stationary : (..., n, n) array
        P, the limit of W.
    grown : (..., n, n) array
        W, the covariance a span of time after the state was known.
    transition : (..., n, n) array
        E, how the state itself goes over into that after the span.
    error : (..., n, n) array
        Estimated error of P: what one step of refinement would change.
    """

    stationary: Matrix
    grown: Matrix
    transition: Matrix
    error: Matrix


def covariances(A: Matrix, Q: Matrix, span: float = 0.0) -> Covariances:
    """Return the stationary covariance of dx = A x dt + dN, and its build-up over a span of time.

    Parameters
    ----------
    A : (..., n, n) array
        Drifts, 1/s, asymptotically stable.
    Q : (..., n, n) array
        Noise intensities, symmetric and not negative.
    span : float
        In seconds, at least zero, the same for all.

    Returns
    -------
    Covariances

    Raises
    ------
    UnstableLoopError
        Where W or E does not settle: the system is not stable, or to rounding it is not.

    References
    ----------
    R. A. Smith, "Matrix equation XA + BX = C", SIAM J. Appl. Math. 16(1), 1968.
    """
    speed = _norm(A)
    if span > 0.0:  # how often the first step, no longer than the span, is doubled to give the span
        doublings = int(np.ceil(np.log2(span * speed / _FIRST_STEP)))
        first = span * 2.0 ** -max(doublings, 0)
    else:
        doublings, first = 0, 2.0 ** np.floor(np.log2(_FIRST_STEP / speed))
    identity = np.eye(A.shape[-1])
    F, W = _first_step(A * first, Q * first)
    grown, transition = np.zeros_like(W), np.broadcast_to(identity, W.shape)
    transitions = []
    with np.errstate(over="ignore", invalid="ignore"):  # where it is not stable
        for count in range(abs(doublings) + _DOUBLINGS):
            E = identity + F
            transitions.append(E)
            if span > 0.0 and count == max(doublings, 0):
                grown, transition = W, E
            increment = E @ W @ _transposed(E)
            W = W + increment
            F = 2.0 * F + F @ F
            if count >= doublings and _has_settled(W, increment, E):
                break
        else:
            raise UnstableLoopError(
                "the stationary covariance does not exist: to rounding, the system is not stable"
            )
    P = _symmetric(W)
    error = _refinement(A, Q, P, first, transitions)
    return Covariances(P, _symmetric(grown), transition, error)


def check_certainty(what: str, P: Matrix, error: Matrix) -> None:
    """Refuse a covariance with variances of which the estimated error is too large a part.

    Raises
    ------
    ArithmeticError
        Where it is more than `ERROR_TOLERANCE`.
    """
    variances, errors = _diagonal(P), np.abs(_diagonal(error))
    lost = ~(errors <= ERROR_TOLERANCE * variances)
    if lost.any():
        raise ArithmeticError(
            f"{what} is lost in rounding: a variance of {variances[lost][0]:.2g} has an estimated "
            f"error of {errors[lost][0]:.2g}"
        )


def square_root(P: Matrix) -> Matrix:
    """Return an L with P = L L', of an (n, n) covariance; no digit depends on its units."""
    units = np.sqrt(np.maximum(P.diagonal(), 0.0))
    units[units == 0.0] = 1.0
    weights, directions = np.linalg.eigh(P / np.outer(units, units))
    return units[:, None] * directions * np.sqrt(np.maximum(weights, 0.0))


def _norm(A: Matrix) -> float:
    """Return a norm of the largest of all A, in units of the states in which it is small."""
    largest = np.abs(A).reshape(-1, *A.shape[-2:]).max(axis=0)
    return float(np.linalg.norm(dgebal(largest, scale=1)[0], 1))


def _first_step(A: Matrix, Q: Matrix) -> tuple[Matrix, Matrix]:
    """Return E - I and W after a unit of time, in which little happens, by their series."""
    term, F = A, A
    for order in range(2, _TERMS + 1):
        term = A @ term / order
        F = F + term
    return F, _growth(A, Q, _TERMS)


def _growth(A: Matrix, Q: Matrix, terms: int) -> Matrix:
    """Return W after a unit of time, by so many terms of its series."""
    term, W = Q, Q
    for order in range(2, terms + 1):
        half = A @ term / order
        term = half + _transposed(half)
        W = W + term
    return W


def _has_settled(W: Matrix, increment: Matrix, E: Matrix) -> bool:
    forgotten = (np.abs(_diagonal(E)) <= _FORGOTTEN).all()  # also by what no noise drives
    return forgotten and (_diagonal(increment) <= _SETTLED * _diagonal(W)).all()


def _refinement(A: Matrix, Q: Matrix, P: Matrix, first: float, transitions: list[Matrix]) -> Matrix:
    """Return what one step of refinement would add to P: the solution for its residual."""
    half = A @ P
    change = _growth(A * first, (half + _transposed(half) + Q) * first, _ROUGH_TERMS)
    for E in transitions:
        change = change + E @ change @ _transposed(E)
    return change


def _diagonal(P: Matrix) -> np.ndarray:
    return P.diagonal(axis1=-2, axis2=-1)


def _transposed(matrix: Matrix) -> Matrix:
    return matrix.swapaxes(-1, -2)


def _symmetric(P: Matrix) -> Matrix:
    return (P + _transposed(P)) / 2
