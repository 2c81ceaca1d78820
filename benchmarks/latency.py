"""How long an estimator takes for one sample: in Python, and as the C that `to_c` writes.

The smoother is that of `benchmarks.throughput`, with its delay model, of three states. Calls from
Python are timed one by one, those of C as a loop. All that run it without a copy of the sine give
the same estimates. Run as
``python -m benchmarks.alone latency``.
"""

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.race import middle, say
from benchmarks.throughput import AGREEMENT, DT

OURS, COPIED = "robsmooth, step", "robsmooth, step, compiled copy"
GENERATED, COPIES, BY_HAND = "C, to_c", "C, to_c, a copy", "C, loop over matrices"
PERCENTILES = (50.0, 99.0, 99.9)


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes
    ----------
    rounds : int
    calls : int
        From Python, of a contender in a round.
    samples : int
        In C, of a contender in a round.
    """

    rounds: int
    calls: int
    samples: int


FULL = Effort(rounds=15, calls=4000, samples=1_000_000)
QUICK = Effort(rounds=3, calls=300, samples=20_000)
CHECKED = 2000  # samples


def contenders() -> tuple[dict[str, Callable], dict[str, Callable]]:
    """Return the ways to take one sample from Python, and those to run a record in C."""
    import numba
    import numpy as np

    from benchmarks import exported
    from robsmooth import homodyne
    from robsmooth.estimators import baselines
    from robsmooth.paper.published import DELAY

    parameters = homodyne.PAPER
    system = parameters.uncertain_system()
    size, slope = 2 * parameters.alpha, parameters.beta
    scale = size * parameters.gamma

    @numba.njit
    def psi(nu):
        return size * (np.sin(nu / scale) - slope * nu / scale)

    estimator = baselines.fixed_lag_smoother(system, DELAY, 2)
    with_copy = baselines.fixed_lag_smoother(system, DELAY, 2, copies=True)
    linear = estimator.discretize(DT, delay="model")
    copied = with_copy.discretize(DT, functions=[psi], delay="model")
    exact = estimator.discretize(DT)
    named = ("transition", "measurement", "smoothed")
    A, B, C = (np.ascontiguousarray(linear.matrices[name]) for name in named)

    def multiplied():
        x = np.zeros(len(A))

        def step(y):
            nonlocal x
            x = A @ x + B @ y
            return C @ x

        return step

    def fresh(discrete):
        def begin():
            discrete.reset()
            return discrete.step

        return begin

    stepped = {
        OURS: fresh(linear),
        "robsmooth, step, exact delay": fresh(exact),
        COPIED: fresh(copied),
        "NumPy, matrix times vector": multiplied,
    }
    library = exported.compiled(linear, copied, parameters)
    matrices = [len(A), *(each.ctypes.data_as(ctypes.c_void_p) for each in (A, B, C))]

    if library is None:
        return stepped, {}
    return stepped, {
        GENERATED: exported.looped(library.run_linear),
        COPIES: exported.looped(library.run_copied),
        BY_HAND: exported.looped(library.run_matrices, *matrices),
    }


def latency(effort: Effort) -> dict:
    """Measure all contenders, interleaved; a ratio is the median over the rounds."""
    import numpy as np

    y = np.random.default_rng(0).standard_normal((max(effort.samples, CHECKED), 1))
    stepped, looped = contenders()
    found, estimates = {}, {}
    for name in [*stepped, *looped]:
        say(f"checking {name}")
        step = stepped[name]() if name in stepped else None
        rows = y[:CHECKED]
        estimates[name] = np.array([step(row) for row in rows]) if step else looped[name](rows)
        expected = estimates[COPIED if name == COPIES else OURS]
        off = float(np.abs(estimates[name] - expected).max() / np.abs(expected).max())
        found[name] = {"off": off, "agrees": name.startswith(OURS) or off < AGREEMENT}
    times = {name: [] for name in found}
    for number in range(1, effort.rounds + 1):
        say(f"round {number} of {effort.rounds}")
        for name, begin in stepped.items():
            times[name].append(timed(begin(), y[: effort.calls]))
        for name, run in looped.items():
            started = time.perf_counter_ns()
            run(y[: effort.samples])
            times[name].append(np.array([(time.perf_counter_ns() - started) / effort.samples]))
    typical = {name: [np.median(each) for each in rounds] for name, rounds in times.items()}
    for name, contender in found.items():
        quantiles = np.percentile(np.concatenate(times[name]), PERCENTILES).tolist()
        contender["nanoseconds"] = quantiles if name in stepped else quantiles[:1]
        quotients = np.divide(typical[OURS], typical[name])
        contender["ratio"], contender["ratio_quartiles"] = middle(quotients)
    return {"rounds": effort.rounds, "contenders": found}


def timed(step: Callable, y):
    """Return the nanoseconds of each call."""
    import numpy as np

    clock, times = time.perf_counter_ns, np.empty(len(y))
    for k, row in enumerate(y):
        started = clock()
        step(row)
        times[k] = clock() - started
    return times


def measure(quick: bool, _peers: str) -> dict:
    """Measure as much as for a test of the benchmarks, or all."""
    return latency(QUICK if quick else FULL)
