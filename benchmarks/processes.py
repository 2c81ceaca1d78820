"""What path-steps cost: on one core, on two threads, on two processes of a cluster, and beyond.

All run the paper's protocol and take turns. Beyond two cores nothing is measured: `cost` multiplies
what is, with the assumptions in `ASSUMED`. Run as ``python -m benchmarks.processes``, because a
process of a cluster imports what started it; it prints JSON.
"""

import argparse
import json
import time

import numba
import numpy as np

import robsmooth as rs
from benchmarks.problem import STEP, STEPS
from benchmarks.race import middle, say
from benchmarks.timing import interleaved
from robsmooth._support.cluster import in_order
from robsmooth.homodyne.montecarlo.protocols import Simulation
from robsmooth.paper import published
from robsmooth.simulation.groups import GROUPS_OF_A_CALL

RUNS, STEPS_OF_A_RUN = 65_536, 5000  # eight calls, of the largest groups of paths that there are
QUICK_RUNS, QUICK_STEPS = 2048, 1000
EMPTY_CALLS, QUICK_EMPTY_CALLS = 1000, 100
SIZES = (5e9, 1e12, 1e13, 1e14, 1e15)  # path-steps; the first is the published simulation
ASSUMED = (
    "every core is as fast as this one and has a worker with one thread",
    "as many workers as there are cores lose no more to each other than two do here: nothing is "
    "shared but the caches and the memory's bandwidth, of which a block of paths needs little",
    "calls are of the largest size, which a run of that many path-steps makes them",
    "the client and the scheduler take as long for a call of many workers as for one of two, and "
    "the network takes no time",
    "no worker is lost",
)


def processes(rounds: int, runs: int, steps: int, empty_calls: int) -> dict:
    """Measure the rates, and what a cluster adds: a call, a start, memory."""
    from distributed import Client, LocalCluster

    smoother = published.recomputed_estimator()

    def simulate(precision="mixed", client=None, threads=1):
        numba.set_num_threads(threads)
        of = {"runs": runs, "duration": steps * STEP, "step": STEP}
        of |= {"precision": precision, "client": client}
        return rs.monte_carlo(rs.homodyne.PAPER, smoother, "paper", **of)

    started = time.perf_counter()
    address = {"host": "127.0.0.1", "dashboard_address": None}
    address["scheduler_kwargs"] = {"dashboard_address": "127.0.0.1:0"}
    two = {"n_workers": 2, "threads_per_worker": 1, "processes": True}
    with LocalCluster(**two, **address) as cluster, Client(cluster) as client:
        same = simulate(client=client).smoothed == simulate().smoothed
        start = time.perf_counter() - started
        most = min(2, numba.config.NUMBA_NUM_THREADS)
        calls = {
            "one": simulate,
            "single": lambda: simulate("single"),
            "threads": lambda: simulate(threads=most),
            "processes": lambda: simulate(client=client),
        }
        times = interleaved(calls, rounds)
        empty = interleaved({"calls": lambda: drained(client, empty_calls)}, rounds)["calls"]
        memory = max(client.run(peak_memory).values())
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    rates = {name: middle(runs * steps / np.array(each)) for name, each in times.items()}
    ratios = {name: middle(np.divide(times["one"], times[name])) for name in calls}
    return {
        "rounds": rounds,
        "path_steps": runs * steps,
        "same_bits": same,
        "start": start,
        "rates": {name: rate for name, (rate, _) in rates.items()},
        "speed_up": {name: [ratio, *spread] for name, (ratio, spread) in ratios.items()},
        "call": middle(np.divide(empty, empty_calls))[0],
        "megabytes": memory / 1e6,
        "worth": worth(smoother, runs, steps),
    }


def drained(client, count: int) -> None:
    """Have a cluster compute calls that do nothing."""
    for _ in in_order(abs, ((number,) for number in range(count)), client):
        pass


def peak_memory() -> int:
    """Return the largest memory of this process so far, in bytes."""
    import resource
    import sys

    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def worth(smoother, runs: int, steps: int) -> dict:
    """Return the default answer's error, and the path-steps that the paper's protocol needs."""
    answer = rs.monte_carlo(rs.homodyne.PAPER, smoother)
    of = {"runs": runs, "duration": steps * STEP, "step": STEP}
    literal = rs.monte_carlo(rs.homodyne.PAPER, smoother, "paper", **of).smoothed
    needed = runs * (literal.standard_error / answer.smoothed.standard_error) ** 2 * STEPS
    relative = answer.smoothed.standard_error / answer.smoothed.mean_square
    return {"relative": relative, "path_steps": answer.path_steps, "literal": needed}


def cost(measured: dict) -> dict:
    """Return how long simulations take on more cores, and how many a client can feed."""
    rate = measured["rates"]["one"]
    share = min(measured["speed_up"]["processes"][0] / 2, 1.0)  # of a core, that a process has
    longest = Simulation.group_steps * GROUPS_OF_A_CALL / rate
    rows = []
    for size in SIZES:
        seconds = size / (rate * share)
        rows.append({"path_steps": size, "core_seconds": seconds})
    return {"share": share, "call": longest, "fed": longest / measured["call"], "rows": rows}


def main() -> None:
    """Measure, and print what came out as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    quick_effort = (1, QUICK_RUNS, QUICK_STEPS, QUICK_EMPTY_CALLS)
    effort = quick_effort if quick else (3, RUNS, STEPS_OF_A_RUN, EMPTY_CALLS)
    say("on a cluster")
    measured = processes(*effort)
    say("")
    print(json.dumps({**measured, "cost": cost(measured)}))


if __name__ == "__main__":
    main()
