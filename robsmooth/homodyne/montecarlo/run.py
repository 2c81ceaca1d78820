"""Run the Monte Carlo: check the arguments, simulate group by group, merge in order.

A *group* is as many blocks as a thread simulates at a time. Their paths are summed up where they
are simulated; what is merged here, and sent over a network, is a group's sums. Groups depend on
nothing but the simulation, so the last bits of the result depend on nothing else, either.
"""

import hashlib
import os
import platform
import time
import warnings
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from robsmooth._support import cluster, validation
from robsmooth._support.checkpoint import Journal, open_journal
from robsmooth._support.kernels import check_compiler
from robsmooth._support.progress import progress_bar
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import homodyne_loop, numbers_of
from robsmooth.homodyne.montecarlo.kernels import threads_of_kernels
from robsmooth.homodyne.montecarlo.noise import BLOCK, GENERATOR
from robsmooth.homodyne.montecarlo.protocols import PROTOCOLS, Simulation, plan
from robsmooth.homodyne.montecarlo.result import LossOfLockWarning, MonteCarloResult
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.simulation.statistics import Tally

if TYPE_CHECKING:
    from distributed import Client

STEPS_OF_A_GROUP = 400_000_000  # path-steps: about half a second
BLOCKS_OF_A_GROUP = 256  # at most: bounds the memory
GROUPS_OF_A_CALL = 20  # on a cluster, at most: a client keeps up with some 100 calls a second
CALLS_OF_A_THREAD = 8  # on a cluster, at least: its threads then end at about the same time
CHECKPOINT_EVERY = 2.0  # s


def monte_carlo(
    parameters: HomodyneParameters,
    smoother: Estimator,
    protocol: str = "ergodic",
    runs: int | None = None,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
    precision: str = "mixed",
    client: "Client | None" = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = False,
    *,
    oscillator: str = "filtered",
    copy: bool = True,
    nonlinearity: str = "difference",
    shot_noise: float = 1.0,
    threads: int | None = None,
) -> MonteCarloResult:
    r"""Simulate an estimator in the homodyne loop of Section IV and measure its errors.

    The numbers are the same, to the last bit, for any number of threads, on a cluster, and after an
    interruption; the noise of a path depends on the seed and its index alone.

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
        "paper" is the published simulation: Euler-Maruyama from zero, the squared errors at the end
        of each run. "ergodic" gives the stationary errors in far less time: it averages along each
        path, with steps of the second order and the linearised loop as a control variate.
    runs : int, optional
        Independent paths. Default: 50 000 ("paper") or 1024 ("ergodic").
    duration : float, optional
        Of a path, without the warm-up, s; rounded to whole steps. Default: 1 ms ("paper") or 250
        times the slowest time constant of the linearised estimator ("ergodic").
    step : float, optional
        s; must divide the smoother's delay into whole steps. Default: the largest such step that is
        at most 0.01 us ("paper") or a fifth of the loop's response time ("ergodic").
    seed : int
        At least 0 and below 2^64.
    precision : {"mixed", "single"}
        Of the state: double or single. Noise is always drawn in single precision.
    client : distributed.Client, optional
        A Dask cluster to compute on, see `robsmooth.workbench.connect`. Default: this machine.
    checkpoint : path, optional
        A file to which progress is saved every few seconds, and from which the same call resumes.
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
        Of this machine. Default: as numba is set.

    Returns
    -------
    MonteCarloResult

    Warns
    -----
    LossOfLockWarning, LongStepWarning
        Where a path slipped, or the step is above 1/40 ("paper") or 1/4 ("ergodic") of the loop's
        response time.

    Raises
    ------
    TypeError, ValueError
        For an argument that is not as described, a step with which the Euler scheme is unstable
        ("paper"), or a checkpoint of another call (CheckpointError), before anything is simulated.
    UnstableLoopError, RuntimeError
        Where the linearised loop is not stable ("ergodic"); where a path overflows, or numba's
        compiler is switched off.
    ConnectionError, OSError
        Where the cluster is lost, or the checkpoint cannot be written.

    See Also
    --------
    stationary_errors, simulate : without sampling; for the loop of any nonlinear system.

    Examples
    --------
    >>> import robsmooth as rs
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> result = rs.monte_carlo(rs.homodyne.PAPER, kalman, runs=256)
    >>> print(f"{result.filtered.mean_square:.3f} rad^2, {result.slips} slips")
    0.088 rad^2, 0 slips
    """
    started = time.perf_counter()
    check_compiler("monte_carlo")
    validation.choice("protocol", protocol, tuple(PROTOCOLS))
    options = {"oscillator": oscillator, "copy": copy, "nonlinearity": nonlinearity}
    loop = homodyne_loop(parameters, smoother, **options, shot_noise=shot_noise)
    simulation = plan(loop, protocol, runs, duration, step, seed, precision)
    simulation.check_step(loop, stacklevel=2)
    validation.boolean("progress", progress)
    _check_threads(threads, client)
    inputs = {
        "parameters": numbers_of(parameters),
        "delay": loop.delay,
        **options,
        "copy": bool(copy),
        "shot_noise": float(shot_noise),
        "estimator_sha256": _estimator_digest(smoother),
    }
    settings, scheme = simulation.settings(), {"scheme": simulation.scheme}
    identity = {**settings, **scheme, **inputs, "software": cluster.software()}
    with threads_of_kernels(threads), open_journal(checkpoint, identity) as journal:
        tally = _tally(simulation, journal, client, progress, inputs["parameters"])

    if tally.slips:
        warnings.warn(
            f"the loop lost lock: {tally.slips} cycle slips in {tally.slipped_paths} of "
            f"{simulation.runs} paths, whose errors of whole turns are in the mean squares",
            LossOfLockWarning,
            stacklevel=2,
        )
    filtered, smoothed = simulation.estimate(tally)
    versions = {"python": platform.python_version(), "numpy": np.__version__}
    versions["numba"] = numba.__version__
    return MonteCarloResult(
        smoothed=smoothed,
        filtered=filtered,
        filtered_in_lock=tally.locked.mean_square(0),
        smoothed_in_lock=tally.locked.mean_square(1),
        slips=tally.slips,
        slipped_paths=tally.slipped_paths,
        path_steps=simulation.runs * simulation.steps,
        wall_time=time.perf_counter() - started,
        **settings,
        provenance={**inputs, **scheme, "generator": GENERATOR, "versions": versions},
    )


def _check_threads(threads: int | None, client) -> None:
    if threads is None:
        return
    if client is not None:
        raise ValueError("threads are of this machine: give either threads or client, not both")
    most = numba.config.NUMBA_NUM_THREADS
    if validation.integer("threads", threads, low=1) > most:
        raise ValueError(
            f"threads must be at most {most}, numba's limit here, got {threads}: set the "
            "environment variable NUMBA_NUM_THREADS to have more"
        )


def _estimator_digest(smoother) -> str:
    digest = hashlib.sha256()
    for name in ("A_c", "B_c", "C_c", "C_a", "C_f"):
        matrix = np.ascontiguousarray(getattr(smoother, name, smoother.C_c[:1]), dtype=float)
        digest.update(f"{name}{matrix.shape}".encode() + matrix.tobytes())
    return digest.hexdigest()


# --- carrying it out ------------------------------------------------------------------------------


def _tally(
    simulation: Simulation, journal: Journal | None, client, progress: bool, parameters: dict
) -> Tally:
    """Simulate the blocks that the journal does not have, wherever, and merge them in order."""
    tally, first = Tally(simulation.variables), 0
    if journal is not None and journal.last is not None:
        tally, first = Tally.from_state(journal.last["tally"]), journal.last["blocks"]
    if first < simulation.blocks:
        _ = simulation.weights  # computed here, for all machines
    group = min(max(STEPS_OF_A_GROUP // (BLOCK * simulation.steps), 1), BLOCKS_OF_A_GROUP)
    simulate = partial(_tallies, simulation, group, parameters)
    calls = _calls(simulation, group, first, client)
    saved = time.perf_counter()
    # what was done before counts for the progress, but not for the rate
    extent = {"total": simulation.runs, "initial": tally.all.count, "unit": "path"}
    with progress_bar(**extent, unit_scale=True, shown=progress) as bar:
        for tallies in cluster.in_order(simulate, calls, client):
            for each in tallies:
                tally.merge(each)
            first = min(first + len(tallies) * group, simulation.blocks)
            bar.update(tally.all.count - bar.n)
            due = time.perf_counter() - saved > CHECKPOINT_EVERY or first == simulation.blocks
            if journal is not None and due:
                journal.append({"blocks": first, "tally": tally.state()})
                saved = time.perf_counter()
    return tally


def _calls(simulation: Simulation, group: int, first: int, client) -> Iterator[tuple[int, int]]:
    """Calls for the blocks from `first` on: (first block, number of blocks), of whole groups."""
    if client is None:
        groups = numba.get_num_threads()
    else:
        threads = cluster.workers(client)
        groups = simulation.blocks // (group * CALLS_OF_A_THREAD * threads)
        groups = min(max(groups, 1), GROUPS_OF_A_CALL)
    for start in range(first, simulation.blocks, groups * group):
        yield start, min(groups * group, simulation.blocks - start)


def _tallies(
    simulation: Simulation, group: int, parameters: dict, first: int, count: int
) -> list[Tally]:
    """Simulate `count` blocks, here or on a worker, and sum up each group of them."""
    at_once = group * (cluster.worker_threads() or numba.get_num_threads())
    end, tallies = first + count, []
    for start in range(first, end, at_once):
        results = simulation.simulate(start, min(at_once, end - start))
        for offset in range(0, len(results), group):
            path = (start + offset) * BLOCK
            values = np.hstack(list(results[offset : offset + group]))
            values = values[:, : simulation.runs - path]
            _check_finite(values, path, simulation, parameters)
            tallies.append(Tally(simulation.variables))
            tallies[-1].add(simulation.reduce(values[:-1]), values[-1])
    return tallies


def _check_finite(
    values: NDArray[np.float64], path: int, simulation: Simulation, parameters: dict
) -> None:
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=0))
    if wrong.size:
        given = ", ".join(f"{name}={value:g}" for name, value in parameters.items())
        raise RuntimeError(
            f"path {path + wrong[0]} of seed {simulation.seed} overflowed, with {given}: "
            f"the step, {simulation.step:g} s, is too long for this loop, or the estimator is "
            "unstable in it"
        )
