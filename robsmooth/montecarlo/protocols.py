r"""When the errors are collected, and what is made of them.

Both errors of a path are sampled at some steps :math:`k` of its simulation,

.. math::

    e_f = \varphi(t_k) - \hat w(t_k),\qquad e_s = \varphi(t_k - \delta) - C_a\hat x(t_k),

and the path's result is the mean of their squares over the samples. The *paper* protocol takes one
sample, at the end of the path. The *ergodic* one lets the loop forget its start and then samples
along the path. Paths are independent: over N of them, with :math:`v_i` the result of path i,

.. math::

    \overline v = \frac1N\sum_i v_i,\qquad
    \text{standard error} = \sqrt{\frac{\sum_i (v_i - \overline v)^2}{N(N - 1)}} .
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

from robsmooth.errors import UnstableLoopError
from robsmooth.loop import Loop

PROTOCOLS = ("ergodic", "paper")
WARM_UP_TOLERANCE = 1e-3  # relative, of the linearised loop's variances, when sampling begins
SAMPLES_PER_TIME_CONSTANT = 2  # of the loop's fastest mode: more samples tell nothing new


class Schedule(NamedTuple):
    """When to sample, in steps: the order of the fields is the kernels' contract.

    The phase is recorded first after `start` steps and then every `stride` steps; the errors are
    sampled `samples` times, first when the recorded phase is `lag` records old.
    """

    start: int
    stride: int
    lag: int
    samples: int

    @property
    def steps(self) -> int:
        """Steps of a path."""
        return self.start + (self.lag + self.samples - 1) * self.stride


def end_of_run(steps: int, delay: int) -> Schedule:
    """One sample after `steps` steps, for a lag of `delay` steps."""
    return Schedule(start=steps - delay, stride=max(delay, 1), lag=min(delay, 1), samples=1)


def time_average(warm_up: int, steps: int, delay: int, longest_stride: int) -> Schedule:
    """Samples along `steps` steps after `warm_up` steps, for a lag of `delay` steps.

    The stride must divide the delay, and is the longest such up to `longest_stride`.
    """
    longest_stride = max(1, min(longest_stride, steps))
    if delay == 0:
        stride = longest_stride
    else:
        stride = max(s for s in range(1, min(longest_stride, delay) + 1) if delay % s == 0)
    return Schedule(
        start=max(warm_up - delay, 0),
        stride=stride,
        lag=delay // stride,
        samples=math.ceil(steps / stride),
    )


def warm_up_time(loop: Loop) -> float:
    r"""Time for the linearised loop to become stationary from a start at zero, s.

    From zero, the covariance of :math:`z = (\varphi, \hat x)` is :math:`P - e^{At}Pe^{A't}` after a
    time t, with P the stationary one. The time is the first, doubling, at which the variances of
    both errors are within a relative `WARM_UP_TOLERANCE` of their stationary values.

    Raises
    ------
    UnstableLoopError
        Where the linearised loop has no stationary state.
    """
    drift = loop.linearised_drift()
    slowest = -np.linalg.eigvals(drift).real.max()
    if not slowest > 0:
        raise UnstableLoopError(
            "the ergodic protocol needs a loop with a stationary state, and the linearised loop is "
            f"not stable: its slowest mode has the decay rate {slowest:.3g} 1/s"
        )
    # In units of the fastest time constant, so that the result does not depend on the unit of time.
    scale = np.abs(np.linalg.eigvals(drift)).max()
    covariance = solve_continuous_lyapunov(drift / scale, -loop.noise_covariance() / scale)
    to_delayed = expm(drift * loop.delay)  # E[z(t)] from z(t - delay)
    filtered = np.concatenate([[1.0], -loop.filtered])
    smoothed = np.concatenate([[0.0], -loop.smoothed])

    def error_variances(then: NDArray, now: NDArray) -> NDArray:
        """Of both errors, from the covariances of z a delay ago and now."""
        cross = (to_delayed @ then)[:, 0]  # of z(t) and the phase a delay ago
        lagged = then[0, 0] + 2 * smoothed @ cross + smoothed @ now @ smoothed
        return np.array([filtered @ now @ filtered, lagged])

    stationary = error_variances(covariance, covariance)
    time = 1 / scale
    while True:
        decay = expm(drift * time)
        then = decay @ covariance @ decay.T
        missing = error_variances(then, to_delayed @ then @ to_delayed.T)
        if (np.abs(missing) <= WARM_UP_TOLERANCE * np.abs(stationary)).all():
            return time + loop.delay
        time *= 2


@dataclass(frozen=True)
class MeanSquare:
    """A mean square error over independent paths.

    Attributes
    ----------
    mean_square : float
        rad^2.
    standard_error : float
        rad^2; not a number for a single path.
    """

    mean_square: float
    standard_error: float


class Moments:
    """Mean and spread of values that come block by block, independent of how blocks are batched."""

    def __init__(self):
        self.count = 0
        self.mean = 0.0
        self.squares = 0.0  # sum of squared deviations from the mean

    def add(self, values: NDArray[np.float64]) -> None:
        """Add the values of one block (Chan, Golub and LeVeque's update)."""
        count = self.count + len(values)
        mean = float(values.mean())
        shift = mean - self.mean
        spread = float(((values - mean) ** 2).sum())
        self.squares += spread + shift**2 * self.count * len(values) / count
        self.mean += shift * len(values) / count
        self.count = count

    def mean_square(self) -> MeanSquare:
        """Mean and standard error of what was added."""
        if self.count < 2:
            return MeanSquare(self.mean, math.nan)
        return MeanSquare(self.mean, math.sqrt(self.squares / (self.count - 1) / self.count))
