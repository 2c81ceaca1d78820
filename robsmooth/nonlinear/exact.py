r"""A linear system with noise over a step of any length, exact to rounding.

For :math:`dz = (Fz + Gu)\,dt + B\,dW`, with `u` linear in time from :math:`u_0` to :math:`u_1`,

.. math::

    z(h) &= e^{Fh}z(0) + K_1u_0 + K_2(u_1 - u_0) + \eta,\\
    K_1 &= \int_0^h e^{Fs}\,ds\,G,\qquad K_2 = \frac1h\int_0^h\!\!\int_0^s e^{Fr}\,dr\,ds\,G,\qquad
    \operatorname{cov}\eta = \int_0^h e^{Fs}BB'e^{F's}\,ds .

Roots of covariances are computed as roots: quadrature over a time so short that it is exact, then
doubling, :math:`R_{2h} = [R_h,\ e^{Fh}R_h]`, with a QR factorisation to keep it small. Small
variances keep all their digits so, and stiff systems all but those of their stiffness; Van Loan's
block exponential, the common way, overflows with these and drowns those in the rounding of others.
"""

import math

import numpy as np
from scipy.linalg import expm

from robsmooth.exponential import balance, phi_functions
from robsmooth.validation import Matrix

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_SHORT = 0.5  # |F| h over which eight nodes are exact


def responses(F: Matrix, G: Matrix, step: float) -> tuple[Matrix, Matrix, Matrix]:
    """Return e^{F step}, K_1 and K_2."""
    phi_0, phi_1, phi_2 = phi_functions(step * F)
    return phi_0, step * phi_1 @ G, step * phi_2 @ G


def noise_root(F: Matrix, B: Matrix, step: float) -> Matrix:
    """Return the lower triangular root of the covariance of the noise of a step."""
    F, scale = balance(F)
    doublings = max(0, math.ceil(math.log2(max(np.linalg.norm(F, 1) * step / _SHORT, 1.0))))
    root, transition = _short_root(F, B / scale[:, None], step / 2**doublings)
    for _ in range(doublings):
        root, transition = _compressed(root, transition @ root), transition @ transition
    return scale[:, None] * root


def stationary_root(F: Matrix, B: Matrix) -> Matrix:
    """Return the lower triangular root of the stationary covariance; `F` must be stable."""
    F, scale = balance(F)
    root, transition = _short_root(F, B / scale[:, None], _SHORT / np.linalg.norm(F, 1))
    while transition.any():  # until it underflows, ten doublings after it has lost its effect
        root, transition = _compressed(root, transition @ root), transition @ transition
    return scale[:, None] * root


def _short_root(F: Matrix, B: Matrix, step: float) -> tuple[Matrix, Matrix]:
    """Return root and transition of a step of at most `_SHORT` in units of F."""
    times, weights = step * (1 + _NODES) / 2, step * _WEIGHTS / 2
    moved = expm(times[:, None, None] * F) @ B
    return _compressed(*(np.sqrt(weights)[:, None, None] * moved)), expm(step * F)


def _compressed(*parts: Matrix) -> Matrix:
    """Return the lower triangular R, of diagonal not negative, with R R' the sum of the parts'."""
    stacked = np.hstack(parts)
    size = len(stacked)
    root = np.zeros((size, size))
    triangle = np.linalg.qr(stacked.T, mode="r").T
    signs = np.where(np.diag(triangle) < 0.0, -1.0, 1.0)
    root[:, : triangle.shape[1]] = triangle * signs
    return root
