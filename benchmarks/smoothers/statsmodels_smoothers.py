"""statsmodels: its compiled Kalman filter with a delay line, and its Kalman smoother.

Once the covariance has converged it is computed no more. The tolerance is a squared norm; with that
of the package, 1e-19, the estimates would be off by 1e-8.
"""

import numpy as np

from benchmarks.problem import Unavailable
from benchmarks.smoothers.problem import FIXED_LAG, WHOLE, Run, Sampled, Smoother

CONVERGED = 1e-28


def bound(make: str, model: Sampled, y):
    """Return one of its estimators with the model and a record in it."""
    try:
        from statsmodels.tsa.statespace import kalman_filter, kalman_smoother
    except ImportError:
        raise Unavailable("statsmodels is not installed") from None
    n = len(model.F)
    kind = getattr(kalman_filter if make == "KalmanFilter" else kalman_smoother, make)
    estimator = kind(k_endog=1, k_states=n, tolerance=CONVERGED)
    estimator.bind(y)
    named = {"design": model.h, "transition": model.F, "selection": np.eye(n)}
    for name, matrix in (named | {"state_cov": model.Q, "obs_cov": model.R}).items():
        estimator[name] = matrix
    estimator.initialize_known(np.zeros(n), model.stationary)
    return estimator


def with_delay_line(model: Sampled) -> Run:
    """Return the filter of the system with a delay line."""
    line = model.with_delay_line()
    bound("KalmanFilter", line, np.zeros((1, 1)))
    return lambda y: line.c[0] @ bound("KalmanFilter", line, y).filter().filtered_state


def whole_record(model: Sampled) -> Run:
    """Return the smoother, which is asked for states and nothing else."""
    bound("KalmanSmoother", model, np.zeros((1, 1)))

    def run(y):
        estimator = bound("KalmanSmoother", model, y)
        return model.c[0] @ estimator.smooth(smoother_output=1).smoothed_state

    return run


SMOOTHERS = (
    Smoother("statsmodels, KalmanFilter, delay line", FIXED_LAG, with_delay_line),
    Smoother("statsmodels, KalmanSmoother", WHOLE, whole_record),
)
