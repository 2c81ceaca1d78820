r"""The two protocols: what is simulated, and what is made of it.

Both errors of a path are

.. math::

    e_f = \varphi(t) - \hat w(t),\qquad e_s = \varphi(t - \delta) - C_a\hat x(t) .

The *paper* protocol is the published simulation: Euler-Maruyama from zero, squared errors at the
end of each path. The *ergodic* one starts in the stationary state of the linearised loop, lets the
loop forget the difference, and averages along each path; its scheme is of second order, and the
linearised loop on the same noise, of which all is known, takes out most of the chance.

A simulation is all that the paths depend on. It simulates any range of blocks of `BLOCK` paths,
always with the same result for a block, so blocks may be computed anywhere and in any order, as
long as they are merged in the order of their index.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robsmooth._numerics.steps import (
    MULTIPLE_TOLERANCE,
    dividing_step,
    steps_in,
    warn_of_long_step,
    whole_steps,
)
from robsmooth._support.blas import one_thread
from robsmooth._support.cluster import alone, worker_threads
from robsmooth._support.errors import UnstableLoopError
from robsmooth.homodyne.loop import Loop
from robsmooth.homodyne.montecarlo import euler, layout, splitting
from robsmooth.homodyne.montecarlo.kernels import threads_of_kernels
from robsmooth.homodyne.montecarlo.noise import BLOCK
from robsmooth.homodyne.montecarlo.schemes import (
    EulerStep,
    SplittingStep,
    control_slopes,
    longest_stable_step,
)
from robsmooth.simulation.statistics import MeanSquare, Tally, control_weights

PRECISIONS = {"mixed": np.float64, "single": np.float32}

PAPER_RUNS, PAPER_DURATION, PAPER_STEP = 50_000, 1e-3, 1e-8
ERGODIC_RUNS = 1024
ERGODIC_TIME_CONSTANTS = 250  # default duration, in units of the estimator's slowest mode
STEP_OF_TIME_CONSTANT = 0.2  # default step, in units of the loop's response through its sines
WARM_UP_TIME_CONSTANTS = 10  # of the estimator's slowest mode, before sampling begins

# Steps in response times of the loop, by the biases that `robsmooth.homodyne.montecarlo` states.
SILENT_EULER = 1 / 40  # two standard errors of a default run
SILENT_SPLITTING = 1 / 4  # less than one, but already 15% of the slips
STABLE_PART = 0.5  # of the longest step for which the Euler-Maruyama scheme is stable: the default

FEWEST_IN_PILOT = BLOCK // 2  # paths in lock, below which there are no control variates
PILOT_BLOCK = 2**50  # beyond the blocks of any run
CONTROLLED_FILTERED, CONTROLLED_SMOOTHED = 2, 3  # variables of the ergodic protocol, after ERRORS


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
        samples=steps // stride + 1,
    )


@dataclass(frozen=True, eq=False)
class Simulation:
    """What the paths of any protocol depend on, together with their index.

    Attributes
    ----------
    runs : int
        Paths; the last block is simulated whole, but only its first paths are returned.
    seed : int
    precision : str
    step, warm_up, duration : float
        s; the last two as a user understands them.
    """

    runs: int
    seed: int
    precision: str
    step: float
    warm_up: float
    duration: float

    protocol: ClassVar[str]
    scheme: ClassVar[str]
    variables: ClassVar[int]  # that are averaged over paths; the first two are the errors
    silent: ClassVar[float]  # the longest step without a warning, in response times of the loop

    @classmethod
    def default_step(cls, loop: Loop, duration: float) -> float:
        """Return the step that is taken where none is given, s."""
        raise NotImplementedError

    def check_step(self, loop: Loop, stacklevel: int) -> None:
        """Warn where the step is long for the loop; see `warn_of_long_step`."""
        fine = self.default_step(loop, self.duration)
        warn_of_long_step(self.step, response_time(loop), self.silent, fine, stacklevel + 1)

    @property
    def blocks(self) -> int:
        """Number of blocks of `BLOCK` paths."""
        return -(-self.runs // BLOCK)

    @property
    def steps(self) -> int:
        """Steps of a path."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Compute once, before this is sent to other machines, what all of them must agree on."""

    def simulate(self, first: int, count: int) -> NDArray[np.float64]:
        """Simulate blocks `first` to ``first + count - 1``.

        Returns
        -------
        (count, outputs, BLOCK) array
            The last output of a path is the number of its cycle slips.
        """
        raise NotImplementedError

    def reduce(self, outputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variables, (variables, paths), of the outputs without the slips."""
        return outputs

    def estimate(self, tally: Tally) -> tuple[MeanSquare, MeanSquare]:
        """Filtered and smoothed mean square error."""
        raise NotImplementedError

    def identity(self) -> dict:
        """All that the results depend on, but for the kernel's version, as JSON values."""
        names = ("runs", "seed", "precision", "step", "warm_up", "duration")
        return {
            "protocol": self.protocol,
            "scheme": self.scheme,
            **{name: getattr(self, name) for name in names},
        }


@dataclass(frozen=True, eq=False)
class PaperSimulation(Simulation):
    """The published protocol.

    Attributes
    ----------
    coefficients : EulerStep
    schedule : tuple of 2 int
        Steps before the delayed phase is recorded, and after.
    """

    coefficients: EulerStep
    schedule: tuple[int, int]

    protocol = "paper"
    scheme = "Euler-Maruyama"
    variables = 2
    silent = SILENT_EULER

    @classmethod
    def default_step(cls, loop: Loop, duration: float) -> float:
        """Return the published step, or a shorter one for a loop that is faster than the paper's.

        It divides the delay.
        """
        longest = min(
            PAPER_STEP, SILENT_EULER * response_time(loop), STABLE_PART * longest_stable_step(loop)
        )
        return dividing_step(loop.delay, longest, duration)

    @classmethod
    def plan(
        cls,
        loop: Loop,
        runs: int | None,
        duration: float | None,
        step: float | None,
        seed: int,
        precision: str,
    ) -> "PaperSimulation":
        """Fill in defaults; the arguments that are given have been checked one by one."""
        duration = PAPER_DURATION if duration is None else duration
        _check_duration(duration, loop.delay)
        default = cls.default_step(loop, duration)
        step = default if step is None else step
        delay, steps = whole_steps(loop.delay, step), steps_in(duration, step)
        longest = longest_stable_step(loop)
        if step >= longest:
            raise ValueError(
                f"step must be below {longest:.4g} s, at which the Euler-Maruyama scheme becomes "
                f"unstable in this loop of response time {response_time(loop):.4g} s, got "
                f"{step:g} s; {default:.8g} s is fine"
            )
        return cls(
            runs=PAPER_RUNS if runs is None else runs,
            seed=seed,
            precision=precision,
            step=step,
            warm_up=0.0,
            duration=steps * step,
            coefficients=EulerStep.of(loop, step),
            schedule=(steps - delay, delay),
        )

    @property
    def steps(self) -> int:
        """Steps of a path."""
        return sum(self.schedule)

    def simulate(self, first: int, count: int) -> NDArray[np.float64]:
        """Simulate blocks, as `Simulation.simulate` says."""
        real = PRECISIONS[self.precision]
        order = self.coefficients.readout.shape[1]
        states = np.empty((count, layout.euler_state_size(order)), real)
        results = np.empty((count, euler.OUTPUTS, BLOCK))
        with alone(), threads_of_kernels(worker_threads()):
            euler.simulate_blocks(
                (real(0),) * order,
                layout.flat(self.coefficients.coefficients, real),
                self.coefficients.readout,
                self.schedule,
                np.uint64(self.seed),
                first,
                states,
                results,
            )
        return results

    def estimate(self, tally: Tally) -> tuple[MeanSquare, MeanSquare]:
        """Filtered and smoothed mean square error."""
        return tally.all.mean_square(euler.FILTERED), tally.all.mean_square(euler.SMOOTHED)


@dataclass(frozen=True, eq=False)
class ErgodicSimulation(Simulation):
    """The time-averaging protocol.

    Attributes
    ----------
    coefficients : SplittingStep
    schedule : Schedule
    """

    coefficients: SplittingStep
    schedule: Schedule

    protocol = "ergodic"
    scheme = "Strang splitting with a linear control variate"
    variables = 4
    silent = SILENT_SPLITTING

    @classmethod
    def default_step(cls, loop: Loop, duration: float) -> float:
        """Return a fifth of the loop's response time, or a shorter step that divides the delay."""
        return dividing_step(loop.delay, STEP_OF_TIME_CONSTANT * response_time(loop), duration)

    @classmethod
    def plan(
        cls,
        loop: Loop,
        runs: int | None,
        duration: float | None,
        step: float | None,
        seed: int,
        precision: str,
    ) -> "ErgodicSimulation":
        """Fill in defaults; the arguments that are given have been checked one by one.

        Raises
        ------
        UnstableLoopError
            Where the linearised loop has no stationary state.
        """
        slopes = control_slopes(loop)
        slowest = loop.rates(*slopes)[0]
        if not slowest > 0:
            raise UnstableLoopError(
                "the ergodic protocol needs a loop with a stationary state, and the linearised "
                f"estimator is not stable in it: its slowest mode has the decay rate {slowest:.3g} "
                "1/s"
            )
        if duration is None:
            duration = max(ERGODIC_TIME_CONSTANTS / slowest, loop.delay)
        _check_duration(duration, loop.delay)
        default, response = cls.default_step(loop, duration), response_time(loop)
        step = default if step is None else step
        warm_up = math.ceil((WARM_UP_TIME_CONSTANTS / slowest + loop.delay) / step)
        schedule = time_average(
            warm_up=warm_up,
            steps=steps_in(duration, step),
            delay=whole_steps(loop.delay, step),
            longest_stride=max(
                int(STEP_OF_TIME_CONSTANT * response / step + MULTIPLE_TOLERANCE), 1
            ),
        )
        return cls(
            runs=ERGODIC_RUNS if runs is None else runs,
            seed=seed,
            precision=precision,
            step=step,
            warm_up=warm_up * step,
            duration=(schedule.samples - 1) * schedule.stride * step,
            coefficients=SplittingStep.of(loop, step, slopes),
            schedule=schedule,
        )

    @property
    def steps(self) -> int:
        """Steps of a path."""
        return self.schedule.steps

    def simulate(self, first: int, count: int) -> NDArray[np.float64]:
        """Simulate blocks, as `Simulation.simulate` says."""
        real = PRECISIONS[self.precision]
        scheme = self.coefficients
        order = scheme.readout.shape[1]
        states = np.empty((count, layout.splitting_rows(order).end), real)
        results = np.empty((count, splitting.OUTPUTS, BLOCK))
        with alone(), threads_of_kernels(worker_threads()):
            splitting.simulate_blocks(
                (real(0),) * order,
                (np.float32(0),) * layout.draws_of_splitting(order),
                scheme.copies,
                scheme.start.astype(real),
                layout.flat(scheme.coefficients, real),
                scheme.readout.ravel(),
                tuple(self.schedule),
                np.uint64(self.seed),
                first,
                states,
                results.reshape(count, -1),
            )
        return results[:, : splitting.SLIPS + 1]

    def estimate(self, tally: Tally) -> tuple[MeanSquare, MeanSquare]:
        """Filtered and smoothed mean square error, less what chance did to the control."""
        return (
            tally.all.mean_square(CONTROLLED_FILTERED, plain=splitting.FILTERED),
            tally.all.mean_square(CONTROLLED_SMOOTHED, plain=splitting.SMOOTHED),
        )

    def prepare(self) -> None:
        """Compute the weights: BLAS has other last bits on another processor."""
        _ = self.weights

    @cached_property
    @one_thread
    def weights(self) -> NDArray[np.float64]:
        """Weights of the three controls for the two errors, from a pilot of other paths.

        Of a path that has slipped the errors have nothing to do with the control's any more; where
        hardly any has not, the weights are zero.
        """
        outputs = self.simulate(PILOT_BLOCK, 1)[0]
        in_lock = outputs[:, outputs[splitting.SLIPS] == 0]
        errors, controls = in_lock[splitting.ERRORS], in_lock[splitting.CONTROLS]
        if in_lock.shape[1] < FEWEST_IN_PILOT:
            return np.zeros((len(errors), len(controls)))
        return control_weights(errors, controls)

    def reduce(self, outputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the errors, and the errors less what chance did to the control."""
        errors = outputs[splitting.ERRORS]
        excess = outputs[splitting.CONTROLS] - self.coefficients.control[:, None]
        # Not by BLAS, whose last bits depend on how many paths there are, and on its threads.
        chance = (self.weights[:, :, None] * excess).sum(axis=1)
        return np.vstack([errors, errors - chance])


PROTOCOLS: dict[str, type[Simulation]] = {"ergodic": ErgodicSimulation, "paper": PaperSimulation}


def response_time(loop: Loop) -> float:
    """Return the time in which the loop's sines respond to themselves, s; infinity if never."""
    rate = loop.response_rate()
    return 1.0 / rate if rate else math.inf


def _check_duration(duration: float, delay: float) -> None:
    if duration < delay:
        raise ValueError(
            f"duration must be at least the smoother's delay, {delay:g} s, got {duration:g}"
        )
