r"""The bound as the search sees it: a function of tau lambda alone.

With :math:`\theta = \tau\lambda`, neither :math:`X` nor :math:`Y/\tau` nor the estimator depends on
:math:`\tau`, and :math:`V = \tau\,v(\theta)`. Here v is half the entropy of the problem's central
H-infinity controller, for channels weighted by :math:`M(\theta)` and :math:`N(\theta)`. The
equations are solved fast and not certified: the design that a search ends with is, by
`design_smoother`.
"""

import numpy as np
from scipy.linalg import LinAlgError, schur

from robsmooth._support.validation import Matrix
from robsmooth.estimators.conditions import ASSUMPTION_X, ASSUMPTION_Y, check_nonnegative, refusal
from robsmooth.estimators.equations import DesignEquations
from robsmooth.estimators.problem import DesignProblem

_STABILITY_MARGIN = 1e-10  # of a Riccati equation's closed loop, relative to its Hamiltonian's norm

_LARGEST = 1e75  # a norm, so that products of four stay within the floats


@np.errstate(all="ignore")
def log_bound(problem: DesignProblem, theta: np.ndarray) -> float:
    """Return log v of a problem in natural units.

    Raises InfeasibleDesignError where there is no design, or numbers leave the range of floats.
    """
    equations = DesignEquations(problem, 1.0, theta)
    try:
        Y = _stabilising(ASSUMPTION_Y, *equations.equation_Y)
        spectrum = np.linalg.eigvalsh(Y)
        check_nonnegative(ASSUMPTION_Y, spectrum[0] / (np.abs(spectrum).max() or 1.0))
        X = _stabilising(ASSUMPTION_X, *equations.equation_X())
        *_, v, _ = equations.solution(X, Y)
    except LinAlgError as error:
        raise refusal(ASSUMPTION_Y, str(error)) from None
    if not np.isfinite(v):
        raise refusal(ASSUMPTION_Y, "numbers leave the range of floats")
    return float(np.log(max(v, np.finfo(float).tiny)))


def _stabilising(condition: str, A: Matrix, Q: Matrix, S: Matrix) -> Matrix:
    """Return the stabilising solution of A'X + XA + Q - XSX = 0, which the condition asks for."""
    n = len(A)
    size_Q, size_S = np.linalg.norm(Q), np.linalg.norm(S)
    unit = np.sqrt(size_Q / size_S) if size_Q > 0.0 < size_S else 1.0 / (size_S or 1.0)
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
