"""Simulated errors and sample paths, with a check of the theory's constraints."""

import hashlib
import math
import os
import warnings
from collections.abc import Callable, Iterator
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from robsmooth._numerics.steps import dividing_step, steps_in, warn_of_long_step, whole_steps
from robsmooth._numerics.vectors import BLOCK
from robsmooth._support import cluster, validation
from robsmooth._support.blas import one_thread
from robsmooth._support.checkpoint import open_journal
from robsmooth.estimators.estimator import Estimator
from robsmooth.simulation import groups, kernel, statistics
from robsmooth.simulation import loop as loops
from robsmooth.systems.augmented import AugmentedSystem

COMPILED, IN_PYTHON = 4_000_000, 200_000  # path-steps between two looks at an interrupt
MOST_NUMBERS = 4e8  # that `sample_paths` keeps
RECORDED = 100_000  # path-steps whose signals are in memory at once
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
    client: "cluster.Client | None" = None,
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
        ``xi(t, zeta)`` that map (h_s, paths) to (r_s, paths), t in s from the end of the warm-up.
    runs : int, independent paths
    duration : float, optional
        Of a path, without the warm-up, s; in whole steps. Default: 100 times the slowest time
        constant of the linearised loop, or less where the system is unstable.
    step : float, optional
        s; must divide the lag. Default: the largest such step up to a fifth of the loop's response
        time; `docs/source/simulation.md` has its bias.
    seed : int, at least 0 and below 2^64; a path depends on it, its number and the step alone
    progress : bool, whether to show a bar
    client : distributed.Client, optional, of a Dask cluster; see `robsmooth.workbench.connect`
    checkpoint : path, optional, of a file from which the same call resumes

    Warns
    -----
    InadmissibleWarning, LongStepWarning
        Where a constraint of the theory, (eqIQC1) to (eqIQC4), is violated at times; where the step
        is above 1/4 of the response time, unless the loop is linear with constants.

    Raises
    ------
    UnstableLoopError, RuntimeError
        Where the loop is not stable without its nonlinearities; where a path diverges (it names the
        path and the time), or numba is off.
    ValueError, ConnectionError, OSError
        For checkpoint and cluster, as in `monte_carlo`.

    Examples
    --------
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
    found = errors.mean_square(1), errors.mean_square(0), constraints, violated
    counts = {"runs": run.runs, "path_steps": run.runs * run.steps, "seed": run.seed}
    times = {"duration": run.averaged * run.step, "warm_up": run.before * run.step}
    delta = run.scheme.loop.delta
    result = statistics.SimulationResult(*found, delta, **counts, **times, step=run.step)
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
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> rs.sample_paths(kalman, runs=2, duration=1e-4)
    SamplePaths(2 paths of 223 steps of 4.492e-07 s, lag=0 s, 1 measurements, 1 outputs)
    """
    run = _Run(smoother, uncertainties, runs, duration, step, seed, measured=True)
    m, g, arguments = run.plant.system.m, run.plant.system.g, len(run.scheme.loop.arguments)
    blocks, signals = -(-run.runs // BLOCK), len(run.scheme.scheme.signals)
    if blocks * BLOCK * run.steps * signals > MOST_NUMBERS:
        given = f"{run.runs} paths of {run.steps} steps with {signals} signals"
        raise ValueError(f"runs and duration must make fewer numbers to keep, got {given}")
    parts = run.parts(0, blocks, recorded=True)
    signals = np.concatenate([np.concatenate(each, axis=2)[..., : run.runs] for *_, each in parts])
    rows = np.cumsum([m, m, m, arguments, arguments])
    signals = np.split(np.moveaxis(signals, 2, 0), rows, axis=2)  # the warm-up comes first
    w, filtered, smoothed, y = (signals[i][:, run.before :] for i in (0, 1, 2, 5))
    reference = signals[4][..., arguments - 2 * g : arguments - g]
    time = run.step * np.arange(1, run.averaged + 1)
    means = (reference[:, run.before - 1 : -1] + reference[:, run.before :]) / 2
    delayed = signals[0][:, run.before - run.lag : run.steps - run.lag]
    found = time, y, means, w, filtered, delayed, smoothed
    return statistics.SamplePaths(*found, run.step, smoother.plant.delay)


class _Run:
    """A loop with its numbers of steps; `groups.tally_paths` says what it has."""

    group_steps: ClassVar[int] = 10_000_000

    def __init__(self, smoother, uncertainties, runs, duration, step, seed, measured=False):
        loop = loops.nonlinear_loop(smoother, uncertainties)
        self.plant, delay = smoother.plant, smoother.plant.delay
        self.runs = validation.integer("runs", runs, low=1)
        self.seed = groups.checked_seed(seed)
        if duration is None:
            duration = TIME_CONSTANTS / (5 if measured else 1) / loop.slowest_rate
            if loop.growth_rate:
                duration = min(duration, MOST_GROWTH / 2 / loop.growth_rate)
        duration = validation.positive("duration", duration)
        response_time = 1.0 / loop.argument_rate()
        default = dividing_step(delay, STEP_OF_TIME_CONSTANT * response_time, duration)
        self.step = step = validation.positive("step", default if step is None else step)
        before = WARM_UP_TIME_CONSTANTS / loop.slowest_rate + delay
        self.averaged, self.lag = steps_in(duration, step, before), whole_steps(delay, step)
        self.before = kernel.CHUNK * math.ceil(before / step / kernel.CHUNK)
        self.steps = self.before + self.averaged
        growth = loop.growth_rate * step * self.steps
        if growth > MOST_GROWTH:
            got = f"{duration:.4g} s after a warm-up of {self.before * step:.4g} s"
            why = f"the system grows at a rate of {loop.growth_rate:.4g} 1/s"
            what = f"{got}: {why}, and its errors would be lost in rounding"
            raise ValueError(f"duration must be shorter, got {what}")
        if loop.functions:  # else the scheme is exact
            warn_of_long_step(step, response_time, SILENT, default, stacklevel=4)
        self.scheme = loops.Steps(loop, step, measured)

    def parts(self, first: int, count: int, recorded: bool = False) -> Iterator[tuple]:
        """Simulate blocks part by part; yield path-steps, averages, and signals if recorded."""
        scheme = self.scheme
        functions, calls = kernel.called(scheme.loop.functions)
        memory = kernel.empty_memory(scheme.scheme, count, self.lag, len(self.plant.M_i))
        loop, sizes = scheme.loop, scheme.loop.delta.shape
        both = zip((self.plant.M_i, self.plant.N_i), sizes, strict=True)
        forms = [np.reshape(form, (len(form), size, size)) for form, size in both]
        checks = kernel.Checks(loop.delta, scheme.driven, *forms)
        numbers = (self.step, loop.growth_rate, self.lag, self.before, self.runs)
        constants = scheme.scheme, calls, checks, memory, numbers, loop.stationary_root
        at_once = RECORDED if recorded else IN_PYTHON if functions.in_python else COMPILED
        most = kernel.CHUNK * max(1, at_once // (count * BLOCK * kernel.CHUNK))
        for start in range(-self.before, self.averaged, most):
            steps = min(most, self.averaged - start)
            shape = (count, steps, len(scheme.scheme.signals), BLOCK)
            records = np.empty(shape if recorded else (1, 0, 0, 0))
            place = np.uint64(self.seed), first, start, steps
            with groups.threads(alone=functions.in_python), functions:
                kernel.advance_blocks(*constants, *place, records)
            functions.check()
            diverged = [(step, path) for path, step in memory.diverged.tolist() if path >= 0]
            if diverged:
                step, path = min(diverged)
                what = f"not a number or beyond {kernel.GROWTH:g} times its size at the start"
                what = f"by {step * self.step:.4g} s an output is {what}"
                why = f"the loop is not stable, or the step, {self.step:.4g} s, is too long for it"
                raise RuntimeError(f"path {path} of seed {self.seed} diverges: {what}; {why}")
            yield steps * count * BLOCK, memory.averages, records

    def simulate(self, first: int, count: int, report: Callable[[int], object]) -> NDArray:
        """Return averages over time: of squared errors, and of `kernel.check_constraints`."""
        for path_steps, sums, _ in self.parts(first, count):
            averages = sums
            report(path_steps)
        averages[:, :2] /= self.averaged
        averages[:, 2:] /= -(-self.averaged // kernel.CHUNK)
        return averages

    def tally(self, path: int, outputs: NDArray) -> statistics.Tally:
        """Return the tally of paths; none slips."""
        return statistics.Tally.of(outputs, np.zeros(outputs.shape[1]))

    def identity(self) -> dict[str, object]:
        """Return all that the results depend on, in a JSON form; functions by their values."""
        loop, digest = self.scheme.loop, hashlib.sha256()
        tried = np.random.default_rng(0).standard_normal((len(loop.delta.T), 64))
        for part in loop.functions:
            digest.update(np.asarray(part.values(0.5, tried[part.outputs]), dtype=float).tobytes())
        for matrix in (*self.scheme.scheme, loop.stationary_root, loop.delta):
            digest.update(matrix.tobytes())
        numbers = {name: getattr(self, name) for name in ("runs", "seed", "step", "steps")}
        return {**numbers, "loop_sha256": digest.hexdigest(), "software": cluster.software()}


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
