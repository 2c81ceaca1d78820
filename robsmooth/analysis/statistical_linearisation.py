r"""Errors of the nonlinear loop from slopes that stand for its nonlinearity.

The slopes depend on the variances of their arguments, which are those of the linear loop with these
slopes (`robsmooth._numerics.linearisation` iterates). In the homodyne loop the argument is the
filtered error, of variance P = P(slope(P)).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robsmooth._numerics import linearisation
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.validation import Matrix
from robsmooth.analysis.covariance import ClosedLoop, closed_loop
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import Reference, argument_weights, matrices

_LARGEST_VARIANCE = 1e3  # times that at the tangent: no statistical linearisation holds there


@dataclass(frozen=True)
class StatisticalLinearisation:
    """The stationary nonlinear loop with slopes in place of its nonlinearity and its copy."""

    slope: float  # the equivalent Delta_2 of the nonlinearity
    filtered: float  # mean square errors, in the squared unit of w
    smoothed: float
    copy_slope: float  # the equivalent Delta_2 of the estimator's copy of the nonlinearity


@one_thread
def statistical_linearisation(
    smoother: Estimator, equivalent_slope: Callable[[float], float], reference: Reference = "system"
) -> StatisticalLinearisation:
    r"""Predict the errors of the real nonlinear loop, from slopes that belong to its own variances.

    Parameters
    ----------
    smoother : Estimator
        A design for a plant with one output and one nonlinearity, of a multiple of it.
    equivalent_slope : callable
        Maps the variance of the argument, in the squared unit of w, to the nonlinearity's
        equivalent Delta_2, as `HomodyneParameters.equivalent_slope` does: the Gaussian mean of the
        slope of :math:`\sin e` is :math:`e^{-P/2}`.
    reference : {"system", "filtered", "smoothed"}, (1, n_c) array or None
        What is taken off the argument, as in `simulate`.

    Returns
    -------
    StatisticalLinearisation
        ``slope`` and ``copy_slope``, the equivalent Delta_2 of nonlinearity and copy; ``filtered``
        and ``smoothed``, mean squares in the squared unit of w.

    Raises
    ------
    UnstableLoopError
        Where no self-consistent variance exists: the linearised loop loses lock.

    See Also
    --------
    simulate, stationary_errors : the nonlinear loop itself; the homodyne loop, by its moments.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> found = rs.statistical_linearisation(kalman, rs.homodyne.PAPER.equivalent_slope)
    >>> round(found.slope, 4), round(found.filtered, 4)
    (-0.1077, 0.0881)
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
        found = [equivalent_slope(float(variance)) for variance in variances]
        name = "equivalent_slope of a variance"
        return np.array([validation.real(name, slope) for slope in found])

    def linear(slopes: Matrix) -> ClosedLoop:
        Delta = plant.structured_delta((), [0.0])
        Delta[-2:, -2:] = np.diag(slopes)
        return closed_loop(smoother, Delta, "real", allow_inadmissible=True, reference=reference)

    arguments = matrices(smoother, "real", reference)[3][-2:] / unit

    def variances(slopes: Matrix) -> Matrix:
        return np.maximum(np.diag(linear(slopes).covariance(arguments)), 0.0)

    start = slopes(np.zeros(2))
    largest = _LARGEST_VARIANCE * variances(start).max()
    slope, copy_slope = linearisation.equivalent_slopes(
        start, variances, slopes, tolerance=1e-13, iterations=1000, largest=largest
    )
    closed = linear(np.array([slope, copy_slope]))
    errors = (closed.error_covariance(output).item() for output in ("filtered", "smoothed"))
    return StatisticalLinearisation(float(slope), *errors, float(copy_slope))
