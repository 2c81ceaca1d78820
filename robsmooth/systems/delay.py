r"""The finite-dimensional model of the delay, (eqdelay).

Its transfer function is the Pade approximation :math:`[N/N]` of :math:`e^{-s\delta}`, for each
output of `w`. A ladder of N lossless elements 1, 3, 5, ... realises it (`docs/source/methods.md`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth._support import validation
from robsmooth._support.validation import Matrix, frozen


class DelayModel(NamedTuple):
    r"""A linear model of the delay of `channels` signals by `delay` seconds.

    Attributes
    ----------
    F, G, H, J : arrays
        :math:`F_a` (n_a, n_a) and :math:`G_a` (n_a, m) in 1/s, :math:`H_a` (m, n_a), :math:`J_a`
        (m, m).
    delay : float, s
    order : int, of the Pade approximation; n_a = order * m, or zero for a delay of zero
    """

    F: Matrix
    G: Matrix
    H: Matrix
    J: Matrix
    delay: float
    order: int

    def response(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """Return the transfer matrix at the angular frequencies `omega` (rad/s): (..., m, m)."""
        s = 1j * validation.numbers_of("omega", omega)[..., None, None]
        identity = np.eye(self.F.shape[0])
        return self.H @ np.linalg.solve(s * identity - self.F, self.G + 0j * s) + self.J


def checked_order(name: str, order: int, low: int = 1) -> int:
    """Return an order of the approximation, if a design can be made with it."""
    why = ", because a design takes n^3 operations"
    return validation.integer(name, order, low=low, high=100, why=why)


def pade_delay(delay: float, order: int, channels: int = 1) -> DelayModel:
    """Realise the Pade approximation of the delay (s) of some signals, (eqdelay)."""
    delay = validation.real("delay", delay, low=0.0)
    order = checked_order("order", order, low=0)
    each = np.eye(validation.integer("channels", channels, low=1))
    N = order if delay > 0.0 else 0
    elements = np.sqrt(2.0 * np.arange(1, N + 1) - 1.0)
    ladder = np.eye(N, k=-1) - np.eye(N, k=1)
    ladder[:1, :1] = -1.0  # the bilinear map from tanh to the delay closes the ladder on itself
    driven = 2.0 * elements[:, None] * np.linalg.inv(ladder)
    F, b, J = driven * elements, driven @ np.eye(N, 1), (-1.0) ** N
    unit = delay or 1.0
    blocks = F / unit, b / unit, -J * b.T, np.array([[J]])
    return DelayModel(*(frozen(np.kron(each, block)) for block in blocks), delay, order)
