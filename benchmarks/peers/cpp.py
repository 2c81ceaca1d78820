"""C++ by hand, `loop.cpp`, compiled on the spot for this processor."""

import ctypes
import os
import shutil
import subprocess
import tempfile
from functools import cache, partial
from pathlib import Path

import numpy as np

from benchmarks.problem import Peer, Problem, Sample, Simulate, Unavailable

SOURCE = Path(__file__).with_name("loop.cpp")
FLAGS = ("-O3", "-std=c++17", "-fPIC", "-shared", "-Wno-psabi")
THIS_PROCESSOR = ("-march=native", "-mcpu=native")  # as the compilers of x86 and others have it
OTHER_PROCESSOR = "ROBSMOOTH_BENCH_PROCESSOR"  # in the environment: what to compile for instead
WIDTH = 1920  # a multiple of the paths in a block of `loop.cpp`


def compiler() -> str:
    """Return the C++ compiler to use: that in CXX, g++ or clang++."""
    for name in (os.environ.get("CXX"), "g++", "clang++"):
        if name and (path := shutil.which(name)):
            return path
    raise Unavailable("no C++ compiler: neither g++ nor clang++")


def version() -> str | None:
    """Return the compiler's own word for itself."""
    try:
        command = [compiler(), "--version"]
        return subprocess.run(command, capture_output=True, text=True).stdout.splitlines()[0]
    except (Unavailable, IndexError):
        return None


@cache
def compiled(order: int) -> ctypes.CDLL:
    """Compile `loop.cpp` for estimators of an order and load it."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "loop.so"
        other = os.environ.get(OTHER_PROCESSOR)
        for processor in (f"-march={other}",) if other else THIS_PROCESSOR:
            command = [compiler(), *FLAGS, processor, f"-DORDER={order}", SOURCE, "-o", target]
            run = subprocess.run(command, capture_output=True, text=True)
            if run.returncode == 0:
                return ctypes.CDLL(str(target))
    raise Unavailable(f"{SOURCE.name} does not compile: {run.stderr.strip().splitlines()[0]}")


def coefficients(problem: Problem) -> np.ndarray:
    """Return what `Coefficients` in `loop.cpp` has, in its order.

    The noise enters as the measured sine does, through the measurement: one number is their ratio.
    """
    ratios = problem.noise_gain / problem.sine_gain
    if not np.allclose(ratios, ratios[0], rtol=1e-9):
        raise Unavailable("this estimator's noise does not enter as its measurement does")
    fields = ("decay", "diffusion", "drift", "reference", "copy", "sine_gain", "copy_gain")
    return np.concatenate([*(np.ravel(getattr(problem, name)) for name in fields), ratios[:1]])


def simulator(problem: Problem, precision: str):
    """Return a function of paths, steps and seed, with errors and slips."""
    function = getattr(compiled(problem.order), f"{precision}_precision")
    array, integer, word = ctypes.c_void_p, ctypes.c_int64, ctypes.c_uint64
    function.argtypes = (array, array, integer, integer, word, integer, array)
    function.restype = None
    numbers = coefficients(problem)
    readout = np.concatenate([problem.filtered, problem.smoothed])

    def simulate(paths: int, steps: int, seed: int) -> np.ndarray:
        results = np.empty((3, paths))  # squared errors, filtered and smoothed, and cycle slips
        function(
            numbers.ctypes.data,
            readout.ctypes.data,
            steps,
            problem.delay,
            seed,
            paths,
            results.ctypes.data,
        )
        return results

    return simulate


def prepare(problem: Problem, precision: str) -> Simulate:
    """Return the compiled simulation."""
    simulate = simulator(problem, precision)
    return lambda *arguments: Sample.of(*simulate(*arguments)[:2])


PEERS = tuple(
    Peer(f"C++, {precision}", partial(prepare, precision=precision), WIDTH)
    for precision in ("single", "mixed")
)
