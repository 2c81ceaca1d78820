"""Run the Monte Carlo: check the arguments, simulate block by block, merge in order.

A `Simulation` is all that the paths depend on. It simulates any range of blocks of `LANES` paths,
always with the same result for a block, so blocks may be computed anywhere and in any order, as
long as they are merged in the order of their index.
"""

import hashlib
import math
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from robsmooth import validation
from robsmooth.loop import Loop, homodyne_loop
from robsmooth.montecarlo import kernels
from robsmooth.montecarlo.kernels import FILTERED, OUTPUTS, SLIPPED, SMOOTHED
from robsmooth.montecarlo.noise import GENERATOR, LANES
from robsmooth.montecarlo.protocols import (
    PROTOCOLS,
    SAMPLES_PER_TIME_CONSTANT,
    MeanSquare,
    Moments,
    Schedule,
    end_of_run,
    time_average,
    warm_up_time,
)
from robsmooth.montecarlo.schemes import EulerLoop, euler

PRECISIONS = {"mixed": np.float64, "single": np.float32}

PAPER_RUNS, PAPER_DURATION, PAPER_STEP = 50_000, 1e-3, 1e-8
ERGODIC_RUNS = 1024
ERGODIC_TIME_CONSTANTS = 250  # default duration, in units of the estimator's slowest mode
ERGODIC_STEPS_PER_TIME_CONSTANT = 100  # default step, in units of the estimator's fastest mode

STEPS_PER_CALL = 50_000_000  # path-steps a thread between updates of the progress bar
BLOCKS_PER_CALL = 1024  # a thread, at most: bounds the memory
MULTIPLE_TOLERANCE = 1e-6  # how far delay / step may be from a whole number


@dataclass(frozen=True)
class MonteCarloResult:
    """Mean square errors of the filter and the smoother in the nonlinear loop.

    Attributes
    ----------
    smoothed, filtered : MeanSquare
        ``.mean_square`` and ``.standard_error``, rad^2. Paths that lost lock are included.
    runs : int
        Independent paths.
    path_steps : int
        Steps simulated, over all paths, the warm-up included.
    wall_time : float
        s, the compilation included where the kernel had not been compiled before.
    protocol : str
    duration : float
        Of a path, without the warm-up, in whole steps, s.
    warm_up : float
        Simulated before sampling began, s.
    step : float
        s.
    seed : int
    precision : str
    slips : int
        Paths in which the phase was more than half a turn away from the local oscillator's at a
        time when the errors were sampled: the loop had lost lock. Where this is not zero the mean
        squares depend on the duration, because an error of a whole turn is invisible to the loop.
    provenance : dict
        Everything else that the numbers depend on, in a JSON form.
    """

    smoothed: MeanSquare
    filtered: MeanSquare
    runs: int
    path_steps: int
    wall_time: float
    protocol: str
    duration: float
    warm_up: float
    step: float
    seed: int
    precision: str
    slips: int
    provenance: dict = field(repr=False)

    def to_dict(self) -> dict:
        """All fields as a dict that the json module writes; a number that is none becomes None."""
        result = dict(vars(self))
        for name in ("smoothed", "filtered"):
            values = vars(result[name]).items()
            result[name] = {key: value if math.isfinite(value) else None for key, value in values}
        return result

    def __repr__(self) -> str:
        def text(error: MeanSquare) -> str:
            return f"{error.mean_square:.6g} +- {error.standard_error:.2g}"

        slipped = f"{self.slips} of {self.runs} paths lost lock" if self.slips else "no slips"
        return (
            f"MonteCarloResult(smoothed {text(self.smoothed)} rad^2, "
            f"filtered {text(self.filtered)} rad^2, {slipped}; {self.protocol}: {self.runs} runs "
            f"of {self.duration:.4g} s, step {self.step:.4g} s, seed {self.seed}, "
            f"{self.precision}; {self.path_steps:.3g} path-steps in {self.wall_time:.2g} s)"
        )


@dataclass(frozen=True, eq=False)
class Simulation:
    """What every path depends on, together with its index.

    Attributes
    ----------
    coefficients : EulerLoop
    schedule : Schedule
    runs : int
        Paths; the last block is simulated whole, but only its first paths are returned.
    seed : int
    precision : str
    """

    coefficients: EulerLoop
    schedule: Schedule
    runs: int
    seed: int
    precision: str

    @property
    def blocks(self) -> int:
        """Number of blocks of `LANES` paths."""
        return -(-self.runs // LANES)

    def paths(self, block: int) -> int:
        """Number of paths of a block that count."""
        return min(LANES, self.runs - block * LANES)

    def simulate(self, first: int, count: int) -> NDArray[np.float64]:
        """Simulate blocks `first` to ``first + count - 1``.

        Returns
        -------
        (count, OUTPUTS, LANES) array
            See `robsmooth.montecarlo.kernels.simulate_blocks`.
        """
        real = PRECISIONS[self.precision]
        order = self.coefficients.readout.shape[1]
        states = np.empty((count, kernels.rows(order) * LANES), real)
        results = np.empty((count, OUTPUTS, LANES))
        kernels.simulate_blocks(
            (0,) * order,
            self.coefficients.phase_step.astype(real),
            self.coefficients.estimator_step.astype(real),
            self.coefficients.readout,
            tuple(self.schedule),
            np.uint64(self.seed),
            first,
            states,
            results,
        )
        return results


def monte_carlo(
    parameters,
    smoother,
    protocol: str = "ergodic",
    runs: int | None = None,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
    precision: str = "mixed",
    client: None = None,
    checkpoint: None = None,
    progress: bool = False,
    *,
    oscillator: str = "filtered",
    copy: bool = True,
    nonlinearity: str = "difference",
    shot_noise: float = 1.0,
    threads: int | None = None,
) -> MonteCarloResult:
    r"""Simulate an estimator in the nonlinear adaptive homodyne loop and measure its errors.

    The loop, in the docstring of `robsmooth.loop`, is integrated with the
    Euler-Maruyama scheme from :math:`\varphi = 0`, :math:`\hat x = 0`. The scheme's bias is of the
    first order in the step: with the paper's values +0.23% of the filtered mean square error and
    -0.03% of the smoothed one at 0.01 us.

    Parameters
    ----------
    parameters : HomodyneParameters
        The optical loop; any object with the numbers ``lam``, ``kappa``, ``alpha``, ``beta`` and
        ``gamma`` will do.
    smoother : RobustSmoother
        The estimator; any object with ``A_c`` (n, n), ``B_c`` (n, 1 + g), ``C_c`` (1 + g, n),
        ``C_a`` (1, n) and ``plant.delay`` in seconds will do, where g is 0 or 1. The filtered
        estimate is ``C_f`` (1, n) times the state where there is one, else the first of ``C_c``.
    protocol : {"ergodic", "paper"}
        "paper" is the published simulation: the squared errors at the end of each run, averaged
        over runs. "ergodic" leaves out a warm-up, after which the variances of the linearised
        loop's errors are within 0.1% of the stationary ones, and then averages along each path too.
    runs : int, optional
        Independent paths. Default: 50 000 ("paper") or 1024 ("ergodic").
    duration : float, optional
        Of a path, without the warm-up, s; rounded to whole steps. Default: 1 ms ("paper") or 250
        times the slowest time constant of the linearised estimator ("ergodic").
    step : float, optional
        s; must divide the smoother's delay into whole steps. Default: the largest such step that is
        at most 0.01 us ("paper") or a hundredth of the fastest time constant ("ergodic").
    seed : int
        At least 0 and below 2^64. Path i has the same noise for the same seed, whatever else.
    precision : {"mixed", "single"}
        Noise is always drawn in single precision; "mixed" keeps the state in double precision.
    client, checkpoint : None
        Reserved for a cluster to run on and a file to resume from; this release has neither.
    progress : bool
        Show a progress bar.
    oscillator : {"filtered", "smoothed"}
        The estimate that the local oscillator's phase u follows.
    copy : bool
        Whether the estimator runs its copy of the nonlinearity; without, its input is zero.
    nonlinearity : {"difference", "literal"}
        The nonlinearity is :math:`f(\varphi - u)`, as derived in Section IV-A, or
        :math:`f(\varphi)`, as the words of Section IV-E have it.
    shot_noise : float
        Power of the photocurrent's noise, :math:`s` in :math:`\sqrt s\,dW`.
    threads : int, optional
        Default: as numba is set. The result does not depend on it.

    Returns
    -------
    MonteCarloResult

    Raises
    ------
    TypeError, ValueError
        For an argument that is not as described, before anything is simulated.
    UnstableLoopError
        For the ergodic protocol where the linearised loop is not stable.
    RuntimeError
        Where a path overflows; it names the first such path.

    References
    ----------
    Rehman and Petersen, "A robust continuous time fixed lag smoother for nonlinear uncertain
    systems", Section IV.
    """
    started = time.perf_counter()
    validation.choice("protocol", protocol, PROTOCOLS)
    options = {
        "oscillator": oscillator,
        "copy": copy,
        "nonlinearity": nonlinearity,
        "shot_noise": shot_noise,
    }
    loop = homodyne_loop(parameters, smoother, **options)
    simulation, step, warm_up, duration = _plan(
        loop, protocol, runs, duration, step, seed, precision
    )
    for name, value in (("client", client), ("checkpoint", checkpoint)):
        if value is not None:
            raise NotImplementedError(f"{name} must be None in this release, got {value!r}")
    if not isinstance(progress, bool | np.bool_):
        raise TypeError(f"progress must be True or False, got {progress!r}")

    filtered, smoothed, slips = Moments(), Moments(), 0
    with _threads(threads), _progress_bar(simulation.runs, progress) as bar:
        for first, results in _batches(simulation):
            for block, values in enumerate(results, first):
                values = values[:, : simulation.paths(block)]
                _check_finite(values, block, loop, step)
                filtered.add(values[FILTERED])
                smoothed.add(values[SMOOTHED])
                slips += int(values[SLIPPED].sum())
            bar.update(filtered.count - bar.n)

    return MonteCarloResult(
        smoothed=smoothed.mean_square(),
        filtered=filtered.mean_square(),
        runs=simulation.runs,
        path_steps=simulation.runs * simulation.schedule.steps,
        wall_time=time.perf_counter() - started,
        protocol=protocol,
        duration=duration,
        warm_up=warm_up,
        step=step,
        seed=simulation.seed,
        precision=precision,
        slips=slips,
        provenance={
            "parameters": {name: float(getattr(parameters, name)) for name in _PARAMETERS},
            "delay": loop.delay,
            **options,
            "copy": bool(copy),
            "shot_noise": float(shot_noise),
            "estimator_sha256": _estimator_digest(smoother),
            "generator": GENERATOR,
            "versions": {
                "python": platform.python_version(),
                "numpy": np.__version__,
                "numba": numba.__version__,
            },
        },
    )


_PARAMETERS = ("lam", "kappa", "alpha", "beta", "gamma")


# --- the plan of a run ----------------------------------------------------------------------------


def _plan(
    loop: Loop,
    protocol: str,
    runs: int | None,
    duration: float | None,
    step: float | None,
    seed: int,
    precision: str,
) -> tuple[Simulation, float, float, float]:
    """Check the numbers and fill in defaults: the simulation, its step, warm-up and duration, s."""
    paper = protocol == "paper"
    slowest, fastest = loop.rates()
    if runs is None:
        runs = PAPER_RUNS if paper else ERGODIC_RUNS
    runs = validation.integer("runs", runs, low=1)
    if duration is not None:
        duration = validation.positive("duration", duration)
    if step is not None:
        step = validation.positive("step", step)
    seed = validation.integer("seed", seed, low=0)
    if seed >= 2**64:
        raise ValueError(f"seed must be below 2**64, got {seed}")
    validation.choice("precision", precision, tuple(PRECISIONS))

    warm_up = 0.0 if paper else warm_up_time(loop)
    if duration is None:
        duration = PAPER_DURATION if paper else max(ERGODIC_TIME_CONSTANTS / slowest, loop.delay)
    if duration < loop.delay:
        raise ValueError(
            f"duration must be at least the smoother's delay, {loop.delay:g} s, got {duration:g}"
        )
    if step is None:
        # A delay of a multiple of 16 steps leaves a choice of intervals between samples.
        longest = PAPER_STEP if paper else 1 / (ERGODIC_STEPS_PER_TIME_CONSTANT * fastest)
        multiple = 1 if paper else 16
        step = min(longest, duration)
        if loop.delay > 0:
            step = loop.delay / (multiple * math.ceil(loop.delay / step / multiple - 1e-9))
    delay_steps = _whole_steps(loop.delay, step)
    steps = round(duration / step)
    if steps < 1:
        raise ValueError(f"duration must be at least one step, {step:g} s, got {duration:g}")

    if paper:
        schedule = end_of_run(steps, delay_steps)
    else:
        schedule = time_average(
            warm_up=math.ceil(warm_up / step),
            steps=steps,
            delay=delay_steps,
            longest_stride=int(1 / (SAMPLES_PER_TIME_CONSTANT * fastest * step)),
        )
    simulation = Simulation(euler(loop, step), schedule, runs, seed, precision)
    return simulation, step, (schedule.steps - steps) * step, steps * step


def _whole_steps(delay: float, step: float) -> int:
    """Return delay / step where it is a whole number; else say which steps would do."""
    ratio = delay / step
    nearest = round(ratio)
    if abs(ratio - nearest) <= MULTIPLE_TOLERANCE and (nearest > 0 or delay == 0):
        return nearest
    fewer = max(1, math.floor(ratio))
    raise ValueError(
        f"step must divide the smoother's delay, {delay:g} s, into whole steps, got {step:g} "
        f"({ratio:.6g} steps): the nearest that do are {delay / fewer:.12g} ({fewer} steps) and "
        f"{delay / (fewer + 1):.12g} ({fewer + 1} steps)"
    )


# --- carrying it out ------------------------------------------------------------------------------


def _batches(simulation: Simulation) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Simulate all blocks in order, a batch at a time: yield its first block and its results."""
    threads = numba.get_num_threads()
    of_a_thread = STEPS_PER_CALL // (LANES * simulation.schedule.steps)
    batch = threads * min(max(of_a_thread, 1), BLOCKS_PER_CALL)
    for first in range(0, simulation.blocks, batch):
        yield first, simulation.simulate(first, min(batch, simulation.blocks - first))


def _check_finite(values: NDArray[np.float64], block: int, loop: Loop, step: float) -> None:
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=0))
    if wrong.size:
        fastest = loop.rates()[1]
        raise RuntimeError(
            f"path {block * LANES + wrong[0]} overflowed: the step, {step:g} s, is too long for "
            f"this loop (a step of {0.1 / fastest:.2g} s would be a tenth of its fastest time "
            "constant), or the estimator is unstable in it"
        )


@contextmanager
def _threads(threads: int | None) -> Iterator[None]:
    """Set numba's number of threads, and set it back."""
    if threads is None:
        yield
        return
    most = numba.config.NUMBA_NUM_THREADS
    if validation.integer("threads", threads, low=1) > most:
        raise ValueError(
            f"threads must be at most {most}, numba's limit here, got {threads}: set the "
            "environment variable NUMBA_NUM_THREADS to have more"
        )
    before = numba.get_num_threads()
    numba.set_num_threads(int(threads))
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _progress_bar(runs: int, progress: bool) -> tqdm:
    return tqdm(total=runs, unit="path", unit_scale=True, disable=not progress)


def _estimator_digest(smoother) -> str:
    digest = hashlib.sha256()
    for name in ("A_c", "B_c", "C_c", "C_a", "C_f"):
        matrix = np.ascontiguousarray(getattr(smoother, name, smoother.C_c[:1]), dtype=float)
        digest.update(f"{name}{matrix.shape}".encode() + matrix.tobytes())
    return digest.hexdigest()
