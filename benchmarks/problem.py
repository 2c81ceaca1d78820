"""The literal protocol of the paper, as every peer gets it, and what a peer gives back."""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from robsmooth import homodyne
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.montecarlo import MeanSquare
from robsmooth.paper import published

STEP = 1e-8  # s
STEPS = 100_000  # of a path
RUNS = 50_000
# Smaller coefficients of a step are what a cancellation left. In single precision they would be
# denormal numbers, with which arithmetic is slow.
RESIDUE = 1e-30


@dataclass(frozen=True, eq=False)
class Problem:
    r"""An Euler-Maruyama step of the loop in `robsmooth.homodyne.loop`, and the errors at the end.

    .. math::

        \varphi &\leftarrow \varphi + a\varphi + q\,g_2,\\
        \hat x &\leftarrow \hat x + F\hat x + b_s\sin(\varphi - r\hat x) + b_c\sin(c\hat x)
                 + b_w g_1,

    from zero, with the old values on the right and :math:`g_1, g_2` standard normal. The filtered
    error is the phase less the filtered estimate; the smoothed one is the phase `delay` steps
    before the end less the smoothed estimate at the end.

    Parameters
    ----------
    decay, diffusion : float
        :math:`a` and :math:`q`.
    drift : (n, n) array
        :math:`F`.
    reference, copy : (n,) arrays
        :math:`r` and :math:`c`.
    sine_gain, copy_gain, noise_gain : (n,) arrays
        :math:`b_s`, :math:`b_c` and :math:`b_w`.
    filtered, smoothed : (n,) arrays
        Rows that read the estimates out of the state.
    delay : int
        In steps.
    smoother : Estimator
    """

    decay: float
    diffusion: float
    drift: NDArray
    reference: NDArray
    copy: NDArray
    sine_gain: NDArray
    copy_gain: NDArray
    noise_gain: NDArray
    filtered: NDArray
    smoothed: NDArray
    delay: int
    smoother: Estimator

    @property
    def order(self) -> int:
        """Number of states of the estimator."""
        return len(self.reference)

    def astype(self, real: type) -> "Problem":
        """Return the same with its numbers in another precision."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, value in values.items():
            if name not in ("delay", "smoother"):
                values[name] = real(value) if np.ndim(value) == 0 else value.astype(real)
        return Problem(**values)

    def sample(self, phase: NDArray, delayed: NDArray, state: NDArray) -> "Sample":
        """Return the statistics of phase, phase a delay ago (N,) and state (n, N) at the end."""
        state = np.asarray(state, dtype=float)
        return Sample.of(
            np.square(phase - self.filtered @ state), np.square(delayed - self.smoothed @ state)
        )


def literal_problem() -> Problem:
    """Return the protocol's own: the smoother as printed, at a step of 0.01 us."""
    smoother = published.recomputed_estimator()
    loop = homodyne_loop(homodyne.PAPER, smoother)
    root = np.sqrt(STEP)

    def clean(values: NDArray) -> NDArray:
        return np.where(np.abs(values) < RESIDUE, 0.0, values)

    return Problem(
        decay=STEP * loop.drift[0, 0],
        diffusion=root * loop.noise[0, 0],
        drift=clean(STEP * loop.drift[1:, 1:]),
        reference=clean(-loop.arguments[0, 1:]),
        copy=clean(loop.arguments[1, 1:]),
        sine_gain=clean(STEP * loop.gains[1:, 0]),
        copy_gain=clean(STEP * loop.gains[1:, 1]),
        noise_gain=clean(root * loop.noise[1:, 1]),
        filtered=clean(loop.readout[0]),
        smoothed=clean(loop.readout[1]),
        delay=round(loop.delay / STEP),
        smoother=smoother,
    )


@dataclass(frozen=True)
class Sample:
    """What a peer found.

    Attributes
    ----------
    paths : int
        Simulated; at least as many as asked for.
    filtered, smoothed : MeanSquare
    seconds : float, optional
        Where the peer is the only one who knows how long it took.
    """

    paths: int
    filtered: MeanSquare
    smoothed: MeanSquare
    seconds: float | None = None

    @classmethod
    def of(cls, *squares: NDArray) -> "Sample":
        """Return the statistics of the filtered and the smoothed squared errors of all paths."""
        paths = len(squares[0])
        means = (MeanSquare(float(v.mean()), float(v.std(ddof=1)) / paths**0.5) for v in squares)
        return cls(paths, *means)


Simulate = Callable[[int, int, int], Sample]  # of paths, steps and a seed


@dataclass(frozen=True)
class Peer:
    """A way to simulate.

    Attributes
    ----------
    name : str
    prepare : callable
        From a Problem to what simulates it; raises `Unavailable` where this machine cannot.
    width : int
        The paths it is best at having side by side; it simulates multiples of it.
    """

    name: str
    prepare: Callable[[Problem], Simulate]
    width: int


class Unavailable(Exception):
    """Why a peer cannot run here."""


def segments(problem: Problem, steps: int) -> tuple[int, int]:
    """Return the steps before and after the phase that the smoothed estimate is of."""
    if steps < problem.delay:
        raise ValueError(f"steps must be at least the delay, {problem.delay}, got {steps}")
    return steps - problem.delay, problem.delay


def chunks(paths: int, width: int) -> int:
    """Return how many chunks of `width` paths make at least `paths`."""
    return -(-paths // width)
