"""Simulated errors and sample paths, with a check of the theory's constraints."""

import math
import warnings
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from robsmooth._numerics.steps import dividing_step, steps_in, warn_of_long_step, whole_steps
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.progress import progress_bar
from robsmooth._support.validation import Matrix
from robsmooth.estimators.estimator import Estimator
from robsmooth.simulation import loop as loops
from robsmooth.simulation import statistics
from robsmooth.systems.augmented import AugmentedSystem

BLOCK = 512  # paths side by side
STEP_OF_TIME_CONSTANT = 0.2  # default step, in units of the loop's response time
SILENT = 1 / 4  # the longest step without a warning, in these units
TIME_CONSTANTS = 100  # default duration, in units of the slowest mode
WARM_UP_TIME_CONSTANTS = 5
MOST_GROWTH = 20.0  # of an unstable system, in powers of e
CHECK_EVERY = 16  # steps
_CONSTRAINT_TOLERANCE = 1e-6  # relative, for rounding where a constraint holds with equality


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
) -> statistics.SimulationResult:
    r"""Simulate a system, nonlinearities included, with its estimator, and measure the errors.

    The errors are :math:`w(t) - C_f\hat x_p(t)` and :math:`w(t - \delta) - C_a\hat x_p(t)`. Paths
    start in the stationary state of the statistically linearised loop. After a warm-up their
    squared errors are averaged over time.

    Parameters
    ----------
    smoother : Estimator
        Every nonlinearity of its system needs its function: of arrays, or numba's of a number.
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
    seed : int, at least 0; a path depends on it, the path's number and the step alone
    progress : bool, whether to show a bar

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
        Where a path diverges; it names the path and the time.

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
    checks = np.zeros((3, len(run.plant.M_i)))
    errors = statistics.Moments()
    path_steps = run.runs * (run.before + run.steps)
    with progress_bar(total=path_steps, unit="step", unit_scale=True, shown=progress) as bar:
        for first in range(0, run.runs, BLOCK):
            paths = range(first, min(first + BLOCK, run.runs))
            of_errors, of_checks = run.averages(paths, bar)
            errors += statistics.Moments.of(of_errors)
            checks += of_checks.sum(axis=2) / run.runs

    used, allowed, violated = checks
    constraints = np.divide(used, allowed, out=0.0 * used, where=used > 0.0)
    result = statistics.SimulationResult(
        smoothed=errors.mean_square(1),
        filtered=errors.mean_square(0),
        constraints=constraints,
        violated=violated,
        equivalent_delta=run.integrator.loop.delta,
        runs=run.runs,
        path_steps=path_steps,
        duration=run.steps * run.step,
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
    parts = list(run.records(range(run.runs)))
    names = ("y", "reference", "w", "filtered", "delayed", "smoothed")
    times, *series = (np.concatenate([part[name] for part in parts]) for name in ("time", *names))
    by_path = (np.moveaxis(values, 2, 0) for values in series)
    return statistics.SamplePaths(times, *by_path, run.step, smoother.plant.delay)


class _Run:
    """A loop, and its numbers of steps: `before` time zero, from there on, and in the lag."""

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
        self.seed = validation.integer("seed", seed, low=0)
        if duration is None:
            duration = TIME_CONSTANTS / (5 if measured else 1) / loop.slowest_rate
            if loop.growth_rate:
                duration = min(duration, MOST_GROWTH / 2 / loop.growth_rate)
        duration = validation.positive("duration", duration)
        response_time = 1.0 / loop.argument_rate()
        default = dividing_step(delay, STEP_OF_TIME_CONSTANT * response_time, duration)
        self.step = step = validation.positive("step", default if step is None else step)
        self.before = math.ceil((WARM_UP_TIME_CONSTANTS / loop.slowest_rate + delay) / step)
        self.steps, self.lag = steps_in(duration, step), whole_steps(delay, step)
        growth = loop.growth_rate * step * (self.before + self.steps)
        if growth > MOST_GROWTH:
            raise ValueError(
                f"duration must be shorter, got {duration:.4g} s after a warm-up of "
                f"{self.before * step:.4g} s: the system grows at a rate of {loop.growth_rate:.4g} "
                "1/s, and its errors would be lost in rounding"
            )
        if loop.functions:  # else the scheme is exact
            warn_of_long_step(step, response_time, SILENT, default, stacklevel=4)
        self.integrator = loops.ExponentialIntegrator(loop, step, measured)

    def records(self, paths: range, bar=None) -> Iterator[dict[str, NDArray]]:
        """Simulate paths; yield signals by name, from time zero on, (steps, rows, paths)."""
        m, g = self.plant.system.m, self.plant.system.g
        arguments = len(self.integrator.loop.arguments)
        names = ("w", "filtered", "smoothed", "zeta", "subtracted", "y")
        rows = np.cumsum([m, m, m, arguments, arguments])
        of_detectors = slice(arguments - 2 * g, arguments - g)
        past, last = np.zeros((self.lag, m, len(paths))), np.zeros((1, g, len(paths)))
        all_steps = self.integrator.records(self.seed, paths, self.before, self.steps)
        for first, records in all_steps:
            part = dict(zip(names, np.split(records, rows, axis=1), strict=True))
            outputs = np.concatenate([past, part["w"]])
            part["delayed"], past = outputs[: len(records)], outputs[len(records) :]
            references = np.concatenate([last, part["subtracted"][:, of_detectors]])
            part["reference"], last = (references[1:] + references[:-1]) / 2, references[-1:]
            part["time"] = self.step * np.arange(first, first + len(records))
            yield {name: values[max(0, 1 - first) :] for name, values in part.items()}
            if bar is not None:
                bar.update(len(records) * len(paths))

    def averages(self, paths: range, bar) -> tuple[NDArray, NDArray]:
        """Return averages over time: of squared errors, (2, paths), and of `_constraints`."""
        squares, samples = np.zeros((2, len(paths))), 0
        checks = np.zeros((3, len(self.plant.M_i), len(paths)))
        for part in self.records(paths, bar):
            errors = part["w"] - part["filtered"], part["delayed"] - part["smoothed"]
            squares += [np.einsum("tip,tip->p", error, error) for error in errors]
            for k in range(0, len(part["time"]), CHECK_EVERY):
                checks += self._constraints(*(part[n][k] for n in ("time", "zeta", "subtracted")))
                samples += 1
        return squares / self.steps, checks / samples

    def _constraints(self, time: float, zeta: NDArray, subtracted: NDArray) -> NDArray:
        """Return xi' M_i xi, zeta' N_i zeta, and whether the former is larger: (3, k + 3g, paths).

        The second has the reference `subtracted` added to zeta again; the third compares without.
        """
        loop = self.integrator.loop
        xi = loop.delta @ zeta + loop.remainder(time, zeta)
        used = _energies(self.plant.M_i, xi)
        whole, less = (_energies(self.plant.N_i, each) for each in (zeta + subtracted, zeta))
        return np.array([used, whole, used > (1 + _CONSTRAINT_TOLERANCE) * less])


def _energies(forms: Sequence[Matrix], values: NDArray) -> NDArray[np.float64]:
    """Return quadratic forms of values, (., paths): (forms, paths)."""
    energies = [(values * (form @ values)).sum(axis=0) for form in forms]
    return np.reshape(energies, (len(forms), values.shape[1]))


def _warn(plant: AugmentedSystem, result: statistics.SimulationResult) -> None:
    """Warn of the constraints that do not hold all the time."""
    names = [f"uncertainties[{s}]" for s in range(plant.system.k)]
    for name in ("{} less its copy", "{}", "the copy of {}"):
        names += [name.format(f"nonlinearities[{i}]") for i in range(plant.system.g)]
    found = [
        f"{name} for {violated:.2g} of the time ({used:.3g} in the mean)"
        for name, violated, used in zip(names, result.violated, result.constraints, strict=True)
        if violated > 0.0 or used > 1 + _CONSTRAINT_TOLERANCE
    ]
    if found:
        warnings.warn(
            "the loop left the region in which the theory's constraints hold: "
            f"{'; '.join(found)}; the guarantee needs at most 1 in the mean",
            statistics.InadmissibleWarning,
            stacklevel=4,
        )
