r"""Closed loop and stationary error covariance (Section III-A).

With the uncertainty :math:`\tilde\xi = \Delta\tilde\zeta`, the plant and the estimator form
:math:`dX = \mathbf A X\,dt + \mathbf B\,dW`; its stationary covariance :math:`\mathbf P` solves
:math:`\mathbf{AP} + \mathbf{PA}' + \mathbf{BB}' = 0`, and the smoothed error is (eqCo), with the
transposes that the paper leaves out,

.. math::

    P_{sa} = C\mathbf P C' - C_s e^{\mathbf A\delta}\mathbf P C' -
             (C_s e^{\mathbf A\delta}\mathbf P C')' + C_s\mathbf P C_s', \qquad
    C = [C_{p0}\; 0],\quad C_s = [0\; C_a].

Its terms nearly cancel where the estimate is good. What is computed here is the same in two that
cannot be negative,

.. math::

    P_{sa} = (C - C_s e^{\mathbf A\delta})\,\mathbf P\,(C - C_s e^{\mathbf A\delta})'
             + C_s \mathbf W C_s', \qquad
    \mathbf W = \mathbf P - e^{\mathbf A\delta}\mathbf P e^{\mathbf A'\delta}:

what the state one lag back contributes, and the noise since then (`robsmooth._numerics.lyapunov`
finds `W` without the subtraction). The state is :math:`[x_p;\; x_p - \hat x_p]`, so that a small
error is small from the start.

The paper drives the copies with the fictitious noise of the design: that is ``loop="theory"``. A
real loop has no such noise: ``loop="real"`` leaves it out.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from robsmooth._numerics.lyapunov import check_certainty, covariances
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import OUTPUTS, Reference, error_rows, matrices, which_loop
from robsmooth.systems.augmented import AugmentedSystem

_BATCH = 200_000  # entries of the drifts of a sweep that are worked on at once
_EIGENVALUE_ERROR = 1e-12  # relative to the largest entry of the matrix
_NORM_ERROR = 1e-12


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The loop dX = A X dt + B dW of plant and estimator, X = [x_p; x_hat], asymptotically stable.

    Attributes
    ----------
    A : (N, N) array
        Drift, 1/s.
    B : (N, q + g) array
        Noise intensity.
    estimator : Estimator
    """

    A: Matrix
    B: Matrix
    estimator: Estimator

    def covariance(self) -> Matrix:
        """Return the stationary covariance P of X."""
        return self.covariance_of(np.eye(len(self.A)))

    def covariance_of(self, rows: Matrix) -> Matrix:
        """Return the stationary covariance of `rows` times X."""
        T = _error_coordinates(self.estimator)
        B = T @ self.B
        found = covariances(T @ self.A @ T, B)
        outputs = block_diag(self.estimator.plant.C_p0, self.estimator.C_f) @ T
        check_certainty(
            "the covariance of the closed loop",
            _squared(outputs, found.stationary),
            _squared(outputs, found.error),
        )
        return _squared(rows @ T, found.stationary)

    def error_covariance(self, output: str) -> Matrix:
        """Return the (m, m) stationary covariance of one of the errors of `open_loop`."""
        return _error_covariance(self.estimator, self.A, self.B, output)


def closed_loop(
    estimator: Estimator,
    Delta: ArrayLike,
    loop: str = "theory",
    allow_inadmissible: bool = False,
    reference: Reference = None,
) -> ClosedLoop:
    r"""Close the loop of an estimator and its plant under a constant uncertainty.

    Parameters
    ----------
    estimator : Estimator
        Any design of this package.
    Delta : (r + 2g, h + 2g) array
        :math:`\tilde\xi = \Delta\tilde\zeta`, of norm at most one with the outputs of the
        nonlinearities weighted by their Lipschitz constants. That is necessary to be
        admissible, not sufficient: the bound of a design is for the block-diagonal ones with the
        same slope for a nonlinearity and its copy, which `AugmentedSystem.structured_delta` makes.
    loop : {"theory", "real"}
        Whether the design's fictitious noise drives the copies, as in the paper's formula.
    allow_inadmissible : bool
        Whether a Delta with norm above one is let through.
    reference : {"system", "filtered", "smoothed"}, (g, n_c) array or None
        What is taken off the nonlinearities' arguments, as in `simulate`; the theory's loop has
        none.

    Returns
    -------
    ClosedLoop

    Raises
    ------
    UnstableLoopError
        Where the closed loop is not asymptotically stable.
    ValueError, TypeError
        For a Delta of the wrong shape or with norm above one.

    References
    ----------
    Section III-A, equation (eqclosed).
    """
    validation.instance("smoother", estimator, Estimator)
    plant = estimator.plant
    shape = plant.B1_tilde.shape[1], plant.C1_tilde.shape[0]
    Delta = validation.matrix("Delta", Delta, shape)
    if not allow_inadmissible:
        _check_norm(_norm(plant, Delta))
    A, B = _closed(estimator, Delta, loop, reference)
    _check_stability(A)
    return ClosedLoop(A, B, estimator)


def _norm(plant: AugmentedSystem, Delta: Matrix) -> float:
    """Return the norm of Delta, in which the nonlinearities' Lipschitz constants are units."""
    constants = [c.lipschitz for c in plant.system.nonlinearities]
    ones = [1.0] * (Delta.shape[1] - 2 * len(constants))
    weights = np.array([*ones, *constants, *constants])
    return float(np.linalg.norm(Delta / weights, 2)) if Delta.size else 0.0


def _check_norm(norm: float) -> None:
    if norm > 1.0 + _NORM_ERROR:
        raise ValueError(
            f"Delta must have norm at most 1 to be admissible, got {norm:.6g} (columns of "
            "nonlinearities count divided by their Lipschitz constants); "
            "allow_inadmissible=True computes it all the same"
        )


def _check_stability(A: Matrix) -> None:
    """Refuse a loop that is clearly unstable; what rounding hides, its covariance will tell."""
    abscissa = np.linalg.eigvals(A).real.max()
    if not abscissa < _EIGENVALUE_ERROR * np.abs(A).max():
        raise UnstableLoopError(
            f"the closed loop is not stable: it has an eigenvalue with real part {abscissa:.4g} 1/s"
        )


def _closed(
    estimator: Estimator, Delta: Matrix, loop: str, reference: Reference = None
) -> tuple[Matrix, Matrix]:
    """Return A and B of (eqclosed), for one Delta or (N, ., .) of them."""
    A, B, inputs, outputs = matrices(estimator, loop, reference)
    return A + inputs @ Delta @ outputs, B


def _error_coordinates(estimator: Estimator) -> Matrix:
    """Return T = inv(T) with T [x_p; x_hat] = [x_p; x_p - x_hat]."""
    n, n_c = estimator.plant.n, len(estimator.A_c)
    if n != n_c:
        return np.eye(n + n_c)  # of an estimator of another order there is no such error
    return np.kron([[1.0, 0.0], [1.0, -1.0]], np.eye(n))


def _error_covariance(estimator: Estimator, A: Matrix, B: Matrix, output: str) -> Matrix:
    """Return the (..., m, m) error covariance of one loop, or of many with drifts A."""
    T = _error_coordinates(estimator)
    truth, estimate, delay = error_rows(estimator, output)
    truth, estimate = truth @ T, estimate @ T
    found = covariances(T @ A @ T, T @ B, delay)
    E, error = found.transition, found.error
    past = truth - estimate @ E
    result = _squared(past, found.stationary) + _squared(estimate, found.grown)
    since = error - _squared(E, error)
    check_certainty(
        "the error covariance", result, _squared(past, error) + _squared(estimate, since)
    )
    return result


def _squared(C: Matrix, P: Matrix) -> Matrix:
    """Return C P C', symmetric."""
    result = C @ P @ C.swapaxes(-1, -2)
    return (result + result.swapaxes(-1, -2)) / 2


def error_covariance(
    smoother: Estimator,
    Delta: ArrayLike,
    output: str = "smoothed",
    loop: str = "theory",
    allow_inadmissible: bool = False,
    reference: Reference = None,
    *,
    copy_noise: bool | None = None,
) -> Matrix:
    r"""Return the stationary error covariance under a constant uncertainty.

    Parameters
    ----------
    smoother : Estimator
        Any design of this package.
    Delta : (r + 2g, h + 2g) array
        :math:`\tilde\xi = \Delta\tilde\zeta`, of norm at most one, as in `closed_loop`.
    output : {"smoothed", "filtered", "guaranteed"}
        The error of the smoothed estimate one lag back, of the filtered one now, or that which the
        bound of a `RobustSmoother` is for, as in `worst_case`.
    loop : {"theory", "real"}
        Whether the design's fictitious noise drives the copies, as in the paper's formula.
    allow_inadmissible : bool
        Whether a Delta with norm above one is let through.
    reference : {"system", "filtered", "smoothed"}, (g, n_c) array or None
        What is taken off the nonlinearities' arguments, as in `simulate`. The paper's formula has
        no reference.
    copy_noise : bool, optional
        Another way to say `loop`, also in its place: True for "theory", False for "real".

    Returns
    -------
    (m, m) array
        In the squared unit of w.

    Raises
    ------
    UnstableLoopError
        Where the closed loop is not asymptotically stable.
    ArithmeticError
        Where the estimated rounding error is above a millionth of a variance.
    ValueError, TypeError
        For a Delta of the wrong shape or with norm above one, or an unknown output.

    See Also
    --------
    delta_sweep : The same for many slopes of the nonlinearities.
    worst_case : The constant uncertainty with the largest error.
    analysis_bound : A bound for every admissible uncertainty.

    References
    ----------
    Section III-A, equation (eqCo).

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.design_smoother(plant, 1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6])
    >>> Delta = plant.structured_delta([], [-0.5])
    >>> rs.error_covariance(smoother, Delta).round(4)
    array([[0.0976]])
    >>> rs.error_covariance(smoother, Delta, loop="real").round(4)
    array([[0.0609]])
    """
    validation.choice("output", output, OUTPUTS)
    loop = which_loop(loop, copy_noise)
    closed = closed_loop(smoother, Delta, loop, allow_inadmissible, reference)
    return closed.error_covariance(output)


@one_thread
def delta_sweep(
    smoother: Estimator,
    nonlinearities: Iterable[float],
    output: str = "smoothed",
    loop: str = "theory",
) -> NDArray[np.float64]:
    """Return the error covariance for each slope of the nonlinearities, as in Fig. 4.

    Parameters
    ----------
    smoother : Estimator
        Any design of this package.
    nonlinearities : (N,) array
        The paper's Delta_2 in [-1, 1], the same for every nonlinearity and its copy; the
        uncertainties are zero.
    output, loop
        As in `error_covariance`.

    Returns
    -------
    (N, m, m) array

    Raises
    ------
    UnstableLoopError, ArithmeticError, ValueError, TypeError
        As `error_covariance`, where it would at any of them.

    See Also
    --------
    error_covariance : The same for any one uncertainty.
    worst_case : The constant uncertainty with the largest error.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.design_smoother(plant, 1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6])
    >>> rs.delta_sweep(smoother, [-1.0, 0.0, 1.0], "filtered")[:, 0, 0].round(4)
    array([0.2053, 0.1248, 0.0897])
    """
    validation.instance("smoother", smoother, Estimator)
    slopes = validation.array("nonlinearities", nonlinearities, ndim=1)
    validation.choice("output", output, OUTPUTS)
    plant = smoother.plant
    pattern = plant.structured_delta((), [1.0] * plant.system.g)
    _check_norm(_norm(plant, pattern) * np.abs(slopes).max(initial=0.0))
    result = np.empty((slopes.size, plant.system.m, plant.system.m))
    chunk = max(_BATCH // (plant.n + len(smoother.A_c)) ** 2, 1)
    for start in range(0, slopes.size, chunk):
        some = slice(start, start + chunk)
        A, B = _closed(smoother, slopes[some, None, None] * pattern, loop)
        _check_stability(A)
        result[some] = _error_covariance(smoother, A, B, output)
    return result
