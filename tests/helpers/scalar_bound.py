r"""The example's bound in closed form.

With the cost on the filtered error the example is scalar: the delay's states play no part. Let
:math:`p = \lambda_2 + \lambda_3`, :math:`q = \lambda_2 + \lambda_4`, :math:`d = \lambda_2`, and
:math:`h = p - d^2/q`, what the copy does not take from the nonlinearity. With
:math:`s = (2\alpha\beta)^2`, :math:`c = 2\alpha\gamma` and :math:`\lambda_1 = 1`, which is best,

.. math::

    0 &= -2\lambda Y - Y^2[(s - c^2)p - 1/\tau] + \kappa, \qquad
    0 = -2\lambda x + c^2h + \kappa x^2, \quad x = X/\tau,\\
    V &= \tfrac12 Y(1 + \tau c^2p) + \tfrac12\,\frac{Y^2 s p\,\tau x}{1 - Yx} .

V grows with h, so the least h for each p is best. With :math:`J_{21} = j` the constraint is
:math:`d^2 \le (1-p)(j^{-2}-q)`: it allows :math:`h = 0` up to :math:`p = 1/(1+j^2)`, and beyond
that :math:`h = p - q` with :math:`q^2 = (1-p)(j^{-2}-q)`. Two numbers are left, p and tau.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth.homodyne.parameters import HomodyneParameters


def scalar_bound(
    parameters: HomodyneParameters,
    p: ArrayLike,
    tau: ArrayLike,
    J_21: float = 1.0,
) -> NDArray:
    """Return V, rad^2, at p in [0, 1] and tau > 0, rad^2 s; infinity where there is no design."""
    p, tau = np.asarray(p, dtype=float), np.asarray(tau, dtype=float)
    slopes = np.array([parameters.beta, parameters.gamma])
    s, c2 = (2.0 * parameters.alpha * slopes) ** 2
    Y = _root(parameters, parameters.kappa, (s - c2) * p - 1.0 / tau)
    r = 1.0 - p
    q = (np.sqrt(r**2 + 4.0 * r / J_21**2) - r) / 2.0  # of q^2 = (1 - p)(1/J_21^2 - q)
    h = np.where(p <= 1.0 / (1.0 + J_21**2), 0.0, np.maximum(p - q, 0.0))
    x = _root(parameters, c2 * h, -c2 * h)
    with np.errstate(invalid="ignore"):
        value = 0.5 * Y * (1.0 + tau * c2 * p) + 0.5 * Y**2 * s * p * tau * x / (1.0 - Y * x)
        feasible = np.isfinite(Y) & np.isfinite(x) & (Y * x < 1.0)
    return np.where(feasible, value, np.inf)


def _root(parameters: HomodyneParameters, constant: ArrayLike, other: NDArray) -> NDArray:
    """The Y of 0 = -2 lambda Y - Y^2 other + kappa, or the x of the other equation; or infinity."""
    square = parameters.lam**2 + parameters.kappa * other
    value = constant / (parameters.lam + np.sqrt(np.maximum(square, 0.0)))
    return np.where(square < 0.0, np.inf, value)
