r"""Errors of the nonlinear loop from slopes that stand for its nonlinearity.

The nonlinearity, and the copy of it, are replaced by slopes that depend on the variances of their
arguments, which are those of the linear loop with these slopes (`robsmooth._numerics.linearisation`
iterates). In the homodyne loop the argument is the filtered error, of variance P = P(slope(P)).
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
_TOLERANCE, _ITERATIONS = 1e-13, 1000  # of the slopes


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

    See Also
    --------
    robsmooth.statistical_linearisation : Makes it.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.design_smoother(plant, 1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6])
    >>> found = rs.statistical_linearisation(smoother, rs.homodyne.PAPER.equivalent_slope)
    >>> round(found.slope, 4), round(found.copy_slope, 4) + 0.0
    (-0.1078, 0.0)
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

    The copies have no fictitious noise here: the loop is the real one.

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

    See Also
    --------
    simulate : The errors of the nonlinear loop itself.
    robsmooth.stationary_errors : The same for the homodyne loop, by the moments of its state.

    Examples
    --------
    >>> import robsmooth as rs
    >>> plant = rs.augment(rs.homodyne.PAPER.uncertain_system(), delay=3.1e-6, order=2)
    >>> smoother = rs.design_smoother(plant, 1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6])
    >>> found = rs.statistical_linearisation(smoother, rs.homodyne.PAPER.equivalent_slope)
    >>> round(found.filtered, 4), round(found.smoothed, 4)
    (0.0881, 0.0517)
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

    def linear(slopes: Matrix) -> ClosedLoop:
        Delta = plant.structured_delta((), [0.0])
        Delta[-2:, -2:] = np.diag(slopes)
        return closed_loop(smoother, Delta, "real", allow_inadmissible=True, reference=reference)

    arguments = matrices(smoother, "real", reference)[3][-2:] / unit

    def variances(slopes: Matrix) -> Matrix:
        return np.maximum(np.diag(linear(slopes).covariance_of(arguments)), 0.0)

    start = slopes(np.zeros(2))
    found = linearisation.equivalent_slopes(
        start,
        variances,
        slopes,
        tolerance=_TOLERANCE,
        iterations=_ITERATIONS,
        largest=_LARGEST_VARIANCE * variances(start).max(),
    )
    closed = linear(found)
    return StatisticalLinearisation(
        slope=float(found[0]),
        filtered=float(closed.error_covariance("filtered")[0, 0]),
        smoothed=float(closed.error_covariance("smoothed")[0, 0]),
        copy_slope=float(found[1]),
    )
