"""The explorer as `make explore` serves it."""

import os
import re
import shlex
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from tests.helpers.labs import ROOT, STAMPS
from tests.helpers.signals import heed_signals
from tests.helpers.sockets import free_port
from tests.helpers.waiting import PATIENCE

URL = re.compile(r"http://(?:localhost|127\.0\.0\.1):\d+/\S*")


@contextmanager
def running_explorer(folder: Path) -> Iterator[tuple[str, psutil.Popen]]:
    """Start the explorer without a browser; give its address, and end it as Ctrl-C does."""
    log = folder / "log.txt"
    options = f"LAB=--no-browser --port={free_port()}"
    # without what a make around us has set
    environment = {name: each for name, each in os.environ.items() if not name.startswith("MAKE")}
    environment["JUPYTER_RUNTIME_DIR"] = str(folder / "runtime")
    asked = ["make", "-s", "-n", *STAMPS, "explore", options]
    line = subprocess.check_output(asked, cwd=ROOT, env=environment, text=True)
    command = shlex.split(line.replace("\\\n", " "))
    with open(log, "wb") as output:
        server = psutil.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
            preexec_fn=heed_signals,
        )
    try:
        yield _address(server, log), server
        os.killpg(server.pid, signal.SIGINT)
        server.wait(PATIENCE)
    finally:
        family = [*server.children(recursive=True), server] if server.is_running() else []
        for process in family:
            process.kill()
        psutil.wait_procs(family, timeout=PATIENCE)


def _address(server: psutil.Popen, log: Path) -> str:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and server.poll() is None:
        if found := URL.search(log.read_text()):
            return found[0]
        time.sleep(0.1)
    raise AssertionError(f"the explorer has not started: {log.read_text()}")
