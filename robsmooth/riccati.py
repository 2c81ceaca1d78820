r"""The algebraic Riccati equation, solved by scipy and certified before its answer is used.

.. math:: A'X + XA + Q - X S X = 0

with symmetric `Q` and `S` of any sign; wanted is the stabilising solution, for which
:math:`A - SX` is stable. `scipy.linalg.solve_continuous_are` can return nonsense past the boundary
where no such solution exists, so the answer, after a few steps of Newton's method where they help,
counts only with its certificate: a small residual, symmetry, and a stable closed loop.

The data are first brought to units in which they are of order one: time in units of
:math:`1/(|A| + \sqrt{|Q||S|})` and :math:`X = p X'` with :math:`p = |Q|/(a + \sqrt{|Q||S|})`, where
`a` is the decay rate of the slowest mode of `A`, or zero where `A` is not stable. No result depends
on the units of time or of the signals.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solve_continuous_are, solve_continuous_lyapunov

from robsmooth.blas import one_thread
from robsmooth.validation import Matrix

RESIDUAL_TOLERANCE = 1e-8
_NEARLY_LINEAR = 1e-5  # the square of this, relative, is what the quadratic term changes
_REFINEMENTS = 8
_ROUNDING = 1e-15  # a relative residual below this is not worth a step
_GOOD = 1e-11  # and one below this is worth steps only while they help
_EMPTY = 1e-14  # directions of S below this, relative to its norm, are rounding


class RiccatiError(ArithmeticError):
    """The equation has no stabilising solution, as far as the certificate can tell."""


@dataclass(frozen=True, eq=False)
class RiccatiSolution:
    """A stabilising solution with its certificate.

    Attributes
    ----------
    X : (n, n) array
        The solution, symmetric.
    residual : float
        Norm of the equation's residual, relative to the sum of the norms of its terms.
    smallest_eigenvalue : float
        Smallest eigenvalue of X, relative to its norm.
    decay_rate : float
        How far the spectrum of A - S X lies left of the imaginary axis, 1/(unit of time).
    """

    X: Matrix
    residual: float
    smallest_eigenvalue: float
    decay_rate: float


@one_thread
def solve_riccati(A: Matrix, Q: Matrix, S: Matrix) -> RiccatiSolution:
    """Return the stabilising solution of A'X + XA + Q - XSX = 0, certified.

    Parameters
    ----------
    A, Q, S : (n, n) arrays
        `Q` and `S` symmetric, of any sign.

    Returns
    -------
    RiccatiSolution

    Raises
    ------
    RiccatiError
        Where scipy finds none, or what it returns fails the certificate.
    """
    Q, S = (Q + Q.T) / 2, (S + S.T) / 2
    size_A, size_Q, size_S = (np.linalg.norm(value, 2) for value in (A, Q, S))
    speed = np.sqrt(size_Q) * np.sqrt(size_S)
    time = 1.0 / (size_A + speed or 1.0)
    decay = -np.linalg.eigvals(A).real.max()
    nearly_linear = decay > 0.0 and speed <= _NEARLY_LINEAR * decay
    unit = size_Q / (speed + max(decay, 0.0)) if size_Q and (speed or decay > 0.0) else 1.0
    time, unit = np.exp2(np.rint(np.log2([time, unit])))  # powers of two scale without rounding
    A, Q, S = A * time, Q * (time / unit), S * (time * unit)

    failure = None
    for start in (_linear,) if nearly_linear else (_pencil, _unbalanced_pencil):
        try:
            X = _refine(A, Q, S, start(A, Q, S))
            return _certify(A, Q, S, X, time, unit)
        except (LinAlgError, ValueError) as error:
            failure = failure or _sentence(error)
            break  # there is none: an inaccurate answer is another matter
        except RiccatiError as error:
            failure = failure or str(error)
    raise RiccatiError(f"no stabilising solution found: {failure}")


def _pencil(A: Matrix, Q: Matrix, S: Matrix, balanced: bool = True) -> Matrix:
    """Return what scipy finds, by the ordered eigenvalues of the extended pencil."""
    weights, directions = np.linalg.eigh(S)
    used = np.abs(weights) > _EMPTY * np.abs(weights).max()
    if not used.any():
        raise LinAlgError("the equation is linear and A is not stable")
    B = directions[:, used] * np.sqrt(np.abs(weights[used]))
    return solve_continuous_are(A, B, Q, np.diag(np.sign(weights[used])), balanced=balanced)


def _unbalanced_pencil(A: Matrix, Q: Matrix, S: Matrix) -> Matrix:
    """Do the same without scipy's balancing, which very fast states upset."""
    return _pencil(A, Q, S, balanced=False)


def _linear(A: Matrix, Q: Matrix, S: Matrix) -> Matrix:
    """Return the solution without the quadratic term.

    Where that term is small, the pencil would lose the digits that it lacks.
    """
    return solve_continuous_lyapunov(A.T, -Q)


def _refine(A: Matrix, Q: Matrix, S: Matrix, X: Matrix) -> Matrix:
    """Return the best of a few steps of Newton's method, the start included."""
    X = (X + X.T) / 2
    best, lowest = X, _residual(A, Q, S, X)
    for _ in range(_REFINEMENTS):
        closed = A - S @ X
        if lowest < _ROUNDING or not np.isfinite(closed).all():
            break
        if np.linalg.eigvals(closed).real.max() > -_EMPTY * np.linalg.norm(closed):
            break
        step = solve_continuous_lyapunov(closed.T, -(A.T @ X + X @ A + Q - X @ S @ X))
        X = X + (step + step.T) / 2
        residual = _residual(A, Q, S, X)
        helped = residual < lowest / 2
        if residual < lowest:
            best, lowest = X, residual
        if lowest < _GOOD and not helped:
            break
    return best


def _residual(A: Matrix, Q: Matrix, S: Matrix, X: Matrix) -> float:
    """Return the norm of the equation's residual, relative to the sum of those of its terms."""
    terms = (A.T @ X, X @ A, Q, -X @ S @ X)
    scale = sum(np.linalg.norm(term) for term in terms)
    return float(np.linalg.norm(sum(terms)) / scale) if scale > 0.0 else 0.0


def _certify(
    A: Matrix, Q: Matrix, S: Matrix, X: Matrix, time: float, unit: float
) -> RiccatiSolution:
    """Check a solution of the scaled equation and return it in the user's units."""
    size = np.linalg.norm(X)
    if not np.isfinite(size):
        raise RiccatiError("the solver returned entries that are not finite")
    if np.linalg.norm(X - X.T) > RESIDUAL_TOLERANCE * size:
        raise RiccatiError("the solver's answer is not symmetric")
    residual = _residual(A, Q, S, X)
    if residual > RESIDUAL_TOLERANCE:
        raise RiccatiError(f"the solver's answer has a relative residual of {residual:.2g}")
    abscissa = float(np.linalg.eigvals(A - S @ X).real.max())
    if not abscissa < 0.0:
        raise RiccatiError(
            "the solver's answer does not stabilise: the closed loop has an eigenvalue with real "
            f"part {abscissa / time:.3g}"
        )
    smallest = float(np.linalg.eigvalsh(X).min() / size) if size > 0.0 else 0.0
    return RiccatiSolution(unit * X, residual, smallest, -abscissa / time)


def _sentence(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".")
