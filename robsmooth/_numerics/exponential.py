r"""The exponential of a matrix and its phi functions, what a linear system does in a step.

For :math:`dz = (Az + Bu)\,dt`, with `u` linear in time from :math:`u_0` to :math:`u_1`,

.. math::

    z(h) = e^{Ah}z(0) + K_1u_0 + K_2(u_1 - u_0), \qquad
    K_1 = \int_0^h e^{As}\,ds\,B = h\varphi_1(Ah)B, \qquad
    K_2 = \frac1h\int_0^h\!\!\int_0^s e^{Ar}\,dr\,ds\,B = h\varphi_2(Ah)B .
"""

import numpy as np
from scipy.linalg import expm, matrix_balance

from robsmooth._support.validation import Matrix

_RESIDUAL_TOLERANCE = 1e-10


def responses(A: Matrix, B: Matrix, step: float) -> tuple[Matrix, Matrix, Matrix]:
    r"""Return e^{A step}, K_1 and K_2.

    :math:`\varphi_0 = e^A` and :math:`\varphi_{j+1} = A^{-1}(\varphi_j - 1/j!)` are blocks of one
    exponential, which needs no inverse of A.
    """
    n = len(A)
    balanced, (scale, _) = matrix_balance(step * A, permute=False, separate=True)
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
    phi_0, phi_1, phi_2 = scale[:, None] * phi / scale
    return phi_0, step * phi_1 @ B, step * phi_2 @ B
