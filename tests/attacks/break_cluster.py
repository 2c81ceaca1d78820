"""Hurt a cluster at random moments; what is computed on it has the bits of one process.

A run may also end in one sentence that says what is wrong with the cluster. Then the next run, on a
cluster that is well, goes on from the checkpoint to the same bits.
"""

import os
import random
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

import psutil

import robsmooth
from tests.attacks.kill_computations import CALLS, Run
from tests.helpers.clusters import LOOPBACK
from tests.helpers.sockets import free_port
from tests.helpers.tries import Attack, command
from tests.helpers.waiting import wait_until

SENTENCES = re.compile(
    "RuntimeError: (the same call was on|a worker has other software)"
    "|ConnectionError: (there is no connection|no worker has joined|no Dask scheduler answers)"
)
LATEST = 6.0  # s: a run is hurt before
LONGEST = 300.0  # s, for a run to end after it was hurt


class Cluster:
    """A scheduler and two workers, each a process of its own that a nanny starts again."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.started = folder, []
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.start()

    def _start(self, *arguments: str, path: str = "") -> psutil.Popen:
        environment = os.environ | {"PYTHONPATH": path or os.environ.get("PYTHONPATH", "")}
        process = psutil.Popen(
            [sys.executable, "-m", "dask", *arguments, *LOOPBACK],
            cwd=path or self.folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.started.append(process)
        return process

    def start(self) -> None:
        """Start what a cluster is made of."""
        self.scheduler = self._start("scheduler", "--port", str(self.port))
        wait_until(self._answers)
        self.nanny = self.join("--nworkers", "2")

    def join(self, *options: str, path: str = "") -> psutil.Popen:
        """Let workers join, with the package of a folder where one is named."""
        return self._start("worker", self.address, "--nthreads", "1", *options, path=path)

    def _answers(self) -> bool:
        with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1.0):
            return True
        return False

    def workers(self) -> list[psutil.Process]:
        """Return the processes that compute, each alone or below its nanny."""
        with suppress(psutil.NoSuchProcess):
            below = self.nanny.children(recursive=True)
            return [each for each in below if "spawn_main" in " ".join(each.cmdline())]
        return []

    def end(self) -> None:
        """Kill all that was started."""
        for process in self.started:
            with suppress(psutil.NoSuchProcess):
                for each in process.children(recursive=True):
                    with suppress(psutil.NoSuchProcess):
                        each.kill()
                process.kill()
            process.wait()
        self.started = []


def kill_workers(cluster: Cluster, ended: threading.Event, draw: random.Random) -> None:
    """Kill one of the workers every second, or every few seconds."""
    every = draw.choice([1.0, 5.0, 10.0])
    while not ended.wait(every):
        if workers := cluster.workers():
            with suppress(psutil.NoSuchProcess):
                draw.choice(workers).kill()


def kill_scheduler(cluster: Cluster, ended: threading.Event, draw: random.Random) -> None:
    """Kill the scheduler; another comes to the same address after a while."""
    ended.wait(draw.uniform(0.0, LATEST))
    cluster.scheduler.kill()
    ended.wait(draw.uniform(0.0, LATEST))
    cluster.end()
    cluster.start()


def stop_some(cluster: Cluster, ended: threading.Event, draw: random.Random) -> None:
    """Stop the scheduler, a nanny or a worker for some seconds, again and again."""
    while not ended.wait(draw.uniform(0.0, LATEST)):
        stopped = draw.choice([cluster.scheduler, cluster.nanny, *cluster.workers()])
        with suppress(psutil.NoSuchProcess):
            stopped.suspend()
            ended.wait(draw.uniform(0.0, LATEST))
            stopped.resume()


def join_others(cluster: Cluster, ended: threading.Event, draw: random.Random) -> None:
    """Let a worker join whose sources differ by one character."""
    home = Path(robsmooth.__file__).parent
    copy = cluster.folder / "others" / "robsmooth"
    shutil.copytree(home, copy, ignore=shutil.ignore_patterns("__pycache__"))
    changed = draw.choice(sorted(copy.rglob("*.py")))
    changed.write_text(changed.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    ended.wait(draw.uniform(0.0, LATEST))
    cluster.join(path=str(copy.parent))


ATTACKS = {
    f"{call}: {way.__name__.replace('_', ' ')}": (call, way)
    for way in (kill_workers, kill_scheduler, stop_some, join_others)
    for call in CALLS
}


def run(call: str, path: Path, cluster: Cluster, scale: float, hurt: Callable | None = None) -> str:
    """Compute on a cluster, which `hurt(cluster, ended)` hurts meanwhile; return what is said."""
    computation, ended = Run(call, path, 0, scale, SCHEDULER=cluster.address), threading.Event()
    hurting = threading.Thread(target=hurt or (lambda *_: None), args=(cluster, ended))
    hurting.start()
    try:
        return computation.said(LONGEST)[1]
    finally:
        computation.kill()
        ended.set()
        hurting.join()


def attack(name: str, tries: int, draw: random.Random, scale: float = 1.0) -> Attack:
    """Make one of the `ATTACKS`, each try on a cluster of its own."""
    call, way = ATTACKS[name]
    attack, wanted = Attack(name), Run(call, "", 0, scale).said()[1]
    for number in range(tries):
        with ExitStack() as stack:
            folder = Path(tempfile.mkdtemp(prefix="robsmooth-cluster-"))
            stack.callback(shutil.rmtree, folder)
            cluster, path = Cluster(folder), folder / f"{call}{number}.sqlite"
            stack.callback(cluster.end)
            found = run(call, path, cluster, scale, partial(way, draw=draw))
            attack.answers["the same bits" if found == wanted else found] += 1
            if found != wanted and not SENTENCES.search(found):
                attack.add(f"{found or 'no answer'} and not {wanted}")
                continue
            if found != wanted:
                cluster.end()
                cluster.start()
                found = run(call, path, cluster, scale)
            attack.add(None if found == wanted else f"then {found or 'no answer'}")
    return attack


if __name__ == "__main__":
    command(__doc__, ATTACKS, attack)
