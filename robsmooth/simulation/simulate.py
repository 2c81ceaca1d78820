"""Simulated errors, sample paths, and whether the loop stays where the theory holds."""

import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robsmooth._numerics.steps import dividing_step, steps_in, warn_of_long_step, whole_steps
from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.progress import progress_bar
from robsmooth._support.validation import Matrix, frozen
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.loop import Reference
from robsmooth.simulation.integrator import ExponentialIntegrator
from robsmooth.simulation.loop import NonlinearLoop, nonlinear_loop
from robsmooth.simulation.results import (
    InadmissibleWarning,
    SamplePaths,
    SimulatedError,
    SimulationResult,
)
from robsmooth.simulation.statistics import Moments
from robsmooth.systems.augmented import AugmentedSystem

BLOCK = 512  # paths side by side
STEP_OF_TIME_CONSTANT = 0.2  # default step, in units of the loop's response time
SILENT = 1 / 4  # the longest step without a warning, in these units
TIME_CONSTANTS = 100  # default duration, in units of the slowest mode
WARM_UP_TIME_CONSTANTS = 5
CHECK_EVERY = 16  # steps
_CONSTRAINT_TOLERANCE = 1e-6  # relative: one that holds with equality is not violated by rounding


@one_thread
def simulate(
    smoother: Estimator,
    *,
    uncertainties: Sequence[ArrayLike | Callable[[float, Matrix], ArrayLike]] = (),
    reference: Reference = "system",
    loop: str = "real",
    runs: int = 256,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
    progress: bool = False,
) -> SimulationResult:
    r"""Simulate a system, nonlinearities and all, with its estimator, and measure the errors.

    The errors are :math:`w(t) - C_f\hat x_p(t)` and :math:`w(t - \delta) - C_a\hat x_p(t)`. Paths
    start in the stationary state of the statistically linearised loop, forget the difference for a
    while, and are then averaged over time. The scheme is exact for a linear loop with any step, and
    of the second order in the step for the nonlinearities.

    A detector that is steered by an estimate shows its nonlinearity the difference to that, the
    *reference*: :math:`\mu_i = \psi_i(\nu_i - r_i)` in the system, and
    :math:`\psi_i(\tilde\nu_i - r_i)` in the copy, with :math:`r_i` a row of the estimator's state.
    The paper's example has one (`HomodyneParameters.uncertain_system`): its errors are those of
    `monte_carlo` and `stationary_errors`.

    Parameters
    ----------
    smoother : Estimator
        Any design of this package. Every nonlinearity of its system needs its function: one of
        arrays, or a numba function of a number.
    uncertainties : sequence of k numbers, (r_s, h_s) arrays or functions
        Constants of norm at most one, as in `AugmentedSystem.structured_delta`, or functions
        ``xi(t, zeta)`` that map (h_s, paths) to (r_s, paths), with t in s, zero where averaging
        begins. Left out: zero.
    reference : {"system", "filtered", "smoothed"}, (g, n_c) array or None
        By default, each nonlinearity's own (`Nonlinearity`). "filtered" and "smoothed" are
        that estimate of every argument :math:`\nu_i`, which must be a combination of w. The rows of
        an array read any other reference out of the estimator's state. None is no reference, not
        even where a nonlinearity has one of its own.
    loop : {"real", "theory"}
        Whether the design's fictitious noise drives the copies, as in the theory; a real loop has
        none.
    runs : int
        Independent paths.
    duration : float, optional
        Of a path, without the warm-up, s; rounded to whole steps. Default: 100 times the slowest
        time constant of the linearised loop.
    step : float, optional
        s; must divide the lag into whole steps. Default: the largest such step that is at most a
        fifth of the loop's response time, that in which the nonlinearities' arguments change or act
        on each other. `robsmooth.nonlinear` has the bias that this makes.
    seed : int
        At least 0. A path depends on it, the path's number and the step alone.
    progress : bool
        Show a progress bar.

    Returns
    -------
    SimulationResult

    Warns
    -----
    InadmissibleWarning
        Where a constraint of the theory does not hold all the time.
    LongStepWarning
        Where the step is above 1/4 of the response time, and the loop is not linear.

    Raises
    ------
    UnstableLoopError
        Where the loop is not stable without its nonlinearities.
    RuntimeError
        Where a path diverges; it names the path and the time.
    ValueError, TypeError
        For an argument that is not as described, before anything is simulated.

    See Also
    --------
    sample_paths : The first of the paths.
    monte_carlo : A faster simulation of the paper's example.
    error_covariance : The errors of a linear loop, without simulation.

    References
    ----------
    Section II, equations (eqsystem), (eqIQC1) to (eqIQC4) and (eqcontrol).

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> smoother = rs.baselines.fixed_lag_smoother(system, delay=0.2, order=2)
    >>> result = rs.simulate(smoother, runs=64, duration=20.0)
    >>> exact = rs.error_covariance(smoother, smoother.plant.structured_delta([], []))[0, 0]
    >>> bool(abs(result.smoothed.mean_square - exact) < 4 * result.smoothed.standard_error)
    True
    """
    started = time.perf_counter()
    joined = nonlinear_loop(smoother, uncertainties, loop, reference)
    runs, seed = _counts(runs, seed)
    progress = validation.boolean("progress", progress)
    plan = _plan(joined, smoother.plant.delay, duration, step, TIME_CONSTANTS)
    integrator = ExponentialIntegrator.of(joined, plan.step)
    plant = smoother.plant
    m, constraints = plant.system.m, len(plant.M_i)
    errors, checks = Moments(2 * (m * m + 1)), np.zeros((3, constraints))
    with progress_bar(
        total=runs * plan.all_steps, unit="step", unit_scale=True, shown=progress
    ) as bar:
        for first in range(0, runs, BLOCK):
            paths = range(first, min(first + BLOCK, runs))
            of_errors, of_checks = _averages(integrator, plant, plan, seed, paths, bar)
            errors.add(of_errors)
            checks += of_checks.sum(axis=2) / runs

    used, allowed, violated = checks
    result = SimulationResult(
        smoothed=_error(errors, m * m + 1, m),
        filtered=_error(errors, 0, m),
        constraints=np.divide(used, allowed, out=np.zeros(constraints), where=used > 0.0),
        violated=violated,
        equivalent_delta=joined.delta.copy(),
        runs=runs,
        path_steps=runs * plan.all_steps,
        wall_time=time.perf_counter() - started,
        duration=plan.steps * plan.step,
        warm_up=plan.before * plan.step,
        step=plan.step,
        seed=seed,
    )
    _warn(plant, result)
    return result


@one_thread
def sample_paths(
    smoother: Estimator,
    *,
    uncertainties: Sequence[ArrayLike | Callable[[float, Matrix], ArrayLike]] = (),
    reference: Reference = "system",
    loop: str = "real",
    runs: int = 3,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
) -> SamplePaths:
    """Return the first of the paths that `simulate` averages, with what was measured.

    Parameters
    ----------
    smoother, uncertainties, reference, loop, runs, duration, step, seed
        As in `simulate`. The default duration is a fifth of the one there.

    Returns
    -------
    SamplePaths

    Warns
    -----
    LongStepWarning
        As in `simulate`.

    Raises
    ------
    UnstableLoopError, RuntimeError, ValueError, TypeError
        As in `simulate`.

    See Also
    --------
    simulate : The averages of many such paths.
    DiscreteSmoother.run : Estimates from the record y of a path.

    Examples
    --------
    >>> import robsmooth as rs
    >>> system = rs.UncertainSystem(
    ...     A=[[-1.0]], B1=[[1.0, 0.0]], C0=[[1.0]], C2=[[1.0]], D21=[[0.0, 0.1]]
    ... )
    >>> smoother = rs.baselines.fixed_lag_smoother(system, delay=0.2, order=2)
    >>> rs.sample_paths(smoother, runs=2, duration=5.0)
    SamplePaths(2 paths of 125 steps of 0.04 s, lag=0.2 s, 1 measurements, 1 outputs)
    """
    joined = nonlinear_loop(smoother, uncertainties, loop, reference)
    runs, seed = _counts(runs, seed)
    plan = _plan(joined, smoother.plant.delay, duration, step, TIME_CONSTANTS / 5)
    integrator = ExponentialIntegrator.of(joined, plan.step, measured=True)
    parts = list(_simulated_records(integrator, smoother.plant, plan, seed, range(runs)))
    whole = _Records(*(np.concatenate(chunks) for chunks in zip(*parts, strict=True)))
    series = {
        name: frozen(np.moveaxis(getattr(whole, name), 2, 0))
        for name in ("y", "reference", "w", "filtered", "delayed", "smoothed")
    }
    return SamplePaths(time=whole.time, step=plan.step, delay=smoother.plant.delay, **series)


# --- what is simulated ----------------------------------------------------------------------------


class _Plan(NamedTuple):
    """How long, in steps: before time zero, from there on, and the lag."""

    step: float
    before: int
    steps: int
    lag: int

    @property
    def all_steps(self) -> int:
        """Steps of a path."""
        return self.before + self.steps


def _counts(runs: int, seed: int) -> tuple[int, int]:
    return validation.integer("runs", runs, low=1), validation.integer("seed", seed, low=0)


def _plan(
    loop: NonlinearLoop,
    delay: float,
    duration: float | None,
    step: float | None,
    time_constants: float,
) -> _Plan:
    """Check duration and step, or fill in defaults."""
    slowest = loop.slowest_rate
    if duration is None:
        duration = time_constants / slowest
    duration = validation.positive("duration", duration)
    response_time = 1.0 / loop.argument_rate()
    default = dividing_step(delay, STEP_OF_TIME_CONSTANT * response_time, duration)
    step = validation.positive("step", default if step is None else step)
    warm_up = WARM_UP_TIME_CONSTANTS / slowest + delay
    plan = _Plan(
        step, math.ceil(warm_up / step), steps_in(duration, step), whole_steps(delay, step)
    )
    if not loop.is_linear:  # else the scheme is exact
        warn_of_long_step(step, response_time, SILENT, default, stacklevel=4)
    return plan


class _Records(NamedTuple):
    """Some consecutive records of all paths, each (steps, rows, paths), from time zero on."""

    time: NDArray  # (steps,), s
    w: NDArray
    filtered: NDArray
    delayed: NDArray
    smoothed: NDArray
    zeta: NDArray  # less the reference
    subtracted: NDArray  # the reference in zeta
    y: NDArray
    reference: NDArray


def _simulated_records(
    integrator: ExponentialIntegrator,
    plant: AugmentedSystem,
    plan: _Plan,
    seed: int,
    paths: range,
    bar=None,
) -> Iterator[_Records]:
    """Simulate paths; leave out what is before time zero."""
    m, g, arguments = plant.system.m, plant.system.g, len(integrator.loop.arguments)
    rows = np.cumsum([m, m, m, arguments, arguments])
    of_detectors = slice(arguments - 2 * g, arguments - g)
    past, last = np.zeros((plan.lag, m, len(paths))), np.zeros((1, g, len(paths)))
    for first, records in integrator.records(seed, paths, plan.before, plan.steps):
        w, filtered, smoothed, zeta, subtracted, y = np.split(records, rows, axis=1)
        outputs = np.concatenate([past, w])
        past = outputs[len(w) :]
        references = np.concatenate([last, subtracted[:, of_detectors]])
        last = references[-1:]
        means = (references[1:] + references[:-1]) / 2
        times = integrator.step * np.arange(first, first + len(w))
        parts = (times, w, filtered, outputs[: len(w)], smoothed, zeta, subtracted, y, means)
        yield _Records(*(part[max(0, 1 - first) :] for part in parts))
        if bar is not None:
            bar.update(len(records) * len(paths))


# --- what is made of it ---------------------------------------------------------------------------


def _averages(
    integrator: ExponentialIntegrator,
    plant: AugmentedSystem,
    plan: _Plan,
    seed: int,
    paths: range,
    bar,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulate paths and return their averages over time.

    Returns
    -------
    errors : (2 (m^2 + 1), paths) array
        The products of the filtered errors and their trace, then those of the smoothed errors.
    checks : (3, k + 3g, paths) array
        What `_constraints` returns.
    """
    m, samples = plant.system.m, 0
    products = np.zeros((2, m, m, len(paths)))
    checks = np.zeros((3, len(plant.M_i), len(paths)))
    for part in _simulated_records(integrator, plant, plan, seed, paths, bar):
        errors = (part.w - part.filtered, part.delayed - part.smoothed)
        products += [np.einsum("tip,tjp->ijp", error, error) for error in errors]
        for k in range(0, len(part.time), CHECK_EVERY):
            checks += _constraints(
                integrator.loop, plant, part.time[k], part.zeta[k], part.subtracted[k]
            )
            samples += 1
    products /= plan.steps
    traces = np.einsum("eiip->ep", products)[:, None]
    with_traces = np.concatenate([products.reshape(2, m * m, -1), traces], axis=1)
    return with_traces.reshape(2 * (m * m + 1), -1), checks / samples


def _constraints(
    loop: NonlinearLoop, plant: AugmentedSystem, time: float, zeta: NDArray, subtracted: NDArray
) -> NDArray[np.float64]:
    """Return what each constraint has at a time: (3, k + 3g, paths).

    That is xi' M_i xi, zeta' N_i zeta, and whether the former is larger: the zeta of the second has
    the whole arguments, with the reference that was `subtracted`, and that of the third has not.
    """
    xi = loop.delta @ zeta + loop.remainder(time, zeta)
    whole = zeta + subtracted
    used, allowed, allowed_less_reference = np.empty((3, len(plant.M_i), zeta.shape[1]))
    for i, (M, N) in enumerate(zip(plant.M_i, plant.N_i, strict=True)):
        used[i] = (xi * (M @ xi)).sum(axis=0)
        allowed[i] = (whole * (N @ whole)).sum(axis=0)
        allowed_less_reference[i] = (zeta * (N @ zeta)).sum(axis=0)
    return np.array([used, allowed, used > (1 + _CONSTRAINT_TOLERANCE) * allowed_less_reference])


def _error(errors: Moments, first: int, m: int) -> SimulatedError:
    """Return what the rows of `_averages` from `first` on are the moments of."""
    found = [errors.mean_square(first + i) for i in range(m * m + 1)]
    return SimulatedError(
        mean_square=found[-1].mean_square,
        standard_error=found[-1].standard_error,
        covariance=frozen(np.array([e.mean_square for e in found[:-1]]).reshape(m, m)),
        covariance_error=frozen(np.array([e.standard_error for e in found[:-1]]).reshape(m, m)),
    )


def _warn(plant: AugmentedSystem, result: SimulationResult) -> None:
    """Say which constraints do not hold all the time."""
    i_of = range(plant.system.g)
    names = [
        *(f"uncertainties[{s}]" for s in range(plant.system.k)),
        *(f"nonlinearities[{i}] less its copy" for i in i_of),
        *(f"nonlinearities[{i}]" for i in i_of),
        *(f"the copy of nonlinearities[{i}]" for i in i_of),
    ]
    found = [
        f"{name} for {violated:.2g} of the time ({used:.3g} in the mean)"
        for name, violated, used in zip(names, result.violated, result.constraints, strict=True)
        if violated > 0.0 or used > 1 + _CONSTRAINT_TOLERANCE
    ]
    if found:
        warnings.warn(
            "the loop left the region in which the theory's constraints hold: "
            f"{'; '.join(found)}; the guarantee needs at most 1 in the mean",
            InadmissibleWarning,
            stacklevel=4,
        )
