"""How fast `rs.simulate` takes the steps of any loop, beside the same scheme in NumPy.

The loop is the paper's, with the classical smoother and its copy: four states, and two sines whose
arguments are evaluated twice a step. NumPy draws the same amount of noise for `PATHS` paths at a
time, on one thread, as its arrays are too small for more. Both give the same errors, within
standard errors. Run as ``python -m benchmarks.any_loop``; it prints JSON.
"""

import argparse
import json
import time

import numba
import numpy as np

import robsmooth as rs
from benchmarks.race import SIGMAS, middle, say
from robsmooth.simulation.loop import Steps, nonlinear_loop

PATHS = 512
NUMPY = "NumPy, one thread"
ROUNDS, QUICK = 9, 3


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


def contenders(smoother: rs.Estimator, how: dict) -> dict:
    """Return ways to simulate the loop: path-steps, mean square and standard error of a seed."""
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
            result = rs.simulate(estimator, **how, runs=runs, seed=seed)
            numba.set_num_threads(before)
            error = result.filtered
            return result.path_steps, error.mean_square, error.standard_error

        return simulate

    def theirs(runs, seed):
        errors = numpy_errors(smoother, planned, runs, seed)
        return planned.path_steps * runs, np.mean(errors), np.std(errors) / np.sqrt(runs)

    return {
        NUMPY: theirs,
        "robsmooth, functions in Python": ours(called_back, 1),
        "robsmooth, one thread": ours(smoother, 1),
        f"robsmooth, {threads} threads": ours(smoother, threads),
    }


def measure(quick: bool) -> dict:
    """Check all, and measure them in interleaved rounds."""
    smoother = rs.baselines.fixed_lag_smoother(
        rs.homodyne.PAPER.uncertain_system(), 3.1e-6, 2, copies=True
    )
    how = {"duration": 5e-5 if quick else 2e-4}
    found, checks = contenders(smoother, how), {}
    _, exact, error = found["robsmooth, one thread"](1024 if quick else 16384, 1)
    for name, simulate in found.items():
        _, mean, own = simulate(256 if quick else 1024, 2)
        off = (mean - exact) / np.hypot(error, own)
        checks[name] = {"off": float(off), "agrees": bool(abs(off) < SIGMAS)}
    rates = {name: [] for name in found}
    for number in range(QUICK if quick else ROUNDS):
        say(f"any loop, round {number + 1}")
        for name, simulate in found.items():
            runs = PATHS if "Python" in name or name == NUMPY else 16 * PATHS
            started = time.perf_counter()
            steps = simulate(runs, number)[0]
            rates[name].append(steps / (time.perf_counter() - started))
    rows = {}
    for name, values in rates.items():
        rate, quartiles = middle(values)
        ratio, ratio_quartiles = middle(np.divide(values, rates[NUMPY]))
        rows[name] = {"rate": rate, "rate_quartiles": quartiles, "ratio": ratio}
        rows[name] |= {"ratio_quartiles": ratio_quartiles, **checks[name]}
    return {"rounds": QUICK if quick else ROUNDS, "contenders": rows}


def main() -> None:
    """Measure, and print what came out as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    result = measure(parser.parse_args().quick)
    say("")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
