"""How fast `rs.simulate` takes the steps of any loop, beside the same scheme in NumPy.

The loop is the paper's, with the classical smoother and its copy: four states, and two sines whose
arguments are evaluated twice a step. NumPy draws the same amount of noise for `PATHS` paths at a
time, on one thread, as its arrays are too small for more. Both give the same errors, within
standard errors.
"""

from functools import partial

import numba
import numpy as np

import robsmooth as rs
from benchmarks.race import SIGMAS, middle
from benchmarks.timing import interleaved
from robsmooth.simulation.loop import Steps, nonlinear_loop

PATHS = 512
NUMPY = "NumPy, one thread"
ROUNDS, QUICK = 9, 1


def numpy_errors(smoother: rs.Estimator, result: rs.SimulationResult, runs: int, seed: int) -> list:
    """Simulate paths as `result` was; return their mean squared filtered errors."""
    steps = Steps(nonlinear_loop(smoother), result.step)
    before, averaged = (round(t / result.step) for t in (result.warm_up, result.duration))
    random, errors = np.random.Generator(np.random.SFC64(seed)), []
    for start in range(0, runs, PATHS):
        shape = (steps.loop.order, min(PATHS, runs - start))
        z, squares = steps.loop.stationary_root @ random.standard_normal(shape), 0.0
        for step in range(before + averaged):
            z = steps.advance(0.0, z, steps.noise @ random.standard_normal(shape))
            if step >= before:
                w, filtered, _ = steps.scheme.outputs @ z
                squares = squares + (w - filtered) ** 2
        errors.extend(squares / averaged)
    return errors


def contenders(smoother: rs.Estimator, how: dict) -> tuple[dict, int]:
    """Return ways to simulate paths, which give mean square and standard error, and the steps."""
    system = smoother.plant.system
    planned = rs.simulate(smoother, **how, runs=1)
    threads = numba.get_num_threads()
    plain = system.nonlinearities[0].function
    in_python = [
        rs.Nonlinearity(c.B, c.C, c.D, c.lipschitz, lambda nu: plain(nu), c.reference)
        for c in system.nonlinearities
    ]
    system = rs.UncertainSystem(
        *(system.A, system.B1, system.C0, system.C2, system.D21), system.uncertainties, in_python
    )
    called_back = rs.baselines.fixed_lag_smoother(system, smoother.plant.delay, 2, copies=True)

    def ours(estimator, count):
        def simulate(runs, seed):
            before = numba.get_num_threads()
            numba.set_num_threads(count)
            error = rs.simulate(estimator, **how, runs=runs, seed=seed).filtered
            numba.set_num_threads(before)
            return error.mean_square, error.standard_error

        return simulate

    def theirs(runs, seed):
        errors = numpy_errors(smoother, planned, runs, seed)
        return np.mean(errors), np.std(errors) / np.sqrt(runs)

    ways = {
        NUMPY: theirs,
        "robsmooth, functions in Python": ours(called_back, 1),
        "robsmooth, one thread": ours(smoother, 1),
        f"robsmooth, {threads} threads": ours(smoother, threads),
    }
    return ways, planned.path_steps


def any_loop(quick: bool) -> dict:
    """Check all, and measure them in interleaved rounds."""
    smoother = rs.baselines.fixed_lag_smoother(
        rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 2, copies=True
    )
    found, steps = contenders(smoother, {"duration": 5e-5 if quick else 2e-4})
    exact, error = found["robsmooth, one thread"](1024 if quick else 16384, 1)
    runs = {name: PATHS if "Python" in name or name == NUMPY else 16 * PATHS for name in found}
    calls = {name: partial(simulate, runs[name], 3) for name, simulate in found.items()}
    times = interleaved(calls, QUICK if quick else ROUNDS)
    rates = {name: steps * runs[name] / np.array(each) for name, each in times.items()}
    rows = {}
    for name, simulate in found.items():
        mean, own = simulate(256 if quick else 1024, 2)
        off = (mean - exact) / np.hypot(error, own)
        rate, quartiles = middle(rates[name])
        ratio, ratio_quartiles = middle(rates[name] / rates[NUMPY])
        rows[name] = {"off": float(off), "agrees": bool(abs(off) < SIGMAS)}
        rows[name] |= {"rate": rate, "rate_quartiles": quartiles}
        rows[name] |= {"ratio": ratio, "ratio_quartiles": ratio_quartiles}
    return {"rounds": QUICK if quick else ROUNDS, "contenders": rows}
