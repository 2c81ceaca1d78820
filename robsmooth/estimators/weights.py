r"""The multipliers as weights of the two Riccati equations.

Only between a nonlinearity and its copy have :math:`M(\lambda)` and :math:`N(\lambda)` entries off
their diagonals. With d, o and c the multipliers of the difference, of the nonlinearity's own
constraint and of its copy's, the squares are completed there:

.. math::

    d(\mu - \tilde\mu)^2 + o\mu^2 + c\tilde\mu^2 &= e(\mu - a\tilde\mu)^2
      + \tfrac{d + c}{e}f\,\tilde\mu^2, & a &= \tfrac{d}{d + o},\quad e = d + o,\\
    d(\nu - \tilde\nu)^2 + o\nu^2 + c\tilde\nu^2 &= (d + c)(\tilde\nu - b\nu)^2 + f\nu^2, &
      b &= \tfrac{d}{d + c},\quad f = o + \tfrac{dc}{d + c}.

The estimator has the copy's output :math:`\tilde\mu` without noise. So :math:`a\tilde\mu` is a
known input to it, and what is left of :math:`\mu`, of weight e, is the noise of the Y equation. The
copy's argument is the estimator's to choose: :math:`b\nu` if it knew the state, which leaves the
weight f in the X equation. There 1/f is the noise, too: the entry of :math:`M^{-1}` at
:math:`\mu`. Nothing cancels in e and f, however small a multiplier is.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Weights(NamedTuple):
    r"""What the equations need of the multipliers of k uncertainties and g nonlinearities.

    Attributes
    ----------
    a, b, rest : (g,) arrays
        The shares of the copies' outputs and of their arguments, and 1 - b.
    Y, X : (k + g,) arrays
        :math:`\lambda_s`, then e in the Y equation and f in the X equation.
    rates : (k + g,) array
        How fast those of the X equation grow as a limit is left.
    """

    a: np.ndarray
    b: np.ndarray
    rest: np.ndarray
    Y: np.ndarray
    X: np.ndarray
    rates: np.ndarray

    @classmethod
    def of(cls, k: int, multipliers: np.ndarray, rates: np.ndarray) -> "Weights":
        """Return the weights; `rates` are those at which multipliers that are zero are approached.

        Where neither multiplier of a copy's argument is left, b depends on the rates alone.
        """
        both = np.array([multipliers, rates])
        d, o, c = np.moveaxis(both[:, k:].reshape(2, 3, -1), 1, 0)
        pair = np.where(d[0] + c[0] > 0.0, (d[0], c[0]), (d[1], c[1]))
        a, b, rest = _share((d[0], *pair), (o[0], *pair[::-1]))
        X, fast = np.hstack([both[:, :k], rest**2 * d + o + b**2 * c])
        return cls(a, b, rest, np.concatenate([multipliers[:k], d[0] + o[0]]), X, fast)

    def gradient(self, on_Y: np.ndarray, on_X: np.ndarray) -> np.ndarray:
        """Return the derivatives in the multipliers of what has these in the weights, (k + 3g,)."""
        k = len(on_Y) - len(self.a)
        e, f = on_Y[k:], on_X[k:]
        return np.concatenate([on_Y[:k] + on_X[:k], e + self.rest**2 * f, e + f, self.b**2 * f])


def _share(parts: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> np.ndarray:
    """Return part/(part + other), zero where both are."""
    total = np.add(parts, others)
    return np.divide(parts, total, out=np.zeros_like(total), where=total > 0.0)
