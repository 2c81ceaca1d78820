"""How robsmooth's time and memory grow with threads, runs, steps and the order of the delay model.

All with the literal protocol's step and, but for the precision's default, through the public call.
"""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass

import numba
import numpy as np

from benchmarks.problem import RUNS, STEP, STEPS, literal_problem
from benchmarks.race import middle
from robsmooth import homodyne, monte_carlo
from robsmooth.estimators import baselines
from robsmooth.paper.published import DELAY


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes
    ----------
    rounds : int
    runs : int
        Of the curves; the largest of the curve against runs is eight times as many.
    steps : int
        Of the curves; the largest of the curve against steps is eight times as many.
    memory_runs : tuple of int
        Runs at whose end the memory is read.
    orders : tuple of int
        Of the delay model; the first is without one.
    whole : bool
        Whether to take the time of what takes long: the whole protocol, and compiling.
    """

    rounds: int
    runs: int
    steps: int
    memory_runs: tuple[int, ...]
    orders: tuple[int, ...]
    whole: bool


FULL = Effort(7, 3840, 12_500, (1_000, 10_000, 100_000, 1_000_000), (0, 1, 2, 4, 8), True)
QUICK = Effort(2, 960, 1000, (1_000, 10_000), (0, 2), False)


def scales(effort: Effort) -> dict:
    """Measure everything."""
    whole = {"protocol": seconds(RUNS, STEPS, literal_problem().smoother)} if effort.whole else {}
    return {
        **whole,
        "threads": threads(effort),
        "runs": against(effort, "runs"),
        "steps": against(effort, "steps"),
        "memory": in_new_process("memory", effort.memory_runs),
        "orders": orders(effort),
        "first_call": first_call(effort),
    }


def seconds(runs: int, steps: int, smoother, seed: int = 0, threads: int | None = None) -> float:
    """Return how long a simulation takes."""
    numba.set_num_threads(threads or numba.config.NUMBA_NUM_THREADS)
    result = monte_carlo(
        homodyne.PAPER,
        smoother,
        protocol="paper",
        runs=runs,
        duration=steps * STEP,
        step=STEP,
        seed=seed,
    )
    return result.wall_time


def interleaved(effort: Effort, cases: dict) -> dict[str, list[float]]:
    """Return the times of each round for each case, a dict of arguments of `seconds`."""
    times = {case: [] for case in cases}
    for number in range(effort.rounds + 1):
        for case, arguments in cases.items():
            taken = seconds(**arguments, seed=number)
            if number:  # the first round may compile
                times[case].append(taken)
    return times


def threads(effort: Effort) -> list[dict]:
    """Return the speed-up over one thread, up to one thread a core."""
    smoother = literal_problem().smoother
    most = min(numba.config.NUMBA_NUM_THREADS, cores())
    counts = sorted({*(2**k for k in range(most.bit_length())), most})
    work = {"runs": 2 * effort.runs, "steps": 4 * effort.steps, "smoother": smoother}
    times = interleaved(effort, {count: {**work, "threads": count} for count in counts})
    result = []
    for count in counts:
        speed_up, quartiles = middle(np.divide(times[1], times[count]))
        result.append({"threads": count, "speed_up": speed_up, "quartiles": quartiles})
    return result


def against(effort: Effort, what: str) -> dict:
    """Return the time against runs or steps on all cores, and the exponent that fits it."""
    base = {"runs": effort.runs, "steps": effort.steps, "smoother": literal_problem().smoother}
    sizes = [base[what] * factor for factor in (1, 2, 4, 8)]
    times = interleaved(effort, {size: {**base, what: size} for size in sizes})
    rounds = zip(*times.values(), strict=True)
    exponents = [np.polyfit(np.log(sizes), np.log(values), 1)[0] for values in rounds]
    return {
        what: sizes,
        "seconds": [middle(times[size])[0] for size in sizes],
        "exponent": middle(exponents)[0],
    }


def orders(effort: Effort) -> list[dict]:
    """Return what a step costs with each order of the delay model, on one thread."""
    system = homodyne.PAPER.uncertain_system()
    work = {"runs": effort.runs, "steps": effort.steps, "threads": 1}
    cases = {
        order: {
            **work,
            "smoother": baselines.fixed_lag_smoother(system, DELAY, order, copies=True),
        }
        for order in effort.orders
    }
    times = interleaved(effort, cases)
    result = []
    for order in effort.orders:
        relative, quartiles = middle(np.divide(times[order], times[0]))
        result.append(
            {
                "order": order,
                "nanoseconds": 1e9 * middle(times[order])[0] / (effort.runs * effort.steps),
                "relative": relative,
                "quartiles": quartiles,
            }
        )
    return result


def first_call(effort: Effort) -> dict:
    """Return the time of import and of the first call in a new process, compiled before or not."""
    warm = [in_new_process("first") for _ in range(effort.rounds if effort.whole else 1)]
    result = {name: middle([one[name] for one in warm])[0] for name in ("import", "call")}
    if effort.whole:
        with tempfile.TemporaryDirectory() as empty:
            result["compiling"] = in_new_process("first", NUMBA_CACHE_DIR=empty)["call"]
    return result


# --- in a process of their own -------------------------------------------------------------------


def in_new_process(what: str, argument: object = None, **environment: str):
    """Return what ``_NEW[what]`` prints in a new Python."""
    command = [sys.executable, "-c", _NEW[what], json.dumps(argument)]
    run = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, **environment}
    )
    return json.loads(run.stdout)


_NEW = {
    "first": """
import json, time
started = time.perf_counter()
import robsmooth
from robsmooth import homodyne
from robsmooth.paper import published
robsmooth.monte_carlo  # a name is imported when it is first asked for
imported = time.perf_counter()
smoother = published.recomputed_estimator()
designed = time.perf_counter()
robsmooth.monte_carlo(homodyne.PAPER, smoother, protocol="paper", runs=32, duration=1e-5)
called = time.perf_counter()
print(json.dumps({"import": imported - started, "call": called - designed}))
""",
    "memory": """
import json, resource, sys
import robsmooth
from robsmooth import homodyne
from robsmooth.paper import published
smoother, unit = published.recomputed_estimator(), 1 if sys.platform == "darwin" else 1024

def forget():
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:
        pass  # then the peak is that of the import, or higher

def peak():
    try:
        with open("/proc/self/status") as file:
            return 1024 * next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

result = []
for runs in [1000, *json.loads(sys.argv[1])]:
    forget()
    robsmooth.monte_carlo(homodyne.PAPER, smoother, protocol="paper", runs=runs, duration=4e-6)
    result.append({"runs": runs, "megabytes": peak() / 1e6})
print(json.dumps(result[1:]))
""",
}


def cores() -> int:
    """Return the cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1
