"""Many paths: simulated here or on a cluster, kept in a checkpoint, and merged in order.

A *group* of blocks has its own sums. It depends on the simulation alone; so do the last bits.
"""

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

import numba
import numpy as np

from robsmooth._numerics.vectors import BLOCK
from robsmooth._support import cluster, validation
from robsmooth._support.checkpoint import Journal
from robsmooth._support.progress import progress_bar
from robsmooth.simulation.statistics import Tally

BLOCKS_OF_A_GROUP = 256  # at most, for the memory
GROUPS_OF_A_CALL = 20  # on a cluster, at most: a client serves some 100 calls a second
CALLS_OF_A_THREAD = 8  # on a cluster, at least: threads then end at about the same time
CHECKPOINT_EVERY = 2.0  # s
_USED_BY = set[int]()  # processes; GNU OpenMP ends one that was forked after it began


def checked_seed(seed: int) -> int:
    """Return a seed that the compiled generators take; a RuntimeError says that numba is off."""
    if numba.config.DISABLE_JIT:
        raise RuntimeError("a simulation needs numba's compiler: unset NUMBA_DISABLE_JIT")
    return validation.integer("seed", seed, low=0, high=2**64 - 1)


@contextmanager
def threads(alone: bool = False) -> Iterator[None]:
    """Let compiled code use one thread, or those of this worker of a cluster, or numba's number."""
    if _USED_BY - {os.getpid()} and numba.threading_layer() == "omp":
        advice = "start it by spawn, or set NUMBA_THREADING_LAYER=workqueue first"
        raise RuntimeError(f"a process forked after a simulation has no threads: {advice}")
    _USED_BY.add(os.getpid())
    before = numba.get_num_threads()
    several = min(cluster.worker_threads() or before, numba.config.NUMBA_NUM_THREADS)
    numba.set_num_threads(1 if alone else several)  # of this thread
    try:
        with cluster.ALONE:
            yield
    finally:
        numba.set_num_threads(before)


def stoppable(compiled: Callable, *arguments: Any, results: validation.Matrix) -> None:
    """Call compiled code that ends when an array after its results says so: Ctrl-C does it."""
    stop = np.zeros(1, np.uint8)
    compiled(*arguments, results[:0], stop)  # which compiles it here, where Ctrl-C ends that
    with ThreadPoolExecutor(1, "", numba.set_num_threads, (numba.get_num_threads(),)) as thread:
        try:
            thread.submit(compiled, *arguments, results, stop).result()
        finally:
            stop[0] = 1


def tally_paths(
    simulation: Any, journal: Journal | None, client: "cluster.Client | None", progress: bool
) -> Tally:
    """Simulate the blocks that the journal does not have, and merge them in order.

    A simulation has a number of `runs`, of `steps` of a path, and of path-steps of a group. Its
    ``simulate(first, count, report)`` gives (count, outputs, BLOCK) of blocks, the last of them
    whole, and reports path-steps meanwhile. Its ``tally(path, outputs)`` sums up paths.
    """
    steps, end = simulation.steps, -(-simulation.runs // BLOCK)
    done = Tally(), 0  # of these blocks
    if journal and journal.last:
        done = Tally.from_state(*journal.last["tally"]), journal.last["blocks"]
    group = min(max(simulation.group_steps // (BLOCK * steps), 1), BLOCKS_OF_A_GROUP)
    if client is None:
        groups = numba.get_num_threads()
    else:
        groups = end // (group * CALLS_OF_A_THREAD * cluster.workers(client))
        groups = min(max(groups, 1), GROUPS_OF_A_CALL)
    size, saved, saved_at = groups * group, done, time.perf_counter()
    calls = ((first, min(size, end - first)) for first in range(done[1], end, size))  # and count
    # paths of the journal count for the progress, not for the rate
    extent = {"total": simulation.runs * steps, "initial": done[0].all.count * steps}
    with progress_bar(**extent, unit="step", unit_scale=True, shown=progress) as bar:
        report = bar.update if client is None else int  # which does nothing, on a worker
        simulate = partial(_tallies, simulation, group, report)
        try:
            for tallies in cluster.in_order(simulate, calls, client):
                done = sum(tallies, done[0]), min(done[1] + size, end)
                bar.update(done[0].all.count * steps - bar.n)
                if journal and time.perf_counter() - saved_at > CHECKPOINT_EVERY:
                    saved, saved_at = done, time.perf_counter()
                    journal.append({"blocks": done[1], "tally": done[0].state()})
        finally:  # after an error, too
            if journal and saved is not done:
                journal.append({"blocks": done[1], "tally": done[0].state()})
    return done[0]


def _tallies(
    simulation: Any, group: int, report: Callable[[int], object], first: int, count: int
) -> list[Tally]:
    """Simulate `count` blocks and sum up each group."""
    results, tallies = simulation.simulate(first, count, report), []
    for offset in range(0, count, group):
        path = (first + offset) * BLOCK
        outputs = np.hstack(list(results[offset : offset + group]))[:, : simulation.runs - path]
        tallies.append(simulation.tally(path, outputs))
    return tallies
