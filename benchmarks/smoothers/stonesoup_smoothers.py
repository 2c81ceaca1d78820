"""Stone Soup: its Kalman filter with a delay line, and its Kalman smoother of a track."""

from datetime import datetime, timedelta

import numpy as np

from benchmarks.problem import Unavailable
from benchmarks.smoothers.problem import FIXED_LAG, WHOLE, Run, Sampled, Smoother

START, INTERVAL = datetime(2000, 1, 1), timedelta(seconds=1)  # the model does not use time


def tracker(model: Sampled):
    """Return a function from a record to the track of filtered states, and the transition."""
    try:
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
        from stonesoup.predictor.kalman import KalmanPredictor
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.state import GaussianState
        from stonesoup.types.track import Track
        from stonesoup.updater.kalman import KalmanUpdater
    except ImportError:
        raise Unavailable("Stone Soup is not installed") from None
    n = len(model.F)
    transition = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=model.F, covariance_matrix=model.Q
    )
    measured = LinearGaussian(n, list(np.flatnonzero(model.h[0])), model.R)  # h has one 1
    predictor, updater = KalmanPredictor(transition), KalmanUpdater(measured)

    def track(y):
        state = GaussianState(np.zeros((n, 1)), model.stationary, timestamp=START)
        states = Track()
        for k, row in enumerate(y):
            time = START + (k + 1) * INTERVAL
            predicted = predictor.predict(state, timestamp=time)
            detection = Detection(row[:, None], timestamp=time, measurement_model=measured)
            state = updater.update(SingleHypothesis(predicted, detection))
            states.append(state)
        return states

    return track, transition


def read(model: Sampled, states):
    """Return the outputs of states."""
    return np.array([(model.c @ state.state_vector)[0, 0] for state in states])


def with_delay_line(model: Sampled) -> Run:
    """Return the filter of the system with a delay line."""
    line = model.with_delay_line()
    track, _ = tracker(line)
    return lambda y: read(line, track(y))


def whole_record(model: Sampled) -> Run:
    """Return the smoother of the whole track."""
    track, transition = tracker(model)
    from stonesoup.smoother.kalman import KalmanSmoother

    return lambda y: read(model, KalmanSmoother(transition).smooth(track(y)))


SMOOTHERS = (
    Smoother("Stone Soup, Kalman, delay line", FIXED_LAG, with_delay_line),
    Smoother("Stone Soup, KalmanSmoother", WHOLE, whole_record),
)
