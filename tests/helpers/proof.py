"""The proof, by branch and bound, that no design of the example has a bound below a number.

It takes for granted the closed form of `tests.helpers.scalar_bound`, with lambda_1 = 1 and the
least h for each p; `tests/estimators/test_scalar_bound.py` compares both with designs and with
other multipliers. The rest is rigorous: each operation on floats is rounded outward.
"""

from itertools import product

import numpy as np

from tests.helpers.scalar_bound import scalar_bound

_MOST_CUTS = 60  # how often a cell may be cut
_MOST_CELLS = 500_000  # at a time, of some 300 bytes


def least_tau(parameters, p):
    """Return the tau below which there is no Y, and so no design, in rad^2 s."""
    s, c2 = (2.0 * parameters.alpha * np.array([parameters.beta, parameters.gamma])) ** 2
    return parameters.kappa / (parameters.lam**2 + parameters.kappa * p * (s - c2))


def prove_infimum(parameters, target, J_21=1.0):
    """Prove by branch and bound that no V is below a target; return how many cells it took.

    Cells of p and tau that may hold less than the target are cut in four, until none is left. A
    ValueError has the design that is below the target, or says that the target is too near the
    infimum for the cells that are allowed.
    """
    if not np.isfinite([target, J_21]).all():
        raise ValueError(f"target and J_21 must be finite, got {target} and {J_21}")
    s, c2 = (2.0 * parameters.alpha * np.array([parameters.beta, parameters.gamma])) ** 2
    if not s >= c2:
        raise ValueError(
            "parameters must have a gamma of at most beta for this proof, got "
            f"gamma={parameters.gamma:g}, beta={parameters.beta:g}"
        )
    # Below the first of these there is no Y, for any p. Above the last V is infinite or large: the
    # last cell has no upper end.
    start = np.nextafter(least_tau(parameters, 1.0) * (1.0 - 1e-9), 0.0)
    taus = start * np.concatenate([np.geomspace(1.0, 1e9, 60), [np.inf]])
    ps = np.linspace(0.0, 1.0, 41)
    low = np.stack(np.meshgrid(ps[:-1], taus[:-1]), -1).reshape(-1, 2)
    high = np.stack(np.meshgrid(ps[1:], taus[1:]), -1).reshape(-1, 2)
    cells = 0
    for _ in range(_MOST_CUTS):
        cells += len(low)
        left = lower_bound(parameters, low.T, high.T, J_21) < target
        if not left.any():
            return cells
        low, high = low[left], high[left]
        middle = np.where(np.isinf(high), 2.0 * low, (low + high) / 2.0)
        if (found := scalar_bound(parameters, *middle.T, J_21)).min() < target:
            p, tau = middle[found.argmin()]
            raise ValueError(
                f"V is {found.min():.9g} rad^2 at p = {p:.6g}, tau = {tau:.6g} rad^2 s"
            )
        if 4 * len(low) > _MOST_CELLS:
            break
        corners = np.array(list(product((False, True), repeat=2)))[:, None]
        low = np.where(corners, middle, low).reshape(-1, 2)
        high = np.where(corners, high, middle).reshape(-1, 2)
    raise ValueError(
        f"{len(low)} cells are left in which V may be below {target:.12g} rad^2, of "
        f"{_MOST_CELLS} at most: the target is too near the infimum, or above it"
    )


def lower_bound(parameters, low, high, J_21=1.0):
    """Return a number that V is not below in a cell, from (p, tau) to (p, tau), by intervals.

    Y falls in p and tau, so that its least value is at the upper corner. V grows in Y, in x, which
    grows with h and so with p, and in p and tau besides: they are those of the lower corner.
    """
    one, two, four = (_Interval(number) for number in (1.0, 2.0, 4.0))
    lam, kappa, alpha = (_Interval(getattr(parameters, n)) for n in ("lam", "kappa", "alpha"))
    slopes = _Interval(parameters.beta), _Interval(parameters.gamma)
    s, c2 = ((two * alpha * slope) * (two * alpha * slope) for slope in slopes)
    p, tau, j = _Interval(low[0]), _Interval(low[1]), _Interval(J_21)

    square = lam * lam + kappa * ((s - c2) * _Interval(high[0]) - one / _Interval(high[1]))
    Y = kappa / (lam + square.root())
    r = one - p
    q = ((r * r + four * r / (j * j)).root() - r) / two
    h = (p - q).above_zero()
    h = h.where(p.low > (one / (one + j * j)).high)  # else zero is allowed, or nearly
    inner = lam * lam - kappa * c2 * h
    x = c2 * h / (lam + inner.root())
    left = one - Y.lower() * x.lower()
    value = Y.lower() * (one + tau * c2 * p) / two
    value += Y.lower() * Y.lower() * s * p * tau * x.lower() / (two * left.above_zero())
    none = (square.high < 0.0) | (inner.high < 0.0) | (left.high <= 0.0)
    return np.where(none, np.inf, value.low)


class _Interval:
    """Arrays of numbers between two floats; each operation rounds the ends outward."""

    def __init__(self, low, high=None):
        self.low = np.asarray(low, dtype=float)
        self.high = self.low if high is None else np.asarray(high, dtype=float)

    @classmethod
    def _around(cls, *ends):
        ends = np.broadcast_arrays(*ends)
        low, high = np.fmin.reduce(ends), np.fmax.reduce(ends)
        return cls(np.nextafter(low, -np.inf), np.nextafter(high, np.inf))

    def __add__(self, other):
        return self._around(self.low + other.low, self.high + other.high)

    def __sub__(self, other):
        return self._around(self.low - other.high, self.high - other.low)

    def __mul__(self, other):
        with np.errstate(invalid="ignore"):  # zero times infinity
            pairs = product((self.low, self.high), (other.low, other.high))
            return self._around(*(a * b for a, b in pairs))

    def __truediv__(self, other):
        """Divide by numbers that are not negative."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            pairs = product((self.low, self.high), (other.low, other.high))
            return self._around(*(a / b for a, b in pairs))

    def root(self):
        """Return the root, of zero where the number is negative."""
        return self._around(*(np.sqrt(np.fmax(end, 0.0)) for end in (self.low, self.high)))

    def above_zero(self):
        return _Interval(np.fmax(self.low, 0.0), np.fmax(self.high, 0.0))

    def lower(self):
        return _Interval(self.low)

    def where(self, condition):
        """Return zero where the condition does not hold."""
        return _Interval(*(np.where(condition, end, 0.0) for end in (self.low, self.high)))
