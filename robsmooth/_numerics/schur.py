"""The real Schur form of a matrix, by which its Lyapunov equations are solved."""

import numpy as np
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dgees, dtrsyl

from robsmooth._support.validation import Matrix


class SchurForm:
    """The form U T U' of A (n, n), where T is triangular but for 2 x 2 blocks, and the poles."""

    def __init__(self, A: Matrix) -> None:
        if not np.isfinite(A).all():
            raise LinAlgError("the matrix has entries that are not finite")
        self._T, _, real, imaginary, self._U, _, failed = dgees(lambda *_: False, A)
        if failed:
            raise LinAlgError("the matrix has no Schur form to rounding")
        self.poles = real + 1j * imaginary

    def lyapunov(self, Q: Matrix, transposed: bool = False) -> Matrix:
        """Return the X of A X + X A' + Q = 0, or of A' X + X A + Q = 0, with a symmetric Q."""
        kinds = ("T", "N") if transposed else ("N", "T")
        X, scale, _ = dtrsyl(self._T, self._T, -self._U.T @ Q @ self._U, *kinds)
        return self._U @ (X / scale) @ self._U.T
