"""Commands with the quick profile, and what is done once a session."""

import fcntl
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def quick(module: str, *command: str, build: Path) -> subprocess.CompletedProcess:
    """Run a module's command with the quick profile, in a folder of its own."""
    return subprocess.run(
        [sys.executable, "-m", module, *command, "--profile", "quick", "--build", build],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def once(session: Path, name: str, make: Callable[[Path], None]) -> Path:
    """Give a folder that `make` has filled, called by the first worker to ask for it.

    `session` is the worker's own temporary folder, such as popen-gw0 in that of all workers.
    """
    shared = session.parent if session.name.startswith("popen-") else session
    folder, done = shared / name, shared / f"{name}.done"
    with open(shared / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            make(folder)
            done.touch()
    return folder
