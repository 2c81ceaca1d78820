r"""Closed loop, stationary error covariance, and the worst constant uncertainty (Section III-A).

The terms of (eqCo) nearly cancel where the estimate is good. Here they are those of the state
:math:`[x_p;\; x_p - \hat x_p]`, in a sum that cannot cancel (`docs/source/numerics.md`).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import ArrayLike, NDArray

from robsmooth._numerics.lyapunov import check_certainty, covariances
from robsmooth._numerics.modes import hardly_decays
from robsmooth._support import plots, tables, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.errors import UnstableLoopError
from robsmooth._support.validation import Frozen, Matrix
from robsmooth.estimators import loop as loops
from robsmooth.estimators.constant import mean_square, worst_delta
from robsmooth.estimators.estimator import Estimator
from robsmooth.systems.augmented import AugmentedSystem

_BATCH = 200_000  # entries of drift matrices that a sweep has in memory at once
_NORM_ERROR = 1e-12
_STARTS = 16  # corners of the admissible set to search from, besides its centre


def closed_loop(
    estimator: Estimator, Delta: Matrix, loop: str = "theory", reference: loops.Reference = None
) -> tuple[Matrix, Matrix]:
    """Return A and B of dX = A X dt + B dW, X = [x_p; x_hat], for one Delta or (N, ., .) many."""
    A, B, inputs, outputs = loops.matrices(estimator, loop, reference)
    return A + inputs @ Delta @ outputs, B


def _check_norm(plant: AugmentedSystem, Delta: Matrix) -> None:
    """Refuse a norm above one; nonlinearities are in units of their Lipschitz constants."""
    constants = [c.lipschitz for c in plant.system.nonlinearities]
    weights = np.array([1.0] * (Delta.shape[1] - 2 * len(constants)) + 2 * constants)
    norm = float(np.linalg.norm(Delta / weights, 2)) if Delta.size else 0.0
    if norm > 1.0 + _NORM_ERROR:
        what = "with columns of nonlinearities divided by their Lipschitz constants"
        advice = "allow_inadmissible=True lifts this limit"
        raise ValueError(f"Delta must have norm at most 1, {what}, got {norm:.6g}; {advice}")


def _stationary_error(A: Matrix, B: Matrix, estimator: Estimator, output: str) -> Matrix:
    """Return the (..., m, m) stationary covariance of an error, for one A or several."""
    truth, estimate, delay = loops.error_rows(estimator, output)
    n, n_c = estimator.plant.n, len(estimator.A_c)
    T = np.eye(n + n_c)  # an estimator of another order has no such error
    if n == n_c:
        T = np.kron([[1.0, 0.0], [1.0, -1.0]], np.eye(n))
    past, now = truth @ T, estimate @ T
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that runs away
            found = covariances(T @ A @ T, T @ B, delay)  # T is its own inverse
            past = past - now @ found.transition
            since = found.error - _squared(found.transition, found.error)
            result = _squared(past, found.stationary) + _squared(now, found.grown)
            error = _squared(past, found.error) + _squared(now, since)
            check_certainty("the error covariance", result, error)
            return result
    except (UnstableLoopError, ArithmeticError):
        if not hardly_decays(np.linalg.eigvals(A)):
            raise
    if A.ndim > 2:
        return np.array([_stationary_error(each, B, estimator, output) for each in A])
    result, error = loops.drifting_error(A, B, truth, estimate, delay)
    check_certainty("the error covariance", result, error)
    return result


def _squared(C: Matrix, P: Matrix) -> Matrix:
    """Return C P C', symmetric."""
    result = C @ P @ C.mT
    return (result + result.mT) / 2


@one_thread
def error_covariance(
    smoother: Estimator,
    Delta: ArrayLike,
    output: str = "smoothed",
    loop: str = "theory",
    allow_inadmissible: bool = False,
    reference: loops.Reference = None,
    *,
    copy_noise: bool | None = None,
) -> Matrix:
    r"""Return the (m, m) stationary error covariance (eqCo) under a constant uncertainty.

    Parameters
    ----------
    smoother : Estimator, any design of this package
    Delta : (r + 2g, h + 2g) array
        :math:`\tilde\xi = \Delta\tilde\zeta`, of norm at most one with the outputs of the
        nonlinearities weighted by their Lipschitz constants. That is necessary to be admissible,
        not sufficient: bounds hold for those that `AugmentedSystem.structured_delta` makes.
    output : {"smoothed", "filtered", "guaranteed"}
        The error of the smoothed estimate one lag back, of the filtered one now, or the one that a
        `RobustSmoother` bounds: the filtered one where its cost is "filtered", else that of w-hat
        against the output of the delay model.
    loop : {"theory", "real"}, with the copies' fictitious noise, as in the paper, or without
    allow_inadmissible : bool, whether a Delta with norm above one is allowed
    reference : {"system", "filtered", "smoothed"}, (g, n_c) array or None
        What is subtracted from the nonlinearities' arguments, as in `simulate`; None in the paper.
    copy_noise : bool, optional, in place of `loop`: True for "theory", False for "real"

    Returns
    -------
    (m, m) array, in the squared unit of w

    Raises
    ------
    UnstableLoopError
        Where the closed loop is not asymptotically stable.
    ArithmeticError
        Where the estimated rounding error is above a millionth of a variance.

    Examples
    --------
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.design_smoother(plant, 1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6])
    >>> rs.error_covariance(smoother, plant.structured_delta([], [-0.5]), loop="real").round(4)
    array([[0.0609]])
    """
    validation.instance("smoother", smoother, Estimator)
    plant = smoother.plant
    Delta = validation.matrix("Delta", Delta, (plant.B1_tilde.shape[1], len(plant.C1_tilde)))
    if not allow_inadmissible:
        _check_norm(plant, Delta)
    A, B = closed_loop(smoother, Delta, loops.which_loop(loop, copy_noise), reference)
    return _stationary_error(A, B, smoother, output)


@dataclass(frozen=True, eq=False, repr=False)
class DeltaSweep(Frozen, NDArrayOperatorsMixin):
    """The (N, m, m) covariances of `delta_sweep` at (N,) slopes; it can be used as an array."""

    nonlinearities: NDArray[np.float64]
    covariances: NDArray[np.float64]
    output: str

    @property
    def mean_square(self) -> NDArray[np.float64]:
        """(N,) array, the mean square errors: the traces of the covariances."""
        return np.trace(self.covariances, axis1=1, axis2=2)

    def to_frame(self) -> "tables.DataFrame":
        """Return the mean square errors as a pandas data frame."""
        return tables.data_frame({"slope": self.nonlinearities}, {"mean_square": self.mean_square})

    def plot(self, ax: "plots.Axes | None" = None, label: str | None = None) -> "plots.Axes":
        """Draw the mean square errors over the slopes; matplotlib is needed."""
        labels = {"xlabel": r"slope $\Delta_2$", "ylabel": plots.MEAN_SQUARE}
        curve = {self.output if label is None else validation.line(label): self.mean_square}
        return plots.draw_curves(ax, self.nonlinearities, curve, **labels)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.float64]:
        return np.array(self.covariances, dtype=dtype, copy=copy)

    def __getitem__(self, index: Any) -> Any:
        return self.covariances[index]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # of pickle and NumPy
            raise AttributeError(name)
        return getattr(self.covariances, name)

    def __repr__(self) -> str:
        return repr(self.covariances)


@one_thread
def delta_sweep(
    smoother: Estimator,
    nonlinearities: Iterable[float],
    output: str = "smoothed",
    loop: str = "theory",
) -> DeltaSweep:
    """Return the error covariance for each slope of the nonlinearities, as in Fig. 4.

    Parameters
    ----------
    smoother : Estimator
    nonlinearities : (N,) array
        The paper's Delta_2 in [-1, 1], of all nonlinearities and copies. Uncertainties are zero.
    output, loop : as in `error_covariance`, which has the exceptions, too

    Returns
    -------
    DeltaSweep, of (N, m, m) covariances

    Examples
    --------
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> rs.delta_sweep(kalman, [-1.0, 0.0, 1.0], "filtered")[:, 0, 0].round(4)
    array([0.4475, 0.0844, 0.3813])
    """
    validation.instance("smoother", smoother, Estimator)
    slopes = validation.array("nonlinearities", nonlinearities, ndim=1)
    plant = smoother.plant
    if not plant.system.g:
        raise ValueError("smoother must be of a system with nonlinearities; see error_covariance")
    pattern = plant.structured_delta((), [1.0] * plant.system.g)
    _check_norm(plant, np.abs(slopes).max(initial=0.0) * pattern)
    size = slopes.size * (plant.n + len(smoother.A_c)) ** 2
    parts = np.array_split(slopes[:, None, None], 1 + size // _BATCH)
    loops = (closed_loop(smoother, part * pattern, loop) for part in parts)
    covariances = np.concatenate([_stationary_error(*each, smoother, output) for each in loops])
    return DeltaSweep(slopes, covariances, output)


@dataclass(frozen=True, eq=False)
class WorstCase(Frozen):
    """The worst constant uncertainty, as `worst_case` finds it.

    Attributes
    ----------
    Delta : (r + 2g, h + 2g) array, with zero blocks for channels without an effect
    mean_square, nominal : float, in the squared unit of w
        The mean square error under it and without uncertainty; infinity in an unstable loop.
    """

    Delta: Matrix
    mean_square: float
    nominal: float

    def __repr__(self) -> str:
        return f"WorstCase(mean_square={self.mean_square:.5g}, nominal={self.nominal:.5g})"


@one_thread
def worst_case(smoother: Estimator, output: str = "smoothed", loop: str = "theory") -> WorstCase:
    """Search for the constant admissible uncertainty with the largest mean square error.

    Parameters
    ----------
    smoother, output, loop : as in `error_covariance`

    Examples
    --------
    >>> ngcf = rs.baselines.ngcf(rs.homodyne.PAPER.uncertain_system())
    >>> rs.worst_case(ngcf, "filtered")
    WorstCase(mean_square=0.2053, nominal=0.12483)
    """
    opened, _ = loops.scaled(loops.open_loop(smoother, output, loop))
    _, Delta = worst_delta(opened, _STARTS)

    def error(Delta: Matrix) -> float:
        if not np.isfinite(mean_square(opened, Delta)):
            return np.inf
        return float(np.trace(error_covariance(smoother, Delta, output, loop)))

    return WorstCase(Delta, error(Delta), error(np.zeros_like(Delta)))
