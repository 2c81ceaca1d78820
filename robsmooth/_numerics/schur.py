"""The real Schur form of a matrix, by which its Lyapunov equations are solved."""

import numpy as np
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dgees, dtrsyl

from robsmooth._support.validation import Matrix


class SchurForm:
    """The form U T U' of A (n, n), where T is triangular but for 2 x 2 blocks.

    The poles are in the order of T's diagonal. Where that is asked for, the `stable` many stable
    ones are first. SciPy's wrappers of LAPACK take as long as LAPACK does for a small matrix.
    """

    def __init__(self, A: Matrix, stable_first: bool = False) -> None:
        if not np.isfinite(A).all():
            raise LinAlgError("the matrix has entries that are not finite")
        found = dgees(lambda real, _: real < 0.0, A, sort_t=int(stable_first))
        self._T, self.stable, real, imaginary, self.U, _, failed = found
        if failed:
            raise LinAlgError("the matrix has no Schur form to rounding")
        self.poles = real + 1j * imaginary

    def lyapunov(self, Q: Matrix, transposed: bool = False) -> Matrix:
        """Return the X of A X + X A' + Q = 0, or of A' X + X A + Q = 0, with a symmetric Q."""
        kinds = ("T", "N") if transposed else ("N", "T")
        X, scale, _ = dtrsyl(self._T, self._T, -self.U.T @ Q @ self.U, *kinds)
        return self.U @ (X / scale) @ self.U.T
