"""Simulated errors and sample paths, with a check of the theory's constraints."""

import hashlib
import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from robsmooth._numerics.steps import dividing_step, steps_in, warn_of_long_step, whole_steps
from robsmooth._support import cluster, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.checkpoint import open_journal
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.simulation import groups, kernel, statistics
from robsmooth.simulation import loop as loops
from robsmooth.simulation.groups import checked_seed, threads
from robsmooth.simulation.kernel import CHUNK
from robsmooth.simulation.noise import BLOCK
from robsmooth.systems.augmented import AugmentedSystem
from robsmooth.systems.functions import on_arrays

if TYPE_CHECKING:
    from distributed import Client

PATH_STEPS, PATH_STEPS_CALLED_BACK = 4_000_000, 200_000  # between two looks at an interrupt
RECORDED = 100_000  # path-steps whose signals are in memory
STEP_OF_TIME_CONSTANT = 0.2  # default step, in units of the loop's response time
SILENT = 1 / 4  # the longest step without a warning, in these units
TIME_CONSTANTS = 100  # default duration, in units of the slowest mode
WARM_UP_TIME_CONSTANTS = 5
MOST_GROWTH = 20.0  # of an unstable system, in powers of e


@one_thread
def simulate(
    smoother: Estimator,
    *,
    uncertainties: loops.Uncertainties = (),
    runs: int = 256,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
    progress: bool = False,
    client: "Client | None" = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> statistics.SimulationResult:
    r"""Simulate a system, nonlinearities included, with its estimator, and measure the errors.

    The errors are :math:`w(t) - C_f\hat x_p(t)` and :math:`w(t - \delta) - C_a\hat x_p(t)`. Paths
    start in the stationary state of the statistically linearised loop. After a warm-up their
    squared errors are averaged over time. The result is the same, to the last bit, for any number
    of threads (numba's setting), on a cluster, and after an interruption.

    Parameters
    ----------
    smoother : Estimator
        Every nonlinearity of its system needs its function. One that numba or NumPy has compiled
        (`numba.njit`, `numpy.tanh`) runs on all threads, and many times as fast as another.
    uncertainties : sequence of k numbers, (r_s, h_s) arrays or functions
        Constants of norm at most one, as in `AugmentedSystem.structured_delta`, or functions
        ``xi(t, zeta)`` that map (h_s, paths) to (r_s, paths), with t in s from the end of the
        warm-up. Default: zero.
    runs : int, independent paths
    duration : float, optional
        Of a path, without the warm-up, s; in whole steps. Default: 100 times the slowest time
        constant of the linearised loop, or less where the system is unstable.
    step : float, optional
        s; must divide the lag. Default: the largest such step up to a fifth of the loop's response
        time; `robsmooth.simulation` has its bias.
    seed : int, at least 0 and below 2^64; a path depends on it, its number and the step alone
    progress : bool, whether to show a bar
    client : distributed.Client, optional, of a Dask cluster; see `robsmooth.workbench.connect`
    checkpoint : path, optional, of a file from which the same call resumes

    Warns
    -----
    InadmissibleWarning
        Where a constraint of the theory, (eqIQC1) to (eqIQC4), is violated at times.
    LongStepWarning
        Where the step is above 1/4 of the response time, unless the loop is linear with constants.

    Raises
    ------
    UnstableLoopError
        Where the loop is not stable without its nonlinearities.
    RuntimeError
        Where a path diverges; it names the path and the time. Where numba is off.
    CheckpointError, ConnectionError, OSError
        As in `monte_carlo`.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(A=[[-1]], B1=[[1, 0]], C0=[[1]], C2=[[1]], D21=[[0, 0.1]])
    >>> smoother = rs.baselines.fixed_lag_smoother(system, delay=0.2, order=2)
    >>> result = rs.simulate(smoother, runs=64, duration=20.0)
    >>> exact = rs.error_covariance(smoother, smoother.plant.structured_delta())[0, 0]
    >>> bool(abs(result.smoothed.mean_square - exact) < 4 * result.smoothed.standard_error)
    True
    """
    progress = validation.boolean("progress", progress)
    run = _Run(smoother, uncertainties, runs, duration, step, seed)
    with open_journal(checkpoint, {} if checkpoint is None else run.identity()) as journal:
        errors = groups.tally_paths(run, journal, client, progress).all
    used, allowed, violated = np.reshape(errors.means[2:], (3, -1))
    constraints = np.divide(used, allowed, out=0.0 * used, where=used > 0.0)
    result = statistics.SimulationResult(
        smoothed=errors.mean_square(1),
        filtered=errors.mean_square(0),
        constraints=constraints,
        violated=violated,
        equivalent_delta=run.scheme.loop.delta,
        runs=run.runs,
        path_steps=run.runs * run.steps,
        duration=run.averaged * run.step,
        warm_up=run.before * run.step,
        step=run.step,
        seed=run.seed,
    )
    _warn(run.plant, result)
    return result


@one_thread
def sample_paths(
    smoother: Estimator,
    *,
    uncertainties: loops.Uncertainties = (),
    runs: int = 3,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
) -> statistics.SamplePaths:
    """Return the first of the paths that `simulate` averages, with their measurements.

    Parameters
    ----------
    smoother, uncertainties, runs, duration, step, seed
        As in `simulate`, which has the exceptions, too; `duration` is a fifth by default.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> rs.sample_paths(kalman, runs=2, duration=1e-4)
    SamplePaths(2 paths of 223 steps of 4.492e-07 s, lag=0 s, 1 measurements, 1 outputs)
    """
    run = _Run(smoother, uncertainties, runs, duration, step, seed, measured=True)
    parts = list(run.records())
    names = ("y", "reference", "w", "filtered", "delayed", "smoothed")
    times, *series = (np.concatenate([part[name] for part in parts]) for name in ("time", *names))
    by_path = (np.moveaxis(values, 2, 0) for values in series)
    return statistics.SamplePaths(times, *by_path, run.step, smoother.plant.delay)


class _Run:
    """A loop, and its numbers of steps: before time zero, from there on, and of the lag."""

    group_steps: ClassVar[int] = 10_000_000

    def __init__(
        self,
        smoother: Estimator,
        uncertainties: loops.Uncertainties,
        runs: int,
        duration: float | None,
        step: float | None,
        seed: int,
        measured: bool = False,
    ):
        loop = loops.nonlinear_loop(smoother, uncertainties)
        self.plant, delay = smoother.plant, smoother.plant.delay
        self.runs = validation.integer("runs", runs, low=1)
        self.seed = checked_seed(seed)
        if duration is None:
            duration = TIME_CONSTANTS / (5 if measured else 1) / loop.slowest_rate
            if loop.growth_rate:
                duration = min(duration, MOST_GROWTH / 2 / loop.growth_rate)
        duration = validation.positive("duration", duration)
        response_time = 1.0 / loop.argument_rate()
        default = dividing_step(delay, STEP_OF_TIME_CONSTANT * response_time, duration)
        self.step = step = validation.positive("step", default if step is None else step)
        before = (WARM_UP_TIME_CONSTANTS / loop.slowest_rate + delay) / step
        self.before = CHUNK * math.ceil(before / CHUNK)
        self.averaged, self.lag = steps_in(duration, step), whole_steps(delay, step)
        self.steps = self.before + self.averaged
        growth = loop.growth_rate * step * self.steps
        if growth > MOST_GROWTH:
            raise ValueError(
                f"duration must be shorter, got {duration:.4g} s after a warm-up of "
                f"{self.before * step:.4g} s: the system grows at a rate of {loop.growth_rate:.4g} "
                "1/s, and its errors would be lost in rounding"
            )
        if loop.functions:  # else the scheme is exact
            warn_of_long_step(step, response_time, SILENT, default, stacklevel=4)
        self.scheme = loops.Steps(loop, step, measured)

    def parts(
        self, first: int, count: int, memory: kernel.Memory, recorded: bool = False
    ) -> Iterator[tuple[int, NDArray]]:
        """Simulate blocks; yield how many steps each part has, and its signals if recorded."""
        scheme, functions = self.scheme, self.scheme.functions
        loop, forms = scheme.loop, (self.plant.M_i, self.plant.N_i)
        checks = kernel.Checks(loop.delta, scheme.driven, *map(_stacked, forms))
        run = (self.step, loop.growth_rate, self.lag, self.before, self.runs)
        constants = scheme.scheme, functions.calls, checks, memory, run, loop.stationary_root
        at_once = PATH_STEPS if functions.compiled else PATH_STEPS_CALLED_BACK
        size = CHUNK * max(1, (RECORDED if recorded else at_once) // (count * BLOCK * CHUNK))
        for start in range(-self.before, self.averaged, size):
            steps = min(size, self.averaged - start)
            shape = (count, steps, len(scheme.scheme.signals), BLOCK)
            records = np.empty(shape if recorded else (1, 0, 0, 0))
            with threads(alone=not functions.compiled):
                kernel.advance_blocks(
                    *constants, np.uint64(self.seed), first, start, steps, records
                )
            functions.check()
            self._check_divergence(memory.diverged)
            yield start + steps, records

    def simulate(self, first: int, count: int, report: Callable[[int], object]) -> NDArray:
        """Return averages over time: of squared errors, and of `kernel.check_constraints`."""
        memory, done = self.memory(count), -self.before
        for until, _ in self.parts(first, count, memory):
            report((until - done) * count * BLOCK)
            done = until
        memory.averages[:, :2] /= self.averaged
        memory.averages[:, 2:] /= -(-self.averaged // CHUNK)
        return memory.averages

    def memory(self, count: int) -> kernel.Memory:
        """Return the memory of blocks that have not begun."""
        return kernel.empty_memory(self.scheme.scheme, count, self.lag, len(self.plant.M_i))

    def tally(self, path: int, outputs: NDArray) -> statistics.Tally:
        """Return the tally of paths; none slips."""
        return statistics.Tally.of(outputs, np.zeros(outputs.shape[1]))

    def records(self) -> Iterator[dict[str, NDArray]]:
        """Yield the signals of all paths by name, from time zero on, (steps, rows, paths)."""
        m, g, count = self.plant.system.m, self.plant.system.g, groups.blocks_of(self.runs)
        arguments = len(self.scheme.loop.arguments)
        names = ("w", "filtered", "smoothed", "zeta", "subtracted", "y")
        rows = np.cumsum([m, m, m, arguments, arguments])
        of_detectors = slice(arguments - 2 * g, arguments - g)
        past, last = np.zeros((self.lag, m, self.runs)), np.zeros((1, g, self.runs))
        for until, records in self.parts(0, count, self.memory(count), recorded=True):
            signals = np.concatenate(records, axis=2)[..., : self.runs]
            part = dict(zip(names, np.split(signals, rows, axis=1), strict=True))
            outputs = np.concatenate([past, part["w"]])
            part["delayed"], past = outputs[: len(signals)], outputs[len(signals) :]
            references = np.concatenate([last, part["subtracted"][:, of_detectors]])
            part["reference"], last = (references[1:] + references[:-1]) / 2, references[-1:]
            part["time"] = self.step * np.arange(until - len(signals) + 1, until + 1)
            yield {name: values[max(0, len(signals) - until) :] for name, values in part.items()}

    def identity(self) -> dict[str, object]:
        """Return all that the results depend on, in a JSON form; functions by their values."""
        loop, digest = self.scheme.loop, hashlib.sha256()
        tried = np.random.default_rng(0).standard_normal((len(loop.delta.T), 64))
        for part in loop.functions:
            given = [tried[0]] if part.elementwise else [0.5, tried[part.outputs]]
            digest.update(np.asarray(on_arrays(part.function)(*given), dtype=float).tobytes())
        for matrix in (*self.scheme.scheme, loop.stationary_root, loop.delta):
            digest.update(matrix.tobytes())
        numbers = {name: getattr(self, name) for name in ("runs", "seed", "step", "steps")}
        return {**numbers, "loop_sha256": digest.hexdigest(), "software": cluster.software()}

    def _check_divergence(self, diverged: NDArray[np.int64]) -> None:
        found = [(step, path) for path, step in diverged.tolist() if path >= 0]
        if found:
            step, path = min(found)
            raise RuntimeError(
                f"path {path} of seed {self.seed} diverges: by {step * self.step:.4g} s an output "
                f"is not a number or beyond {kernel.GROWTH:g} times its size at the start; the "
                f"loop is not stable, or the step, {self.step:.4g} s, is too long for it"
            )


def _stacked(forms: Sequence[Matrix]) -> NDArray[np.float64]:
    """Return quadratic forms as one array, (forms, ., .)."""
    return np.array(forms, dtype=float) if len(forms) else np.zeros((0, 0, 0))


def _warn(plant: AugmentedSystem, result: statistics.SimulationResult) -> None:
    """Warn of the constraints that do not hold all the time."""
    names = [f"uncertainties[{s}]" for s in range(plant.system.k)]
    for name in ("{} less its copy", "{}", "the copy of {}"):
        names += [name.format(f"nonlinearities[{i}]") for i in range(plant.system.g)]
    found = [
        f"{name} for {violated:.2g} of the time ({used:.3g} in the mean)"
        for name, violated, used in zip(names, result.violated, result.constraints, strict=True)
        if violated > 0.0 or used > 1 + kernel.TOLERANCE
    ]
    if found:
        warnings.warn(
            "the loop left the region in which the theory's constraints hold: "
            f"{'; '.join(found)}; the guarantee needs at most 1 in the mean",
            statistics.InadmissibleWarning,
            stacklevel=4,
        )
