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

The paper drives the copies with the fictitious noise of the design. A real loop has no such noise:
`copy_noise=False` leaves it out.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from robsmooth._numerics import linearisation
from robsmooth._numerics.lyapunov import check_certainty, covariances
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import Reference, argument_weights, matrices
from robsmooth.systems.augmented import AugmentedSystem

OUTPUTS = ("smoothed", "filtered")
_BATCH = 200_000  # entries of the drifts of a sweep that are worked on at once
_ROUNDING = 1e-12  # of eigenvalues, relative to the largest entry
_FAR = 1e3  # times the variance at the tangent: no statistical linearisation holds there
_CONVERGED, _ITERATIONS = 1e-13, 1000  # of the slopes of statistical linearisation


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
        """Return the (m, m) stationary covariance of the smoothed or filtered error."""
        return _error_covariance(self.estimator, self.A, self.B, output)


def closed_loop(
    estimator: Estimator,
    Delta: ArrayLike,
    copy_noise: bool = True,
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
    copy_noise : bool
        Whether the design's fictitious noise drives the copies of the nonlinearities.
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
    A, B = _loop(estimator, Delta, copy_noise, reference)
    _check_stability(A)
    return ClosedLoop(A, B, estimator)


def _norm(plant: AugmentedSystem, Delta: Matrix) -> float:
    """Return the norm of Delta, in which the nonlinearities' Lipschitz constants are units."""
    constants = [c.lipschitz for c in plant.system.nonlinearities]
    ones = [1.0] * (Delta.shape[1] - 2 * len(constants))
    weights = np.array([*ones, *constants, *constants])
    return float(np.linalg.norm(Delta / weights, 2)) if Delta.size else 0.0


def _check_norm(norm: float) -> None:
    if norm > 1.0 + 1e-12:
        raise ValueError(
            f"Delta must have norm at most 1 to be admissible, got {norm:.6g} (columns of "
            "nonlinearities count divided by their Lipschitz constants); "
            "allow_inadmissible=True computes it all the same"
        )


def _check_stability(A: Matrix) -> None:
    """Refuse a loop that is clearly unstable; what rounding hides, its covariance will tell."""
    abscissa = np.linalg.eigvals(A).real.max()
    if not abscissa < _ROUNDING * np.abs(A).max():
        raise UnstableLoopError(
            f"the closed loop is not stable: it has an eigenvalue with real part {abscissa:.4g} 1/s"
        )


def _loop(
    estimator: Estimator, Delta: Matrix, copy_noise: bool, reference: Reference = None
) -> tuple[Matrix, Matrix]:
    """Return A and B of (eqclosed), for one Delta or (N, ., .) of them."""
    A, B, inputs, outputs = matrices(estimator, copy_noise, reference)
    return A + inputs @ Delta @ outputs, B


def _error_coordinates(estimator: Estimator) -> Matrix:
    """Return T = inv(T) with T [x_p; x_hat] = [x_p; x_p - x_hat]."""
    n, n_c = estimator.plant.n, len(estimator.A_c)
    if n != n_c:
        return np.eye(n + n_c)  # of an estimator of another order there is no such error
    return np.kron([[1.0, 0.0], [1.0, -1.0]], np.eye(n))


def _error_covariance(estimator: Estimator, A: Matrix, B: Matrix, output: str) -> Matrix:
    """Return the (..., m, m) error covariance of one loop, or of many with drifts A."""
    plant, T = estimator.plant, _error_coordinates(estimator)
    estimate = estimator.C_a if output == "smoothed" else estimator.C_f
    truth = np.hstack([plant.C_p0, np.zeros_like(estimate)]) @ T
    estimate = np.hstack([np.zeros_like(plant.C_p0), estimate]) @ T
    B = T @ B
    found = covariances(T @ A @ T, B, plant.delay if output == "smoothed" else 0.0)
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
    copy_noise: bool = True,
    allow_inadmissible: bool = False,
    reference: Reference = None,
) -> Matrix:
    r"""Return the stationary error covariance under a constant uncertainty.

    Parameters
    ----------
    smoother : Estimator
        Any design of this package.
    Delta : (r + 2g, h + 2g) array
        :math:`\tilde\xi = \Delta\tilde\zeta`, of norm at most one, as in `closed_loop`.
    output : {"smoothed", "filtered"}
        The error of the smoothed estimate one lag back, or of the filtered one now.
    copy_noise : bool
        Whether the design's fictitious noise drives the copies, as in the paper's formula.
    allow_inadmissible : bool
        Whether a Delta with norm above one is let through.
    reference : {"system", "filtered", "smoothed"}, (g, n_c) array or None
        What is taken off the nonlinearities' arguments, as in `simulate`. The paper's formula has
        no reference.

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

    References
    ----------
    Section III-A, equation (eqCo).
    """
    output = validation.choice("output", output, OUTPUTS)
    loop = closed_loop(smoother, Delta, copy_noise, allow_inadmissible, reference)
    return loop.error_covariance(output)


@one_thread
def delta_sweep(
    smoother: Estimator,
    nonlinearities: Iterable[float],
    output: str = "smoothed",
    copy_noise: bool = True,
) -> NDArray[np.float64]:
    """Return the error covariance for each slope of the nonlinearities, as in Fig. 4.

    Parameters
    ----------
    smoother : Estimator
        Any design of this package.
    nonlinearities : (N,) array
        The paper's Delta_2 in [-1, 1], the same for every nonlinearity and its copy; the
        uncertainties are zero.
    output, copy_noise
        As in `error_covariance`.

    Returns
    -------
    (N, m, m) array

    Raises
    ------
    UnstableLoopError, ArithmeticError, ValueError, TypeError
        As `error_covariance`, where it would at any of them.
    """
    validation.instance("smoother", smoother, Estimator)
    slopes = validation.array("nonlinearities", nonlinearities, ndim=1)
    output = validation.choice("output", output, OUTPUTS)
    plant = smoother.plant
    pattern = plant.structured_delta((), [1.0] * plant.system.g)
    _check_norm(_norm(plant, pattern) * np.abs(slopes).max(initial=0.0))
    result = np.empty((slopes.size, plant.system.m, plant.system.m))
    chunk = max(_BATCH // (plant.n + len(smoother.A_c)) ** 2, 1)
    for start in range(0, slopes.size, chunk):
        some = slice(start, start + chunk)
        A, B = _loop(smoother, slopes[some, None, None] * pattern, copy_noise)
        _check_stability(A)
        result[some] = _error_covariance(smoother, A, B, output)
    return result


@dataclass(frozen=True)
class StatisticalLinearisation:
    """The stationary nonlinear loop, each nonlinearity replaced by its equivalent gain.

    Attributes
    ----------
    slope : float
        The equivalent Delta_2 of the nonlinearity.
    filtered, smoothed : float
        Mean square errors, in the squared unit of w.
    copy_slope : float
        The equivalent Delta_2 of the estimator's copy of the nonlinearity.
    """

    slope: float
    filtered: float
    smoothed: float
    copy_slope: float


@one_thread
def statistical_linearisation(
    smoother: Estimator,
    equivalent_slope: Callable[[float], float],
    reference: Reference = "system",
) -> StatisticalLinearisation:
    r"""Predict the errors of the nonlinear loop, from slopes that belong to its own variances.

    The nonlinearity, and the copy of it, are replaced by slopes that depend on the variances of
    their arguments, which are those of the linear loop with these slopes
    (`robsmooth._numerics.linearisation` iterates). In the homodyne loop the argument is the
    filtered error, of variance P = P(slope(P)).

    Parameters
    ----------
    smoother : Estimator
        A design for a plant with one output and one nonlinearity, of a multiple of it.
    equivalent_slope : callable
        Maps the variance of the argument, in the squared unit of w, to the nonlinearity's
        equivalent Delta_2. For the homodyne loop `HomodyneParameters.equivalent_slope`: the
        Gaussian mean of the slope of :math:`\sin e` is :math:`e^{-P/2}`.
    reference : {"system", "filtered", "smoothed"}, (1, n_c) array or None
        What is taken off the argument, as in `simulate`.

    Returns
    -------
    StatisticalLinearisation

    Raises
    ------
    UnstableLoopError
        Where no self-consistent variance exists: the linearised loop loses lock.
    ValueError, TypeError
        For another kind of plant or reference, or an `equivalent_slope` that is not callable or
        does not return a finite number.
    """
    validation.instance("smoother", smoother, Estimator)
    plant = smoother.plant
    if plant.system.m != 1 or plant.system.g != 1:
        raise ValueError(
            "statistical linearisation takes one output and one nonlinearity, got "
            f"m={plant.system.m} and g={plant.system.g}"
        )
    unit = argument_weights(plant.system, 0)
    if unit is None or not unit.any():
        raise ValueError(
            "the argument of nonlinearities[0] must be a multiple of the output w, whose units "
            f"equivalent_slope takes: got C = {plant.system.nonlinearities[0].C[0]} and "
            f"C0 = {plant.system.C0[0]}"
        )
    if not callable(equivalent_slope):
        raise TypeError(f"equivalent_slope must be callable, got {equivalent_slope!r}")

    def slopes(variances: Matrix) -> Matrix:
        return np.array(
            [
                validation.real("equivalent_slope of a variance", equivalent_slope(float(variance)))
                for variance in variances
            ]
        )

    def loop(slopes: Matrix) -> ClosedLoop:
        Delta = plant.structured_delta((), [0.0])
        Delta[-2:, -2:] = np.diag(slopes)
        return closed_loop(smoother, Delta, False, allow_inadmissible=True, reference=reference)

    arguments = matrices(smoother, False, reference)[3][-2:] / unit

    def variances(slopes: Matrix) -> Matrix:
        return np.maximum(np.diag(loop(slopes).covariance_of(arguments)), 0.0)

    start = slopes(np.zeros(2))
    found = linearisation.equivalent_slopes(
        start,
        variances,
        slopes,
        tolerance=_CONVERGED,
        iterations=_ITERATIONS,
        largest=_FAR * variances(start).max(),
    )
    errors = {name: float(loop(found).error_covariance(name)[0, 0]) for name in OUTPUTS}
    return StatisticalLinearisation(slope=float(found[0]), copy_slope=float(found[1]), **errors)
