"""Interrupt long calls, as Jupyter does, at random moments; then the same process calls again.

An interrupt must be answered within `LIMIT`, and the short call after it must give what it gave
before. Each call has a process of its own, because a kernel of Jupyter is one. At last the process
forks: the short call gives the same in the child, or one clear sentence.
"""

import random
import signal
import subprocess
import sys
import threading
import time

from tests.helpers.tries import Attack, command

LIMIT = 2.0  # s
PATIENCE = 60.0  # s, after which a process counts as hanging
BEGIN = """
import os, signal, sys, tempfile, threading, warnings
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a shell runs this with &
import numpy as np
import robsmooth as rs
from tests.helpers.strategies import random_system
warnings.simplefilter("ignore")
PAPER = rs.homodyne.PAPER
system = PAPER.uncertain_system()
kalman = rs.baselines.kalman_bucy(system)
lagged = rs.baselines.fixed_lag_smoother(system, 3.1e-6, 1, copies=True)
def plant(n): return rs.augment(random_system(np.random.default_rng(n), n=n, g=2), 0.5, 2)
grid = dict(orders=[1], gammas=[0.4], noises=[1.0])
linear = rs.UncertainSystem(A=[[-1]], B1=[[1, 0]], C0=[[1]], C2=[[1]], D21=[[0, 0.1]])
record = np.ones((10**7, 1))
def python(x): return np.tanh(x) + 0.0 * len([*map(str, x.flat)])
slow_system = rs.UncertainSystem(
    A=[[-1]], B1=[[1, 0]], C0=[[1]], C2=[[1]], D21=[[0, 0.1]],
    nonlinearities=[rs.Nonlinearity([[0.1]], [[1.0]], [[0.0]], 1.0, python)])
slow = rs.baselines.kalman_bucy(slow_system, copies=True)
"""
AGAIN = """
def short(): return SHORT
def long(): return LONG
def value(result): return repr(getattr(result, "smoothed", result))
before = value(short())
for _ in range(TRIES):
    try:
        print("begins", flush=True)
        long()
        print("ended", flush=True)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    after = value(short())
    print("same" if after == before else f"{after} and not {before}", flush=True)
if (child := os.fork()) == 0:
    with warnings.catch_warnings(action="ignore"):
        try:
            os._exit(value(short()) != before)
        except RuntimeError as error:
            os._exit("forked after a simulation" not in str(error))
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
# For each call a short one and one that takes minutes or longer.
CALLS = {
    "monte_carlo, paper": (
        "rs.monte_carlo(PAPER, kalman, 'paper', runs=64, duration=1e-4)",
        "rs.monte_carlo(PAPER, kalman, 'paper', runs=10**9)",
    ),
    "monte_carlo, ergodic": (
        "rs.monte_carlo(PAPER, lagged, runs=128)",
        "rs.monte_carlo(PAPER, lagged, runs=10**9)",
    ),
    "monte_carlo, long paths": (
        "rs.monte_carlo(PAPER, lagged, runs=128)",
        "rs.monte_carlo(PAPER, lagged, runs=128, duration=10.0)",
    ),
    "monte_carlo, paper, long paths": (
        "rs.monte_carlo(PAPER, kalman, 'paper', runs=64, duration=1e-4)",
        "rs.monte_carlo(PAPER, kalman, 'paper', runs=64, duration=5.0)",
    ),
    "simulate": ("rs.simulate(lagged, runs=64)", "rs.simulate(lagged, runs=10**9)"),
    "simulate, long paths": (
        "rs.simulate(lagged, runs=64)",
        "rs.simulate(lagged, runs=64, duration=100.0)",
    ),
    "simulate, in Python": (
        "rs.simulate(slow, runs=64, duration=20.0)",
        "rs.simulate(slow, runs=10**6)",
    ),
    "parameter_study": (
        "rs.parameter_study(PAPER, [1e-6], **grid, runs=64).ratio",
        "rs.parameter_study(PAPER, [1e-6], **grid, runs=10**8)",
    ),
    "parameter_study, many columns": (
        "rs.parameter_study(PAPER, [1e-6], **grid, runs=64).ratio",
        "rs.parameter_study(PAPER, [1e-6], **{**grid, 'noises': np.linspace(0.5, 1, 500)})",
    ),
    "parameter_study, long lag": (
        "rs.parameter_study(PAPER, [1e-6], **grid, runs=64).ratio",
        "rs.parameter_study(PAPER, [0.3], **grid)",
    ),
    "lag_sweep": (
        "rs.lag_sweep(system, [1e-6], [1])",
        "rs.lag_sweep(system, np.geomspace(1e-7, 1e-5, 10**5), [1, 2, 30])",
    ),
    "minimize_bound": (
        "rs.minimize_bound(plant(2), starts=1).bound",
        "rs.minimize_bound(plant(12), starts=100)",
    ),
    "minimax_smoother": (
        "rs.minimax_smoother(rs.augment(system, 0.0, 0)).certified",
        "[rs.minimax_smoother(plant(12)) for _ in range(100)]",
    ),
    "best_smoother": (
        "rs.best_smoother(rs.augment(linear, 0.2, 1)).estimator.A_c",
        "[rs.best_smoother(plant(8)) for _ in range(100)]",
    ),
    "worst_case": (
        "rs.worst_case(rs.baselines.kalman_bucy(plant(2).system))",
        "[rs.worst_case(rs.baselines.kalman_bucy(plant(12).system)) for _ in range(10**5)]",
    ),
    "smooth_record": (
        "rs.smooth_record(kalman.discretize(1e-7), np.ones((10, 1)))",
        "[rs.smooth_record(kalman.discretize(1e-7), record) for _ in range(10)]",
    ),
    "smooth_record, files": (
        "rs.smooth_record(kalman.discretize(1e-7), np.ones((10, 1)))",
        "[rs.smooth_record(kalman.discretize(1e-7), (np.ones((10**5, 1)) for _ in range(10**6)),"
        " tempfile.gettempdir() + '/interrupted.csv')]",
    ),
    "DiscreteSmoother.run": (
        "kalman.discretize(1e-7).run(np.ones((10, 1)))",
        "[kalman.discretize(1e-7).run(record) for _ in range(10)]",
    ),
    "DiscreteSmoother.run, nonlinear": (
        "lagged.discretize(1e-7, [np.sin]).run(np.ones((10, 1)))",
        "[lagged.discretize(1e-7, [np.sin]).run(record) for _ in range(10)]",
    ),
}


def interrupt(name: str, tries: int, draw: random.Random, longest: float = 4.0) -> Attack:
    """Interrupt a call several times in one process; return what was found."""
    short, long = CALLS[name]
    again = AGAIN.replace("SHORT", short).replace("LONG", long).replace("TRIES", str(tries))
    program = [sys.executable, "-c", BEGIN + again]
    attack = Attack(name)
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as process:
        for _ in range(tries):
            if process.stdout.readline() != "begins\n":
                attack.add("the process ended")
                break
            time.sleep(draw.uniform(0.0, longest))
            watchdog = threading.Timer(PATIENCE, process.kill)
            watchdog.start()
            process.send_signal(signal.SIGINT)
            sent = time.monotonic()
            said = process.stdout.readline().strip()
            took = time.monotonic() - sent
            attack.slowest = max(attack.slowest, took)
            after = process.stdout.readline().strip()
            watchdog.cancel()
            if said != "interrupted":
                attack.add(f"not interrupted: {said or 'no answer'}")
            elif after != "same":
                attack.add(f"the next call gave {after or 'no answer'}")
            else:
                attack.add(f"answered after {took:.1f} s" if took > LIMIT else None)
        watchdog = threading.Timer(PATIENCE, process.kill)
        watchdog.start()
        ended = process.stdout.readline().strip()
        attack.add(None if ended == "0" else f"the forked process: {ended or 'hangs'}")
        watchdog.cancel()
        process.kill()
    return attack


if __name__ == "__main__":
    command(__doc__, CALLS, interrupt)
