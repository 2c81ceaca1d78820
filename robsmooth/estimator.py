r"""What every estimator here has in common: the form of (eqcontrol).

.. math::

    d\hat x_p = A_c \hat x_p\,dt + \tilde B_c\,d\tilde y, \qquad \tilde u = \tilde C_c \hat x_p,
    \qquad \tilde y = [y; \tilde\mu],\quad \tilde u = [\hat w; \tilde\nu],

with the copies :math:`\tilde\mu_i = \psi_i(\tilde\nu_i)` closing the loop around it. A linear
filter is the case where the copies' gains are zero.
"""

from dataclasses import dataclass

import numpy as np

from robsmooth.augmented import AugmentedSystem
from robsmooth.validation import Matrix, frozen


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimator:
    """An estimator of a plant's output, filtered and one lag back.

    Attributes
    ----------
    plant : AugmentedSystem
        The system and lag that it is for.
    A_c : (n_c, n_c) array
        Its drift, 1/s; n_c is the plant's order for all designs of this package.
    B_c : (n_c, l + g) array
        Its gains: columns for y, then for the copies' outputs mu-tilde.
    C_c : (m + g, n_c) array
        Its outputs: rows of w-hat, then of the copies' arguments nu-tilde.
    C_a : (m, n_c) array
        The read-out of the smoothed estimate of w one lag back.
    C_f : (m, n_c) array
        The read-out of the filtered estimate of w now; w-hat for every design but one whose cost
        is on the smoothed error.
    """

    plant: AugmentedSystem
    A_c: Matrix
    B_c: Matrix
    C_c: Matrix
    C_a: Matrix
    C_f: Matrix

    def __post_init__(self):
        for value in (self.A_c, self.B_c, self.C_c, self.C_a, self.C_f):
            frozen(value)

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues of A_c, 1/s, the slowest first."""
        poles = np.linalg.eigvals(self.A_c)
        return poles[np.lexsort((poles.imag, -poles.real))]
