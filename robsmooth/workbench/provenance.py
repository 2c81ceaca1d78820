"""The source of a result: versions, seed, revision, lock, machine and time; no person or place."""

import hashlib
import os
import platform
import re
import subprocess
import time
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path

from robsmooth._support import files

ROOT = Path(__file__).resolve().parents[2]
LOCK = "requirements.lock"
PACKAGES = ("robsmooth", "numpy", "scipy", "matplotlib", "numba", "control", "papermill")
INPUTS = ("data/published.toml", "data/nonlinear_floor.json", LOCK)  # of all notebooks
# A result depends on these: a regenerated figure does not make the revision dirty.
SOURCES = ("robsmooth", "notebooks", "pyproject.toml", *INPUTS)


def collect(seed: int | None = None, started: float | None = None, **extra: object) -> dict:
    """Describe a run; `started` is the `time.perf_counter()` at its start."""
    versions = {"python": platform.python_version(), **dict.fromkeys(PACKAGES)}
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    # the cores that this process may use
    cores = len(getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0))
    system = " ".join(filter(None, (platform.system(), platform.machine(), *platform.libc_ver())))
    return {
        **extra,
        "seed": seed,
        "run_time_seconds": None if started is None else round(time.perf_counter() - started, 3),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "revision": revision(),
        "lock_sha256": sha256(ROOT / LOCK) if (ROOT / LOCK).is_file() else None,
        "versions": versions,
        "machine": {"processor": _processor(), "cores": cores, "platform": system},
    }


def write(result: str | os.PathLike[str], **about: object) -> Path:
    """Write `collect(**about)` beside `result` as `<stem>.provenance.json`; return its path."""
    path = Path(result).with_suffix(".provenance.json")
    files.write_json(path, collect(**about))
    return path


def revision(root: Path = ROOT) -> dict | None:
    """Git revision of `root`, "dirty" where its sources differ; None where there is none."""
    run = partial(subprocess.check_output, cwd=root, stderr=subprocess.DEVNULL, text=True)
    with suppress(OSError, subprocess.CalledProcessError):
        inside, commit = run(["git", "rev-parse", "--show-prefix", "HEAD"]).split("\n")[:2]
        if not inside:  # else `root` is a folder of another project
            changes = run(["git", "status", "--porcelain", "--", *SOURCES])
            return {"commit": commit, "dirty": bool(changes)}
    return None


def sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _processor() -> str:
    with suppress(OSError):  # there is none on macOS
        if found := re.search(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text()):
            return found[1].strip()
    return platform.machine()
