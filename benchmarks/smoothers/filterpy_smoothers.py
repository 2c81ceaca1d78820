"""filterpy: its Kalman filter with a delay line, its fixed-lag smoother, and its RTS smoother."""

import numpy as np

from benchmarks.problem import Unavailable
from benchmarks.smoothers.problem import FIXED_LAG, WHOLE, Run, Sampled, Smoother

GAINS = (
    "FixedLagSmoother of filterpy 2.0.0 starts its gains from the updated covariance, where "
    "D. Simon, Optimal State Estimation, 2006, has the predicted one, and smooths nothing before "
    "the lag has passed"
)


def filled(make, model: Sampled, *arguments):
    """Return one of its estimators with the model in it."""
    try:
        from filterpy import kalman
    except ImportError:
        raise Unavailable("filterpy is not installed") from None
    estimator = getattr(kalman, make)(len(model.F), 1, *arguments)
    estimator.F, estimator.Q, estimator.H, estimator.R = model.F, model.Q, model.h, model.R
    estimator.x, estimator.P = np.zeros((len(model.F), 1)), model.stationary
    return estimator


def with_delay_line(model: Sampled) -> Run:
    """Return the filter of the system with a delay line, sample by sample."""
    line = model.with_delay_line()
    filled("KalmanFilter", line)

    def run(y):
        estimator, estimates = filled("KalmanFilter", line), np.empty(len(y))
        for k, row in enumerate(y):
            estimator.predict()
            estimator.update(row)
            estimates[k] = (line.c @ estimator.x)[0, 0]
        return estimates

    return run


def fixed_lag(model: Sampled) -> Run:
    """Return its fixed-lag smoother, whose last estimate is N - 1 samples old."""
    filled("FixedLagSmoother", model)

    def run(y):
        estimator = filled("FixedLagSmoother", model, model.lag + 1)
        for row in y:
            estimator.smooth(row)
        states = np.array(estimator.xSmooth)[: len(y) - model.lag, :, 0]
        return np.concatenate([np.zeros(model.lag), states @ model.c[0]])

    return run


def rauch_tung_striebel(model: Sampled) -> Run:
    """Return its filter and the backward pass over the whole record."""
    filled("KalmanFilter", model)

    def run(y):
        estimator = filled("KalmanFilter", model)
        means, covariances, _, _ = estimator.batch_filter(y)
        return estimator.rts_smoother(means, covariances)[0][:, :, 0] @ model.c[0]

    return run


SMOOTHERS = (
    Smoother("filterpy, KalmanFilter, delay line", FIXED_LAG, with_delay_line),
    Smoother("filterpy, FixedLagSmoother", FIXED_LAG, fixed_lag, GAINS),
    Smoother("filterpy, rts_smoother", WHOLE, rauch_tung_striebel),
)
