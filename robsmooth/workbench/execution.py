"""One notebook in its own process (several in one hang), judged by its executed copy."""

import multiprocessing
import os
import re
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

_ANSI = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")
_LAST_ERROR = re.compile(r".*^([\w.]*(?:Error|Exception|Exit)\b.*)", re.DOTALL | re.MULTILINE)
_SERVER = multiprocessing.get_context("forkserver")
_ADDED_BY_PAPERMILL = {"injected-parameters", "papermill-error-cell-tag"}


class Execution:
    """A running notebook: poll `finished`, then read `failure`."""

    def __init__(
        self, notebook: Path, executed: Path, parameters: dict, scratch: Path, time_limit: float
    ) -> None:
        """Start; the run may take `time_limit` seconds, and one cell half as long."""
        self.started = time.perf_counter()
        self._executed, self._log = executed, scratch / "log.txt"
        self._time_limit, self._reached = time_limit, ""
        executed.parent.mkdir(parents=True, exist_ok=True)
        executed.unlink(missing_ok=True)
        # papermill reads a path as a template
        paths = [str(path).replace("{", "{{").replace("}", "}}") for path in (notebook, executed)]
        options = {"kernel_name": "python3", "language": "python", "cwd": notebook.parent}
        options |= {"execution_timeout": max(1, round(time_limit / 2)), "progress_bar": False}
        start_server()
        arguments = self._log, _environment(scratch), (*paths, parameters), options
        self._process = _SERVER.Process(target=_execute, args=arguments)
        self._process.start()

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self.started

    def finished(self) -> bool:
        """Whether it has ended; past its time limit it is ended here."""
        if self._process.is_alive() and self.seconds > self._time_limit:
            self._reached = f"the time limit of {self._time_limit:g} s for the notebook was reached"
            self.kill()
        return not self._process.is_alive()

    def kill(self) -> None:
        """End the process, its kernel, and all that the kernel has started."""
        import psutil

        # A signal to the process group would miss the kernel, which has its own session.
        family = []
        with suppress(psutil.NoSuchProcess):
            worker = psutil.Process(self._process.pid)
            family = [worker, *worker.children(recursive=True)]
        for process in family:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.join()
        psutil.wait_procs(family, timeout=10)

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
                return f"cell {number}\n{outside or traceback or 'it was not run to its end'}"
        if self._reached or self._process.exitcode or not cells:
            return outside or "\n".join(log.splitlines()[-20:]) or "its process died"
        return ""

    def _cells(self) -> list[tuple[int, Any]]:
        """Cells of the executed copy that hold code, with their numbers in the notebook."""
        import nbformat

        try:
            cells = nbformat.read(self._executed, as_version=4).cells
        except (FileNotFoundError, nbformat.reader.NotJSONError):  # killed before or while saving
            return []
        number, found = 0, []
        for cell in cells:
            number += not _ADDED_BY_PAPERMILL.intersection(cell.metadata.get("tags", []))
            if cell.cell_type == "code" and cell.source.strip():
                found.append((number, cell))
        return found


def start_server() -> None:
    """Start the process from which those of the notebooks are forked."""
    _SERVER.set_forkserver_preload([__name__, "papermill"])  # the import takes two seconds
    forkserver.ensure_running()


def _execute(log: Path, environment: dict[str, str], arguments: tuple, options: dict) -> None:
    """Run a notebook by papermill in a process of its own."""
    import papermill

    os.setsid()  # Ctrl-C then reaches only the process that runs them all
    with open(log, "wb") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    os.environ.clear()
    os.environ.update(environment)
    papermill.execute_notebook(*arguments, **options)


def _environment(scratch: Path) -> dict[str, str]:
    """Environment of this process, without what would make a figure depend on its user."""
    left_out = {"MPLBACKEND", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE"}
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    return environment | {
        "OPENBLAS_NUM_THREADS": "1",  # the matrices are small, and notebooks run side by side
        "TQDM_DISABLE": "1",  # without a terminal, a bar is many lines
        "JUPYTER_PREFER_ENV_PATH": "1",  # this environment's kernel, not the user's
        "JUPYTER_RUNTIME_DIR": str(scratch / "jupyter"),
        "IPYTHONDIR": str(scratch / "ipython"),  # without the user's start-up files
        "MATPLOTLIBRC": str(Path(find_spec("matplotlib").origin).with_name("mpl-data")),
        "PYTHONHASHSEED": "0",
    }
