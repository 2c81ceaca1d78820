"""The two protocols of `monte_carlo`: what is simulated, and what is made of it."""

import math
from dataclasses import dataclass, replace
from types import ModuleType
from typing import ClassVar, Self

import numba
import numpy as np

from robsmooth._numerics.steps import dividing_step, steps_in, warn_of_long_step, whole_steps
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.cluster import ALONE, worker_threads
from robsmooth._support.validation import Matrix
from robsmooth.homodyne.loop import Loop, decay_rate
from robsmooth.homodyne.montecarlo import euler, splitting
from robsmooth.homodyne.montecarlo.noise import BLOCK
from robsmooth.simulation.statistics import control_weights

PRECISIONS = {"mixed": np.float64, "single": np.float32}

PAPER_DURATION, PAPER_STEP = 1e-3, 1e-8
ERGODIC_TIME_CONSTANTS = 250  # default duration, in units of the estimator's slowest mode
STEP_OF_TIME_CONSTANT = 0.2  # default step, in units of the loop's response through its sines
WARM_UP_TIME_CONSTANTS = 10  # of the estimator's slowest mode, before sampling begins

# Steps in response times of the loop, by the biases that `robsmooth.homodyne.montecarlo` states.
SILENT_EULER = 1 / 40  # two standard errors of a default run
SILENT_SPLITTING = 1 / 4  # less than one, but already 15% of the slips
STABLE_PART = 0.5  # of the longest step for which the Euler-Maruyama scheme is stable: the default

FEWEST_IN_PILOT = BLOCK // 2  # paths in lock, below which there are no control variates
PILOT_BLOCK = 2**50  # beyond the blocks of any run


@dataclass(frozen=True, eq=False)
class Simulation:
    """What the paths of any protocol depend on, together with their index."""

    runs: int  # the last block is simulated whole, but only its first paths are returned
    seed: int
    precision: str
    step: float  # s
    warm_up: float  # s
    duration: float  # s, in whole steps, without the warm-up
    steps: int  # of a path
    readout: Matrix  # (3, n): filtered and smoothed estimate, oscillator's phase
    coefficients: euler.Coefficients | splitting.Coefficients
    schedule: tuple[int, ...]  # as the kernel takes it
    kernel: ClassVar[ModuleType]
    default_runs: ClassVar[int]
    compiled_for: ClassVar[tuple] = ()  # besides the order and the precision

    @property
    def blocks(self) -> int:
        """Number of blocks of paths."""
        return -(-self.runs // BLOCK)

    def simulate(self, first: int, count: int) -> Matrix:
        """Simulate blocks `first` to ``first + count - 1``: (count, outputs, BLOCK).

        The last output of a path is the number of its cycle slips.
        """
        real, n = PRECISIONS[self.precision], self.readout.shape[1]
        results = np.empty((count, self.kernel.OUTPUTS, BLOCK))
        threads = worker_threads() or numba.get_num_threads()
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # of this thread
        with ALONE:
            self.kernel.simulate_blocks(
                *self.compiled_for,
                (real(0),) * n,
                np.concatenate([np.ravel(part) for part in self.coefficients]).astype(real),
                self.readout.ravel(),
                self.schedule,
                np.uint64(self.seed),
                first,
                results.reshape(count, -1),
            )
        return results[:, : self.kernel.SLIPS + 1]

    def reduce(self, outputs: Matrix) -> Matrix:
        """Return the variables, (variables, paths), of the outputs without the slips.

        The first two are the squared errors; so are the last two, with less variance if possible.
        """
        return outputs


class PaperSimulation(Simulation):
    """The published protocol: Euler-Maruyama."""

    kernel = euler
    default_runs = 50_000

    @classmethod
    def plan(cls, loop: Loop, duration: float | None, step: float | None, **numbers) -> Self:
        """Fill in the published numbers, or a shorter step for a faster loop than the paper's."""
        duration = duration or max(PAPER_DURATION, loop.delay)
        response, longest = loop.response_time(), euler.longest_stable_step(loop)
        default = min(PAPER_STEP, SILENT_EULER * response, STABLE_PART * longest)
        default = dividing_step(loop.delay, default, duration)
        step = step or default
        delay, steps = whole_steps(loop.delay, step), steps_in(duration, step)
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
            readout=loop.readout,
            coefficients=euler.coefficients_of(loop, step),
            schedule=(steps - delay, delay),  # before the delayed phase is recorded, and after
        )


@dataclass(frozen=True, eq=False)
class ErgodicSimulation(Simulation):
    """The time-averaging protocol: Strang's splitting, with a linear control variate."""

    control: Matrix  # (3,), means of the control's squared errors and of the filtered one's square
    weights: Matrix  # (2, 3), of these for the two errors: other machines' BLAS has other last bits

    kernel = splitting
    default_runs = 1024

    @classmethod
    def plan(cls, loop: Loop, duration: float | None, step: float | None, **numbers) -> Self:
        """Fill in numbers by the time constants of the linearised loop, which must be stable."""
        slopes = splitting.control_slopes(loop)
        slowest = decay_rate(loop.linearised_drift(*slopes)[1:, 1:])
        duration = duration or max(ERGODIC_TIME_CONSTANTS / slowest, loop.delay)
        response = loop.response_time()
        default = dividing_step(loop.delay, STEP_OF_TIME_CONSTANT * response, duration)
        step = step or default
        warm_up = math.ceil((WARM_UP_TIME_CONSTANTS / slowest + loop.delay) / step)
        steps, delay = steps_in(duration, step), whole_steps(loop.delay, step)
        warn_of_long_step(step, response, SILENT_SPLITTING, default, stacklevel=5)
        filtered, lagged = loop.linear_errors(*slopes)
        simulation = cls(
            **numbers,
            step=step,
            warm_up=warm_up * step,
            duration=steps * step,
            steps=warm_up + steps,
            readout=loop.readout,
            coefficients=splitting.coefficients_of(loop, step, slopes),
            schedule=(warm_up, delay, steps),
            control=np.array([filtered, lagged, 3 * filtered**2]),  # it is Gaussian
            weights=np.zeros((2, 3)),
        )
        # from a pilot of other paths in lock
        outputs = simulation.simulate(PILOT_BLOCK, 1)[0]
        in_lock = outputs[:, outputs[splitting.SLIPS] == 0]
        if in_lock.shape[1] < FEWEST_IN_PILOT:
            return simulation
        weights = control_weights(in_lock[splitting.ERRORS], in_lock[splitting.CONTROLS])
        return replace(simulation, weights=weights)

    @property
    def compiled_for(self) -> tuple:
        """The Gaussians of a step, and the copy of the nonlinearity where it has any effect."""
        runs_copy = self.coefficients.copy.any() and self.coefficients.copy_gain.any()
        return (np.float32(0),) * self.coefficients.root.shape[1], (0,) * int(runs_copy)

    def reduce(self, outputs: Matrix) -> Matrix:
        """Return the errors, and the errors less what chance did to the control."""
        errors = outputs[splitting.ERRORS]
        excess = outputs[splitting.CONTROLS] - self.control[:, None]
        # Not by BLAS, whose last bits depend on how many paths there are, and on its threads.
        chance = (self.weights[:, :, None] * excess).sum(axis=1)
        return np.vstack([errors, errors - chance])


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
    """Check the numbers, fill in defaults, say what is to be simulated, and warn of long steps."""
    if numba.config.DISABLE_JIT:
        raise RuntimeError(
            "monte_carlo needs numba's compiler, which NUMBA_DISABLE_JIT switches off: unset it"
        )
    kind = PROTOCOLS[protocol]
    runs = kind.default_runs if runs is None else validation.integer("runs", runs, low=1)
    if duration is not None:
        duration = validation.positive("duration", duration)
        if duration < loop.delay:
            delay = f"the smoother's delay, {loop.delay:g} s"
            raise ValueError(f"duration must be at least {delay}, got {duration:g}")
    if step is not None:
        step = validation.positive("step", step)
    seed = validation.integer("seed", seed, low=0)
    if seed >= 2**64:
        raise ValueError(f"seed must be below 2**64, got {seed}")
    validation.choice("precision", precision, tuple(PRECISIONS))
    return kind.plan(loop, duration, step, runs=runs, seed=seed, precision=precision)
