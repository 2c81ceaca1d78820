"""Kill runs of notebooks at random moments: ``python -m tests.attacks.kill_runs --tries N``.

A project has two notebooks that take a few seconds; each starts two programs, one of them without
its environment, keeps a checkpoint and writes many files. Each try changes the notebooks, runs
them, and sends a signal to the command, to a worker, to its parent or to a kernel, or lets no file
grow beyond a size, as on a full disk. Then no process is left, the files that a provenance lists
are whole and of one run, and the next run writes what a run that nobody disturbed writes.
"""

import argparse
import json
import os
import random
import resource
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import nbformat
import psutil

from tests.helpers.signals import heed_signals

MARK = "ROBSMOOTH_ATTACK"  # in the environment of all that a try starts
PATIENCE = 60.0  # s, for a run to end by itself
GRACE = 3.0  # s, for what a kill left to end
FILES = 12  # of a notebook
LARGEST = 350_000  # bytes of a file, just more than any has
WAYS = {  # whom, and the signals that follow one another at once
    "kill the command": ("command", [signal.SIGKILL]),
    "kill a worker": ("worker", [signal.SIGKILL]),
    "kill a worker's parent": ("parent", [signal.SIGKILL]),
    "kill a kernel": ("kernel", [signal.SIGKILL]),
    "kill while publishing": ("publishing", [signal.SIGKILL]),
    "lose the terminal": ("command", [signal.SIGHUP]),
    "interrupt twice": ("command", [signal.SIGINT, signal.SIGINT]),
    "terminate": ("command", [signal.SIGTERM]),
    "fill the disk": ("disk", []),
}
PARAMETERS = """
output_dir: str = "../build/figures"  # folder of the figures
data_dir: str = "../build/data"  # folder of the data
checkpoint_dir: str = ""  # folder to resume from
"""
CODE = """
import os, subprocess, sys, time
from pathlib import Path

command = [sys.executable, "-c", "import time; time.sleep(3600)", os.environ["{mark}"]]
program = subprocess.Popen(command)
subprocess.Popen(command, env={{}}, start_new_session=True)
done = Path(checkpoint_dir, "done")
steps = int(done.read_text()) if done.exists() else 0
for step in range(steps, 10):
    time.sleep(0.05)
    with open(done, "w") as file:
        file.write(str(step + 1))
for number in range({files}):
    text = f"{name}, version {version}, file {{number}}\\n"
    Path(output_dir, f"{name}_{{number}}.txt").write_text(text * 10_000)
Path(data_dir, "{name}.json").write_text("{version}")
program.kill()
"""


class Project:
    """A folder with two notebooks, whose results depend on the version alone."""

    def __init__(self, root: Path, module: str) -> None:
        self.root, self.module = root, module
        self.names = ["01_first", "02_second"]
        (root / "notebooks").mkdir()
        (root / "notebooks" / "profiles.toml").write_text(f"notebooks = {json.dumps(self.names)}")

    def write(self, version: int) -> None:
        """Write the notebooks of a version."""
        for name in self.names:
            tagged = nbformat.v4.new_code_cell(PARAMETERS.strip(), id="parameters")
            tagged.metadata.tags = ["parameters"]
            code = CODE.format(name=name, version=version, files=FILES, mark=MARK)
            cells = [tagged, nbformat.v4.new_code_cell(code.strip(), id="code")]
            notebook = nbformat.v4.new_notebook(cells=cells)
            nbformat.write(notebook, self.root / "notebooks" / f"{name}.ipynb")

    def expected(self, version: int) -> dict[str, bytes]:
        """Return the results of a version, without the provenance."""
        files = {}
        for name in self.names:
            files[f"data/{name}.json"] = str(version).encode()
            for number in range(FILES):
                text = f"{name}, version {version}, file {number}\n" * 10_000
                files[f"figures/{name}_{number}.txt"] = text.encode()
        return files

    def results(self) -> dict[str, bytes]:
        """Return every file of the results' folders."""
        folders = [self.root / "figures", self.root / "data"]
        paths = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
        return {path.relative_to(self.root).as_posix(): path.read_bytes() for path in paths}

    def start(self, mark: str, largest: int = resource.RLIM_INFINITY) -> subprocess.Popen:
        """Start a run of both notebooks, whose files have at most so many bytes."""

        def prepare() -> None:
            heed_signals()
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

        return subprocess.Popen(
            [sys.executable, *self.module.split(), "figures"],
            cwd=self.root,
            env=os.environ | {MARK: mark},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=prepare,
        )


def started(mark: str) -> list[psutil.Process]:
    """Return the living processes of a try: the mark is in their environment or command."""
    found = []
    for each in psutil.process_iter(["environ", "cmdline", "status"]):
        marks = [*(each.info["cmdline"] or ()), (each.info["environ"] or {}).get(MARK)]
        if mark in marks and each.info["status"] != psutil.STATUS_ZOMBIE:
            found.append(each)
    return found


def victim(whom: str, project: Project, command: subprocess.Popen, mark: str) -> int | None:
    """Return the process to send a signal to; None while there is none."""
    if whom == "publishing":
        hidden = [*project.root.glob("figures/*.unpublished"), *project.root.glob("figures/.*")]
        return command.pid if hidden else None
    if whom in ("command", "disk"):
        return command.pid
    for process in started(mark):
        with suppress(psutil.NoSuchProcess):
            line = process.cmdline()
            is_kernel = any("ipykernel" in word for word in line)
            is_parent = any("execution.py" in word for word in line)
            is_worker = "papermill" in line and not is_parent
            if {"kernel": is_kernel, "worker": is_worker, "parent": is_parent}[whom]:
                return process.pid
    return None


def torn(project: Project, version: int) -> str | None:
    """Say what is wrong with results that a kill left: each is of this version or the last."""
    found = project.results()
    whole = [project.expected(each) for each in (version - 1, version)]
    for file, content in found.items():
        if ".provenance." in file or file.endswith(".unpublished") or "/." in file:
            continue
        if content not in [each.get(file) for each in whole]:
            return "a half file"
    for name in project.names:
        about = found.get(f"figures/{name}.provenance.json")
        listed = json.loads(about)["files"] if about else {}
        for file, digest in listed.items():
            if sha256(found.get(file, b"")).hexdigest() != digest:
                return "a provenance of files that are not there"
    return None


def faults(project: Project, version: int, way: str, moment: float, largest: int) -> list[str]:
    """Disturb a run and say what was wrong then."""
    (whom, numbers), mark, found = WAYS[way], secrets.token_hex(8), []
    project.write(version)
    with project.start(mark, largest if whom == "disk" else resource.RLIM_INFINITY) as command:
        time.sleep(moment)
        deadline = time.monotonic() + PATIENCE
        while (pid := victim(whom, project, command, mark)) is None and command.poll() is None:
            time.sleep(0.0 if whom == "publishing" else 0.02)
        for number in numbers if pid and command.poll() is None else ():
            with suppress(ProcessLookupError):
                os.kill(pid, number)
            time.sleep(0.1 * (len(numbers) > 1))
        if numbers == [signal.SIGKILL] and whom in ("command", "publishing"):
            deadline = time.monotonic() + GRACE
        while started(mark) and time.monotonic() < deadline:
            time.sleep(0.05)
        if left := started(mark):
            found.append("processes are left")
            for process in left:
                with suppress(psutil.NoSuchProcess):
                    process.kill()
        said, _ = command.communicate()
    if "Traceback" in said and whom == "command":
        found.append("a traceback")
    if fault := torn(project, version):
        found.append(fault)
    if fault := wrong_after(project, version, mark):
        found.append(fault)
    return found


def wrong_after(project: Project, version: int, mark: str) -> str | None:
    """Run again, undisturbed, and say what is wrong with it."""
    with project.start(mark) as command:
        said, _ = command.communicate(timeout=2 * PATIENCE)
    results = project.results()
    about = [results.pop(f"figures/{name}.provenance.json", None) for name in project.names]
    if command.returncode or None in about:
        return f"the next run failed: {said.strip().splitlines()[-1][:200]}"
    if results != project.expected(version):
        return "the next run's results differ"
    work = project.root / "build" / "paper"
    left = [path for path in (work / "staging", *work.glob("checkpoints/*")) if path.exists()]
    left += [path for path in work.rglob("*") if path.name.endswith(".unpublished")]
    if left or started(mark):
        return "the next run leaves something"
    return None


def attack(tries: int, seed: int, module: str = "-m robsmooth", names: str = "") -> list[str]:
    """Make some tries of each way; print and return the failures."""
    random_, failures, counts = random.Random(seed), [], Counter()
    ways = [way for way in WAYS if names in way]
    waiting = ways * tries
    while waiting:
        with tempfile.TemporaryDirectory() as folder:
            project = Project(Path(folder), module)
            project.write(0)
            begin, found = time.perf_counter(), []
            first = wrong_after(project, 0, secrets.token_hex(8))
            seconds = time.perf_counter() - begin
            assert first is None, first
            for version in range(1, 1 + len(waiting)):
                way = waiting.pop(0)
                moment = random_.uniform(0.0, seconds) * (way != "kill while publishing")
                largest = random_.randrange(LARGEST)
                found = faults(project, version, way, moment, largest)
                for fault in found:
                    failures.append(f"{way} after {moment:.2f} s, {largest} bytes: {fault}")
                    print(failures[-1], flush=True)
                    counts[way, fault] += 1
                if found:
                    break  # what is wrong there may stay so
    for way in ways:
        what = [f"    {count} x {fault}" for (each, fault), count in counts.items() if each == way]
        failed = sum(count for (each, _), count in counts.items() if each == way)
        print("\n".join([f"{way}: {tries} tries, {failed} failures", *what]), flush=True)
    return failures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--tries", type=int, default=20, help="of each way (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", default="", help="a part of the names of ways")
    parser.add_argument("--module", default="-m robsmooth", help="how Python runs the command")
    given = parser.parse_args()
    sys.exit(bool(attack(given.tries, given.seed, given.module, given.only)))
