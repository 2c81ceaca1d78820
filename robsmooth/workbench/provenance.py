"""Where a result comes from: versions, seed, revision, lock, machine and run time.

Nothing here identifies a person or a place: no user or host name, no absolute path.
"""

import hashlib
import os
import platform
import subprocess
import time
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from robsmooth._support import files

ROOT = Path(__file__).resolve().parents[2]
LOCK = "requirements.lock"
PACKAGES = ("robsmooth", "numpy", "scipy", "matplotlib", "numba", "control", "papermill")
# What a result depends on; a figure that was just regenerated does not make the revision dirty.
SOURCES = ("robsmooth", "notebooks", "data/published.toml", "pyproject.toml", LOCK)


def collect(seed: int | None = None, started: float | None = None, **extra: object) -> dict:
    """Describe this run.

    Parameters
    ----------
    seed : int, optional
        Seed of the run's random numbers.
    started : float, optional
        `time.perf_counter()` when the run began; gives the run time.
    **extra
        Anything else to record, under its own name; it must have a JSON form.
    """
    return {
        **extra,
        "seed": seed,
        "run_time_seconds": None if started is None else round(time.perf_counter() - started, 3),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "revision": revision(),
        "lock_sha256": sha256(ROOT / LOCK) if (ROOT / LOCK).is_file() else None,
        "versions": {"python": platform.python_version(), **_versions()},
        "machine": machine(),
    }


def write(result: str | os.PathLike[str], **about: object) -> Path:
    """Write `collect(**about)` beside `result` as `<stem>.provenance.json`; return its path."""
    path = Path(result).with_suffix(".provenance.json")
    files.write_json(path, collect(**about))
    return path


def revision(root: Path = ROOT) -> dict | None:
    """Git revision of `root` and whether its sources differ from it; None where there is none."""

    def git(*arguments: str) -> str:
        return _output("git", "-C", str(root), *arguments)

    try:
        inside, commit = git("rev-parse", "--show-prefix", "HEAD").split("\n")[:2]
        if inside:  # `root` is a folder of some other project
            return None
        return {"commit": commit, "dirty": bool(git("status", "--porcelain", "--", *SOURCES))}
    except (OSError, subprocess.CalledProcessError):
        return None


def machine() -> dict:
    """Processor, cores this process may use, and platform."""
    usable = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
    system = (platform.system(), platform.machine(), *platform.libc_ver())
    return {
        "processor": _processor(),
        "cores": len(usable),
        "platform": " ".join(part for part in system if part),
    }


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _output(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def _processor() -> str:
    try:
        if platform.system() == "Darwin":
            command = ["sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(
                command, check=True, capture_output=True, text=True
            ).stdout.strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            name, _, model = line.partition(":")
            if name.strip() == "model name":
                return model.strip()
    except (OSError, subprocess.CalledProcessError):
        pass
    return platform.machine()


def _versions() -> dict[str, str | None]:
    versions = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions
