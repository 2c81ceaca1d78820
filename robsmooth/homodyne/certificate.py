r"""The example's bound in closed form, and a proof that its infimum is one.

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

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth.homodyne.parameters import HomodyneParameters

_MOST_CUTS = 60  # how often a cell may be cut


def scalar_bound(
    parameters: HomodyneParameters,
    p: ArrayLike,
    tau: ArrayLike,
    J_21: float = 1.0,
    corner: tuple[NDArray, NDArray] | None = None,
) -> NDArray:
    """Return V, rad^2, at p in [0, 1] and tau > 0, rad^2 s; infinity where there is no design.

    With a corner, a larger p and tau, Y is of that: no V in between is less than this.
    """
    p, tau = np.asarray(p, dtype=float), np.asarray(tau, dtype=float)
    p_Y, tau_Y = (p, tau) if corner is None else corner
    s, c2 = _squares(parameters)
    Y = _root(parameters, parameters.kappa, (s - c2) * p_Y - 1.0 / tau_Y)
    r = 1.0 - p
    q = (np.sqrt(r**2 + 4.0 * r / J_21**2) - r) / 2.0  # of q^2 = (1 - p)(1/J_21^2 - q)
    h = np.where(p <= 1.0 / (1.0 + J_21**2), 0.0, np.maximum(p - q, 0.0))
    x = _root(parameters, c2 * h, -c2 * h)
    with np.errstate(invalid="ignore"):
        value = 0.5 * Y * (1.0 + tau * c2 * p) + 0.5 * Y**2 * s * p * tau * x / (1.0 - Y * x)
        feasible = np.isfinite(Y) & np.isfinite(x) & (Y * x < 1.0)
    return np.where(feasible, value, np.inf)


def least_tau(parameters: HomodyneParameters, p: float) -> float:
    """Return the tau below which there is no Y, and so no design, in rad^2 s."""
    s, c2 = _squares(parameters)
    return parameters.kappa / (parameters.lam**2 + parameters.kappa * p * (s - c2))


def prove_infimum(parameters: HomodyneParameters, target: float, J_21: float = 1.0) -> int:
    """Prove by branch and bound that no V is below a target; return how many cells it took.

    On a cell of p and tau, V is at least its value with Y, which falls in both, from the upper
    corner, and all else from the lower one. Cells that may hold less than the target are cut in
    four, until none is left. A ValueError has the design that is below the target.
    """
    s, c2 = _squares(parameters)
    if not s >= c2:
        raise ValueError(
            "parameters must have a gamma of at most beta for this proof, got "
            f"gamma={parameters.gamma:g}, beta={parameters.beta:g}"
        )
    # below the first of these there is no Y, for any p
    taus = least_tau(parameters, 1.0) * np.concatenate([np.geomspace(1.0, 1e9, 60), [np.inf]])
    ps = np.linspace(0.0, 1.0, 41)
    low = np.stack(np.meshgrid(ps[:-1], taus[:-1]), -1).reshape(-1, 2)
    high = np.stack(np.meshgrid(ps[1:], taus[1:]), -1).reshape(-1, 2)
    cells = 0
    for _ in range(_MOST_CUTS):
        cells += len(low)
        left = scalar_bound(parameters, *low.T, J_21, corner=high.T) < target
        if not left.any():
            return cells
        low, high = low[left], high[left]
        middle = np.where(np.isinf(high), 2.0 * low, (low + high) / 2.0)
        if (found := scalar_bound(parameters, *middle.T, J_21)).min() < target:
            p, tau = middle[found.argmin()]
            raise ValueError(
                f"V is {found.min():.9g} rad^2 at p = {p:.6g}, tau = {tau:.6g} rad^2 s"
            )
        corners = np.array(list(product((False, True), repeat=2)))[:, None]
        low = np.where(corners, middle, low).reshape(-1, 2)
        high = np.where(corners, high, middle).reshape(-1, 2)
    raise ValueError(f"cells are left in which V may be below {target:.9g} rad^2")


def _squares(parameters: HomodyneParameters) -> tuple[float, float]:
    """Return s and c^2."""
    amplitude = (2.0 * parameters.alpha) ** 2
    return amplitude * parameters.beta**2, amplitude * parameters.gamma**2


def _root(parameters: HomodyneParameters, constant: ArrayLike, other: NDArray) -> NDArray:
    """The Y of 0 = -2 lambda Y - Y^2 other + kappa, or the x of the other equation; or infinity."""
    square = parameters.lam**2 + parameters.kappa * other
    value = constant / (parameters.lam + np.sqrt(np.maximum(square, 0.0)))
    return np.where(square < 0.0, np.inf, value)
