"""Octave, which stands in for Simulink: `loop.m`, paths side by side and path by path."""

import shutil
import subprocess
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.problem import Peer, Problem, Sample, Simulate, Unavailable, chunks

SCRIPT = Path(__file__).with_name("loop.m")
COLUMNS = ("sine_gain", "copy_gain", "noise_gain")
OTHERS = ("decay", "diffusion", "drift", "reference", "copy", "delay")


def definitions(problem: Problem) -> str:
    """Return the problem in Octave's words."""
    values = {name: np.atleast_2d(getattr(problem, name)) for name in OTHERS}
    values |= {name: getattr(problem, name)[:, None] for name in COLUMNS}
    return "".join(
        f"{name} = [{'; '.join(' '.join(map(repr, row)) for row in value.tolist())}];\n"
        for name, value in values.items()
    )


def prepare(problem: Problem, width: int) -> Simulate:
    """Return the simulation: a process a call, which measures its own time."""
    program = shutil.which("octave-cli") or shutil.which("octave")
    if program is None:
        raise Unavailable("octave is not installed")
    body = definitions(problem) + SCRIPT.read_text(encoding="utf-8")

    def simulate(paths: int, steps: int, seed: int) -> Sample:
        count = chunks(paths, width)
        header = f"width = {width}; chunks = {count}; steps = {steps}; seed = {seed};\n"
        with tempfile.TemporaryDirectory() as folder:
            script = Path(folder) / "run.m"
            script.write_text(header + body, encoding="utf-8")
            run = subprocess.run(
                [program, "--quiet", "--no-history", "--norc", script],
                capture_output=True,
                text=True,
                check=True,
            )
        seconds, *ends = np.array(run.stdout.split(), float)
        phase, delayed, *state = np.reshape(ends, (count * width, -1)).T
        return replace(problem.sample(phase, delayed, state), seconds=float(seconds))

    return simulate


PEERS = (
    Peer("Octave, vectorised", partial(prepare, width=4096), 4096),
    Peer("Octave, path by path", partial(prepare, width=1), 4),
)
