"""The two protocols of `monte_carlo`: the plan of a simulation, and the errors from its outputs."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import ClassVar, Self

import numpy as np

from robsmooth._numerics.steps import dividing_step, steps_in, warn_of_long_step, whole_steps
from robsmooth._numerics.vectors import BLOCK
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.validation import Matrix
from robsmooth.homodyne.loop import Loop, decay_rate
from robsmooth.homodyne.montecarlo import euler, splitting
from robsmooth.simulation.groups import checked_seed, stoppable, threads
from robsmooth.simulation.statistics import Tally, control_weights

PRECISIONS = {"mixed": np.float64, "single": np.float32}
PAPER_DURATION, PAPER_STEP = 1e-3, 1e-8
ERGODIC_TIME_CONSTANTS = 250  # default duration, in units of the estimator's slowest mode
STEP_OF_TIME_CONSTANT = 0.2  # default step, in units of the loop's response through its sines
WARM_UP_TIME_CONSTANTS = 10  # of the estimator's slowest mode

# Steps without a warning, in response times; docs/source/simulation.md states the biases.
SILENT_EULER = 1 / 40  # a bias of two standard errors of a default run
SILENT_SPLITTING = 1 / 4  # less than one, but 15% of the slips
STABLE_PART = 0.5  # of the longest stable Euler-Maruyama step: the default

FEWEST_IN_PILOT = BLOCK // 2  # paths in lock, for control variates
PILOT_BLOCK = 2**50  # beyond the blocks of any run


@dataclass(frozen=True, eq=False)
class Simulation:
    """All numbers that the paths depend on, besides their index."""

    runs: int  # the last block is simulated whole; only its first paths count
    seed: int
    precision: str
    step: float  # s
    warm_up: float  # s
    duration: float  # s, in whole steps, without the warm-up
    steps: int  # of a path
    readout: Matrix  # (3, n): filtered and smoothed estimate, oscillator's phase
    coefficients: euler.Coefficients | splitting.Coefficients
    schedule: tuple[int, ...]  # as the kernel takes it
    parameters: Mapping[str, float] = field(default_factory=dict, kw_only=True)  # for a message
    group_steps: ClassVar[int] = 400_000_000  # about half a second
    kernel: ClassVar[ModuleType]
    default_runs: ClassVar[int]
    compiled_for: ClassVar[tuple[int, ...]] = ()  # besides the order and the precision

    def simulate(self, first: int, count: int, report: Callable | None = None) -> Matrix:
        """Simulate `count` blocks from `first` on: (count, outputs, BLOCK), cycle slips last."""
        real, n = PRECISIONS[self.precision], self.readout.shape[1]
        results = np.empty((count, self.kernel.OUTPUTS, BLOCK))
        with threads():
            stoppable(
                self.kernel.simulate_blocks,
                (real(0),) * n,
                *((real(0),) * count for count in self.compiled_for),
                np.concatenate([np.ravel(part) for part in self.coefficients]).astype(real),
                -self.readout.ravel(),
                self.schedule,
                np.uint64(self.seed),
                first,
                results=results.reshape(count, -1),
            )
        return results[:, : self.kernel.SLIPS + 1]

    def tally(self, path: int, outputs: Matrix) -> Tally:
        """Return the tally of paths; a RuntimeError names one that overflowed."""
        wrong = np.flatnonzero(~np.isfinite(outputs).all(axis=0))
        if wrong.size:
            given = ", ".join(f"{name}={value:g}" for name, value in self.parameters.items())
            raise RuntimeError(
                f"path {path + wrong[0]} of seed {self.seed} overflowed, with {given}: the step, "
                f"{self.step:g} s, is too long for this loop, or the estimator is unstable in it"
            )
        return Tally.of(self.reduce(outputs[:-1]), outputs[-1])

    def reduce(self, outputs: Matrix) -> Matrix:
        """Return the squared errors of the outputs, (2, paths); ergodic: and with less variance."""
        return outputs


class PaperSimulation(Simulation):
    """The published protocol: Euler-Maruyama."""

    kernel = euler
    default_runs = 50_000

    @classmethod
    def plan(cls, loop: Loop, duration: float | None, step: float | None, **numbers) -> Self:
        """Fill in the published numbers, with a shorter step for a faster loop."""
        duration = duration or max(PAPER_DURATION, loop.delay)
        response, longest = loop.response_time(), euler.longest_stable_step(loop)
        default = min(PAPER_STEP, SILENT_EULER * response, STABLE_PART * longest)
        default = dividing_step(loop.delay, default, duration)
        step = step or default
        steps, delay = steps_in(duration, step), whole_steps(loop.delay, step)
        if step >= longest:
            raise ValueError(
                f"step must be below {longest:.4g} s, at which the Euler-Maruyama scheme becomes "
                f"unstable in this loop of response time {response:.4g} s, got {step:g} s; "
                f"{default:.8g} s is fine"
            )
        warn_of_long_step(step, response, SILENT_EULER, default, stacklevel=5)
        return cls(
            **numbers,
            step=step,
            warm_up=0.0,
            duration=steps * step,
            steps=steps,
            coefficients=euler.coefficients_of(loop, step),
            schedule=(steps - delay, delay),
        )


@dataclass(frozen=True, eq=False)
class ErgodicSimulation(Simulation):
    """The time-averaging protocol: Strang's splitting, with a linear control variate."""

    control: Matrix  # (3,), means of the control's squared errors, and of the square of the first
    weights: Matrix  # (2, 3), of these in the two errors; kept, for BLAS differs between machines

    kernel = splitting
    default_runs = 1024

    @classmethod
    def plan(cls, loop: Loop, duration: float | None, step: float | None, **numbers) -> Self:
        """Fill in numbers from the time constants of the linearised loop, which must be stable."""
        slopes = splitting.control_slopes(loop)
        slowest = decay_rate(loop.linearised_drift(*slopes)[1:, 1:])
        duration = duration or max(ERGODIC_TIME_CONSTANTS / slowest, loop.delay)
        response = loop.response_time()
        default = dividing_step(loop.delay, STEP_OF_TIME_CONSTANT * response, duration)
        step = step or default
        before = WARM_UP_TIME_CONSTANTS / slowest + loop.delay
        steps = steps_in(duration, step, before)
        warm_up, delay = math.ceil(before / step), whole_steps(loop.delay, step)
        warn_of_long_step(step, response, SILENT_SPLITTING, default, stacklevel=5)
        filtered, lagged = loop.linear_errors(*slopes)
        simulation = cls(
            **numbers,
            step=step,
            warm_up=warm_up * step,
            duration=steps * step,
            steps=warm_up + steps,
            coefficients=splitting.coefficients_of(loop, step, slopes),
            schedule=(warm_up, delay, steps),
            control=np.array([filtered, lagged, 3 * filtered**2]),  # it is Gaussian
            weights=np.zeros((2, 3)),
        )
        outputs = simulation.simulate(PILOT_BLOCK, 1)[0]  # of other paths
        in_lock = outputs[:, outputs[splitting.SLIPS] == 0]
        if in_lock.shape[1] < FEWEST_IN_PILOT:
            return simulation
        weights = control_weights(in_lock[splitting.ERRORS], in_lock[splitting.CONTROLS])
        return replace(simulation, weights=weights)

    @property
    def compiled_for(self) -> tuple[int, ...]:
        """The number of Gaussians of a step."""
        rows, columns = self.coefficients.control.shape
        return (columns - rows,)

    def reduce(self, outputs: Matrix) -> Matrix:
        """Return the errors, and the errors less the weighted excess of the control."""
        errors = outputs[splitting.ERRORS]
        excess = outputs[splitting.CONTROLS] - self.control[:, None]
        # The last bits of BLAS depend on the number of paths and on its threads.
        return np.vstack([errors, errors - (self.weights[:, :, None] * excess).sum(axis=1)])


PROTOCOLS: dict[str, type[Simulation]] = {"ergodic": ErgodicSimulation, "paper": PaperSimulation}


@one_thread
def plan(
    loop: Loop,
    protocol: str,
    runs: int | None = None,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
    precision: str = "mixed",
) -> Simulation:
    """Check the numbers, fill in defaults, and warn of a long step."""
    kind = PROTOCOLS[protocol]
    runs = kind.default_runs if runs is None else validation.integer("runs", runs, low=1)
    if duration is not None:
        duration = validation.positive("duration", duration)
        if duration < loop.delay:
            least = f"the smoother's delay, {loop.delay:g} s"
            raise ValueError(f"duration must be at least {least}, got {duration:g}")
    if step is not None:
        step = validation.positive("step", step)
    seed = checked_seed(seed)
    validation.choice("precision", precision, tuple(PRECISIONS))
    numbers = {"runs": runs, "seed": seed, "precision": precision, "readout": loop.readout}
    return kind.plan(loop, duration, step, **numbers)
