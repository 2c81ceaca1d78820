"""The algebraic Riccati equation, its answer certified before it is used.

.. math:: A'X + XA + Q - X S X = 0

with symmetric `Q` and `S` of any sign. The stable subspace of the Hamiltonian matrix is the start
of Newton's method. The result counts only with its certificate: a small residual, a small last
step, which estimates the error, and a stable closed loop. Data are scaled to order one
(`docs/source/numerics.md`), so that results do not depend on units.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dgebal

from robsmooth._numerics.schur import SchurForm
from robsmooth._support.blas import one_thread
from robsmooth._support.validation import Frozen, Matrix

RESIDUAL_TOLERANCE = 1e-8
ERROR_TOLERANCE = 1e-6
_NEARLY_LINEAR = 1e-5  # the square root of the relative effect of the quadratic part
_REFINEMENTS = 20
_LAST = 1e-12  # a step smaller than this, relatively, is the last: the next is its square
_LARGEST = 1e75  # a norm, so that products of four stay within the floats


class RiccatiError(ArithmeticError):
    """No stabilising solution passes the certificate."""


@dataclass(frozen=True, eq=False)
class RiccatiSolution(Frozen):
    r"""A stabilising solution X (n, n) with its certificate.

    In the balancing units of the states. The residual is relative to
    :math:`2|A||X| + |Q| + |S||X|^2`, smallest eigenvalue and error are relative to the norm of X.
    """

    X: Matrix = field(repr=False)
    residual: float
    smallest_eigenvalue: float
    decay_rate: float  # of A - S X, 1/(unit of time)
    error: float  # the last step of Newton's method


@one_thread
def solve_riccati(A: Matrix, Q: Matrix, S: Matrix) -> RiccatiSolution:
    """Return the stabilising solution; a RiccatiError where none passes the certificate."""
    Q, S = (Q + Q.T) / 2, (S + S.T) / 2
    decay = -np.linalg.eigvals(A).real.max()
    (A, Q, S), first = _rescaled(A, Q, S, decay)  # before the states are balanced, and again after
    one, other = np.split(dgebal(np.abs(np.block([[A, S], [Q, A.T]])), scale=1)[3], 2)
    states = np.exp2(np.rint(np.log2(one / other) / 2.0))  # balance the Hamiltonian
    products = np.outer(states, states)
    A, Q, S = A / states[:, None] * states, Q * products, S / products
    (A, Q, S), again = _rescaled(A, Q, S, decay * first[0])
    time, unit = first * again

    # Zero is the better start where the quadratic part is negligible, and another start where the
    # subspace is inaccurate, for time constants that differ by orders of magnitude.
    linear = np.sqrt(np.abs(Q).max()) * np.sqrt(np.abs(S).max()) <= _NEARLY_LINEAR * decay * time
    failure = None
    for from_zero in (linear, not linear):
        try:
            X, error = _refine(A, Q, S, np.zeros_like(A) if from_zero else stabilising(A, Q, S))
            residual, smallest, rate = _certify(A, Q, S, X, error)
        except (LinAlgError, ValueError, RiccatiError) as reason:
            failure = failure or " ".join(str(reason).split()).rstrip(".")
        else:
            return RiccatiSolution(unit * X / products, residual, smallest, rate / time, error)
    raise RiccatiError(f"no stabilising solution found: {failure}")


def _rescaled(A: Matrix, Q: Matrix, S: Matrix, decay: float) -> tuple[tuple, np.ndarray]:
    """Return the data in units of time and of X, powers of two, which scale exactly."""
    size = np.abs(Q).max()
    speed = np.sqrt(size) * np.sqrt(np.abs(S).max())
    rate = speed + max(decay, 0.0)
    units = 1.0 / (np.abs(A).max() + speed or 1.0), size / rate if size and rate else 1.0
    time, unit = units = np.exp2(np.rint(np.log2(units)))
    return (A * time, Q * (time / unit), S * (time * unit)), units


def stabilising(A: Matrix, Q: Matrix, S: Matrix, margin: float = 0.0) -> Matrix:
    """Return the stabilising solution without a certificate, or raise a LinAlgError.

    The closed loop decays by more than the margin times the Hamiltonian's norm.
    """
    n = len(A)
    size_Q, size_S = np.linalg.norm(Q), np.linalg.norm(S)
    unit = np.sqrt(size_Q / size_S) if size_Q > 0.0 < size_S else 1.0 / (size_S or 1.0)
    hamiltonian = np.block([[A, -unit * S], [-Q / unit, -A.T]])
    size = np.linalg.norm(hamiltonian)
    if size < _LARGEST:
        form = SchurForm(hamiltonian, stable_first=True)
        X = np.linalg.solve(form.U[:n, :n].T, form.U[n:, :n].T) * unit
        decays = form.stable == n and -form.poles.real[:n].max() > margin * size
        if decays and np.linalg.norm(X) < _LARGEST:
            return (X + X.T) / 2
    raise LinAlgError("there is no stabilising solution")


def _refine(A: Matrix, Q: Matrix, S: Matrix, X: Matrix) -> tuple[Matrix, float]:
    """Iterate Newton's method until rounding; return the solution and the last step's size."""
    X, error = (X + X.T) / 2, np.inf
    for _ in range(_REFINEMENTS):
        closed = SchurForm(A - S @ X)
        _check_stability(closed.poles.real.max())
        Z = closed.lyapunov(_residual(A, Q, S, X), transposed=True)
        step = (Z + Z.T) / 2
        size = np.linalg.norm(step) / (np.linalg.norm(X + step) or 1.0)
        if size > error / 2 and error < ERROR_TOLERANCE:
            break  # what is left is rounding
        X, error = X + step, size
        if error < _LAST:
            break
    return X, float(error)


def _residual(A: Matrix, Q: Matrix, S: Matrix, X: Matrix) -> Matrix:
    half = A.T @ X
    return half + half.T + Q - X @ S @ X


def _certify(A: Matrix, Q: Matrix, S: Matrix, X: Matrix, error: float) -> list[float]:
    """Return relative residual, relative smallest eigenvalue and decay rate, or refuse."""
    size_A, size_Q, size_S, size = map(np.linalg.norm, (A, Q, S, X))
    terms = 2 * size_A * size + size_Q + size_S * size**2
    residual = np.linalg.norm(_residual(A, Q, S, X)) / (terms or 1.0)
    if not residual <= RESIDUAL_TOLERANCE:
        raise RiccatiError(f"the solver's answer has a relative residual of {residual:.2g}")
    if not error <= ERROR_TOLERANCE:
        raise RiccatiError(f"the solver's answer has an estimated relative error of {error:.2g}")
    abscissa = np.linalg.eigvals(A - S @ X).real.max()
    _check_stability(abscissa)
    smallest = np.linalg.eigvalsh(X).min() / (size or 1.0)
    return [float(residual), float(smallest), float(-abscissa)]


def _check_stability(abscissa: float) -> None:
    if not abscissa < 0.0:
        raise RiccatiError("the solver's answer does not stabilise the closed loop")
