"""The proof, by branch and bound, that no design of the example has a bound below a number."""

from itertools import product

import numpy as np

from tests.helpers.scalar_bound import scalar_bound

_MOST_CUTS = 60  # how often a cell may be cut


def least_tau(parameters, p):
    """Return the tau below which there is no Y, and so no design, in rad^2 s."""
    s, c2 = (2.0 * parameters.alpha * np.array([parameters.beta, parameters.gamma])) ** 2
    return parameters.kappa / (parameters.lam**2 + parameters.kappa * p * (s - c2))


def prove_infimum(parameters, target, J_21=1.0):
    """Prove by branch and bound that no V is below a target; return how many cells it took.

    On a cell of p and tau, V is at least its value with Y, which falls in both, from the upper
    corner, and all else from the lower one. Cells that may hold less than the target are cut in
    four, until none is left. A ValueError has the design that is below the target.
    """
    s, c2 = (2.0 * parameters.alpha * np.array([parameters.beta, parameters.gamma])) ** 2
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
