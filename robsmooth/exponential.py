"""The exponential of a matrix and its phi functions, what a linear system does in a step."""

import numpy as np
from scipy.linalg import expm, matrix_balance

from robsmooth.validation import Matrix

_RESIDUAL_TOLERANCE = 1e-10


def phi_functions(A: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    r"""Return :math:`\varphi_0 = e^A` and :math:`\varphi_{j+1} = A^{-1}(\varphi_j - 1/j!)`, j < 2.

    They are blocks of one exponential, which needs no inverse of A.
    """
    n = len(A)
    balanced, scale = balance(A)
    block = np.eye(3 * n, k=n)
    block[:n, :n] = balanced
    with np.errstate(all="ignore"):  # an overflow leaves a residual that is not a number
        phi = expm(block)[:n].reshape(n, 3, n).swapaxes(0, 1)
        residuals = balanced @ phi[1:] - phi[:2] + np.eye(n)
        size = 1.0 + np.linalg.norm(balanced) * np.linalg.norm(phi[1:], axis=(1, 2))
        residual = (np.linalg.norm(residuals, axis=(1, 2)) / size).max()
    if not residual <= _RESIDUAL_TOLERANCE:
        raise ArithmeticError(
            f"the matrix exponential over one step was found to {residual:.2g} only: it is too "
            "long for an unstable estimator"
        )
    return tuple(scale[:, None] * phi / scale)


def balance(A: Matrix) -> tuple[Matrix, np.ndarray]:
    """Return T^-1 A T and the diagonal of T, powers of two that even out the sizes of states."""
    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    return balanced, scale
