"""One notebook in its own process (several in one hang), judged by its executed copy.

All that it starts inherits `FOLDER`, by which it is found even where its own parent has ended. As a
program, this module is the parent of that process, and ends what it started: also where the run was
killed, and on Linux without its environment, too.
"""

import ctypes
import os
import re
import subprocess
import sys
import threading
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

FOLDER = "JUPYTER_RUNTIME_DIR"
_ANSI = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")
_LAST_ERROR = re.compile(r".*^([\w.]*(?:Error|Exception|Exit)\b.*)", re.DOTALL | re.MULTILINE)
_ADDED_BY_PAPERMILL = {"injected-parameters", "papermill-error-cell-tag"}


class Execution:
    """A running notebook: poll `finished`, then read `failure`."""

    def __init__(self, notebook: Path, parameters: dict, staging: Path, time_limit: float) -> None:
        """Start; the run may take `time_limit` seconds, and one cell half as long."""
        import yaml  # comes with papermill

        self.started = time.perf_counter()
        self.executed, self._log = staging / notebook.name, staging / "log.txt"
        self._time_limit, self._reached = time_limit, ""
        command = [sys.executable, "-P", __file__, sys.executable, "-P", "-m", "papermill"]
        command += ["--no-progress-bar", "--kernel=python3", "--language=python"]
        command += ["--log-level=ERROR"]
        command += [f"--cwd={notebook.parent}", f"--execution-timeout={max(1, time_limit / 2):.0f}"]
        command += ["--parameters_yaml", yaml.safe_dump(parameters, sort_keys=False)]
        for path in (notebook, self.executed):  # papermill reads a path as a template
            command.append(str(path).replace("{", "{{").replace("}", "}}"))
        options = {"stdin": subprocess.PIPE, "stderr": subprocess.STDOUT}
        # in a new session, Ctrl-C reaches only this process
        options |= {"env": _environment(staging), "start_new_session": True}
        with open(self._log, "wb") as log:
            self._process = subprocess.Popen(command, stdout=log, **options)

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self.started

    def finished(self) -> bool:
        """Whether it has ended; past its time limit it is ended here."""
        if self._process.poll() is None:
            if self.seconds <= self._time_limit:
                return False
            self._reached = f"the time limit of {self._time_limit:g} s for the notebook was reached"
        self.kill()
        return True

    def kill(self) -> None:
        """End the process, its kernel, and all that the kernel has started."""
        end_all(self._log.parent)
        self._process.communicate()

    def failure(self) -> str:
        """Why the finished run failed: the cell, counted from 1, and its traceback; else ""."""
        # papermill's exit code is not enough: it is 0 after sys.exit(0) in a cell
        log = self._log.read_text(errors="replace").strip()
        # papermill's own error repeats that of a cell
        found = None if "PapermillExecutionError" in log else _LAST_ERROR.match(log)
        outside = self._reached or (found[1] if found else "")
        cells = self._cells()
        for number, cell in cells:
            errors = [output for output in cell.outputs if output.output_type == "error"]
            lines = [line for each in errors for line in each.traceback or [each.ename]]
            traceback = _ANSI.sub("", "\n".join(lines)).strip()
            # papermill marks a cell as completed even where the kernel died; the reply tells
            if traceback or "shell.execute_reply" not in cell.metadata.get("execution", {}):
                why = "\n".join(filter(None, (outside, traceback)))
                return f"cell {number}\n{why or 'it was not run to its end'}"
        if self._reached or self._process.returncode or not cells:
            return outside or "\n".join(log.splitlines()[-20:]) or "its process died"
        return ""

    def _cells(self) -> list[tuple[int, Any]]:
        """Cells of the executed copy that hold code, with their numbers in the notebook."""
        import nbformat

        try:
            cells = nbformat.read(self.executed, as_version=4).cells
        except (OSError, ValueError):  # killed before or while saving
            self.executed.unlink(missing_ok=True)
            return []
        number, found = 0, []
        for cell in cells:
            number += not _ADDED_BY_PAPERMILL.intersection(cell.metadata.get("tags", []))
            if cell.cell_type == "code" and cell.source.strip():
                found.append((number, cell))
        return found


def _environment(staging: Path) -> dict[str, str]:
    """Environment of this process, without what would make a figure depend on its user."""
    left_out = {"MPLBACKEND", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE"}
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    return environment | {
        "OPENBLAS_NUM_THREADS": "1",  # the matrices are small, and notebooks run side by side
        "TQDM_DISABLE": "1",  # without a terminal, a bar is many lines
        "JUPYTER_PREFER_ENV_PATH": "1",  # this environment's kernel, not the user's
        FOLDER: str(staging / "jupyter"),
        "IPYTHONDIR": str(staging / "ipython"),  # without the user's start-up files
        "MATPLOTLIBRC": str(Path(find_spec("matplotlib").origin).with_name("mpl-data")),
        "PYTHONHASHSEED": "0",
    }


def end_all(folder: Path) -> None:
    """Kill the processes whose `FOLDER` is in a folder, and theirs; wait until there are none."""
    import psutil  # comes with the notebooks

    for _ in range(500):
        found = False
        for process in psutil.process_iter(["environ"]):  # None of other users' and of zombies
            place = (process.info["environ"] or {}).get(FOLDER, "")
            if Path(place).is_relative_to(folder) and process.pid != os.getpid():
                found = True
                with suppress(psutil.NoSuchProcess):
                    for each in (*process.children(recursive=True), process):
                        each.kill()
        if not found:
            break
        time.sleep(0.01)


def _run(command: list[str]) -> int:
    """Run a command until the run ends, and end what it leaves; return its exit code."""
    import psutil

    if sys.platform == "linux":  # what has lost its parent becomes a child of this process
        ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    run = threading.Thread(target=lambda: (sys.stdin.read(), process.kill()), daemon=True)
    run.start()  # the run has the other end of stdin
    code = process.wait()
    end_all(Path(os.environ[FOLDER]).parent)
    while left := psutil.Process().children():
        for each in left:
            each.kill()
            each.wait()
    return code


if __name__ == "__main__":
    os._exit(_run(sys.argv[1:]))  # at once, though a thread reads
