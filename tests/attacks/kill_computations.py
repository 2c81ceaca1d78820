"""Kill long computations at random moments; what resumes must give the bits of a run in one go.

A computation is started again and again, and killed, until a run ends by itself. At most
`LOST` seconds of computing may be lost by a kill. Other attacks damage the checkpoint between two
runs, stop a run that holds it, fill the disk, and take away the right to write.
"""

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

from tests.helpers.tries import Attack, command

LOST = 5.0  # s; the sums are saved every 2 s
PROGRAM = """
import json, os, resource, sys, warnings
import robsmooth as rs
from robsmooth._support.cluster import connect
PAPER = rs.homodyne.PAPER
lagged = rs.baselines.fixed_lag_smoother(PAPER.uncertain_system(), 3.1e-6, 1, copies=True)
path, seed, scale = sys.argv[1] or None, int(sys.argv[2]), float(sys.argv[3])
if os.environ.get("NOBODY"):
    for call in (rs.simulate, rs.monte_carlo):  # with imports that nobody may not be able to read
        call(*[PAPER] * (call is rs.monte_carlo), lagged, runs=2)
    rs.parameter_study
    os.setuid(65534)
if size := int(os.environ.get("LARGEST", 0)):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
def value():
    with connect(os.environ.get("SCHEDULER", "")) as client:
        result = CALL
    errors = getattr(result, "quantities", None) or [result.smoothed, result.filtered]
    return repr(errors)
print("begins", flush=True)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    try:
        found = value()
    except (ValueError, OSError, RuntimeError) as error:
        found = f"{type(error).__name__}: {error}"
print(*[each.message for each in caught if "damaged" in str(each.message)])
print(json.dumps(found), flush=True)
"""
CALLS = {
    "monte_carlo": "rs.monte_carlo(PAPER, lagged, runs=int(scale * 2**17), seed=seed, "
    "checkpoint=path, client=client)",
    "simulate": "rs.simulate(lagged, runs=int(scale * 2**12), seed=seed, checkpoint=path, "
    "client=client)",
    "parameter_study": "rs.parameter_study(PAPER, [1e-6], [1], gammas=[0.4], seed=seed, "
    "noises=[0.5 + 0.01 * i for i in range(int(6 * scale))], checkpoint=path, "
    "client=client)",
}


class Run(subprocess.Popen):
    """A process that computes; `said` has its warnings and its result, "" where it was killed."""

    def __init__(self, call: str, path: Path | str, seed: int = 0, scale: float = 1.0, **settings):
        program = PROGRAM.replace("CALL", CALLS[call])
        command = [sys.executable, "-c", program, str(path), str(seed), str(scale)]
        environment = os.environ | {name: str(value) for name, value in settings.items()}
        super().__init__(command, stdout=subprocess.PIPE, text=True, env=environment)
        assert self.stdout.readline() == "begins\n"
        self.began = time.monotonic()

    def said(self, longest: float | None = None) -> tuple[str, str]:
        """Return the warnings and the result, after at most so many seconds."""
        try:
            lines = self.communicate(timeout=longest)[0].splitlines()
        except subprocess.TimeoutExpired:
            return "", ""
        return (lines[0], lines[1]) if len(lines) == 2 else ("", "")


def kill(call: str, tries: int, draw: random.Random, folder: Path, scale: float) -> Attack:
    """Kill a computation at this many moments, spread over runs that go on from each other."""
    attack, number = Attack(f"{call}: kill -9"), 0
    whole = Run(call, "", 0, scale)
    began = time.monotonic()
    wanted, alone = whole.said()[1], time.monotonic() - began
    while attack.tries < tries:
        path, spent, kills, number = folder / f"{call}{number}.sqlite", 0.0, 0, number + 1
        while True:
            run = Run(call, path, 0, scale)
            try:
                run.wait(draw.uniform(0.0, alone / 2) if attack.tries < tries else None)
            except subprocess.TimeoutExpired:
                run.kill()
                kills += 1
                attack.add(None)
            spent += time.monotonic() - run.began
            if result := run.said()[1]:
                break
        if result != wanted:
            attack.failures[f"{result} and not {wanted}"] += 1
        if spent > 1.5 * alone + kills * LOST:
            attack.failures[f"{spent:.0f} s instead of {alone:.0f} s, after {kills} kills"] += 1
    return attack


def damage(call: str, tries: int, draw: random.Random, folder: Path, scale: float) -> Attack:
    """Damage a whole checkpoint: same bits, and the damaged file is kept, or a refusal."""
    attack, path = Attack(f"{call}: damage"), folder / f"{call} whole.sqlite"
    wanted = Run(call, path, 0, scale).said()[1]
    content = path.read_bytes()
    for number in range(tries):
        damaged, place = bytearray(content), folder / f"{call} damaged {number}.sqlite"
        how = draw.choice(["bit", "zeros", "cut", "noise"])
        at, size = draw.randrange(len(content)), draw.randrange(1, 5000)
        if how == "bit":
            damaged[at] ^= 1 << draw.randrange(8)
        elif how == "cut":
            del damaged[at:]
        else:
            part = damaged[at : at + size]
            damaged[at : at + size] = (
                bytes(len(part)) if how == "zeros" else draw.randbytes(len(part))
            )
        place.write_bytes(damaged)
        warned, found = Run(call, place, 0, scale).said()
        aside = place.with_name(f"{place.name}.damaged-1")
        kept = place if "CheckpointError" in found else aside if warned else None
        if "CheckpointError" not in found and found != wanted:
            attack.add(f"{how} at {at}: {found or 'no answer'} and not {wanted}")
        elif kept and kept.read_bytes() != damaged:
            attack.add(f"{how} at {at}: the damaged file was not kept")
        else:
            attack.add(None)
    return attack


def hinder(call: str, tries: int, draw: random.Random, folder: Path, scale: float) -> Attack:
    """Two runs, a stopped one, another seed, a full disk, a folder without the right to write."""
    attack = Attack(f"{call}: hindered")
    wanted = Run(call, "", 0, scale).said()[1]

    def expect(what: str, found: str, *words: str) -> None:
        right = any(word in found for word in words)
        attack.add(None if right else f"{what}: {found or 'no answer'}")

    for number in range(tries):
        path = folder / f"{call} hindered {number}.sqlite"
        first = Run(call, path, 0, scale)
        while not path.exists() and first.poll() is None:
            time.sleep(0.01)
        time.sleep(draw.uniform(0.0, 0.1))
        if draw.random() < 0.5:
            first.send_signal(signal.SIGSTOP)
        second = Run(call, path, 0, scale).said()[1]
        over = [wanted] * (first.poll() is not None)  # the first may have ended in time
        expect("two runs", second, "in use by another run", *over)
        first.send_signal(signal.SIGCONT)
        expect("after SIGCONT", first.said()[1], wanted)
        expect("another seed", Run(call, path, 1, scale).said()[1], "seed is 0 there and 1 here")
        expect("the same again", Run(call, path, 0, scale).said()[1], wanted)
        with closing(sqlite3.connect(path)) as database:
            most = database.execute("SELECT count(*) FROM record").fetchone()[0]
        full = folder / f"{call} full {number}.sqlite"
        found = Run(call, full, 0, scale, LARGEST=draw.randrange(1, 5000 * most)).said()[1]
        expect("a full disk", found, wanted, "takes no more", "cannot be opened")
        expect("after a full disk", Run(call, full, 0, scale).said()[1], wanted)
        locked = folder / f"locked {call} {number}"
        locked.mkdir(mode=0o555)
        found = Run(call, locked / "run.sqlite", 0, scale, NOBODY=int(os.getuid() == 0) or "")
        expect("no right to write", found.said()[1], "cannot be opened")
    return attack


ATTACKS = {
    f"{call}: {attack.__name__}": (call, attack)
    for attack in (kill, damage, hinder)
    for call in CALLS
}


def attack(name: str, tries: int, draw: random.Random, scale: float = 1.0) -> Attack:
    """Make one of the `ATTACKS`, in a folder of its own."""
    call, make = ATTACKS[name]
    folder = Path(tempfile.mkdtemp(prefix="robsmooth-kills-"))
    folder.chmod(0o755)
    try:
        return make(call, tries, draw, folder, scale)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    command(__doc__, ATTACKS, attack)
