"""One notebook in a process of its own, as several in one hang, judged by its executed copy.

papermill's word is not enough: it takes `sys.exit(0)` in a cell for success.
"""

import os
import re
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the extra [notebooks]
    from nbformat import NotebookNode

_ANSI = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")
_LAST_ERROR = re.compile(r".*^([\w.]*(?:Error|Exception|Exit)\b.*)", re.DOTALL | re.MULTILINE)
_ADDED_BY_PAPERMILL = {"injected-parameters", "papermill-error-cell-tag"}


class Execution:
    """A running notebook: poll it until it is finished, then ask for its failure, if any."""

    def __init__(
        self, notebook: Path, executed: Path, parameters: dict, scratch: Path, time_limit: float
    ) -> None:
        """Start; the run may take `time_limit` seconds, and one cell of it half as long."""
        import yaml  # papermill needs it, too

        self.started = time.perf_counter()
        self._executed, self._log = executed, scratch / "log.txt"
        self._time_limit, self._timed_out = time_limit, False
        executed.parent.mkdir(parents=True, exist_ok=True)
        executed.unlink(missing_ok=True)
        command = [sys.executable, "-P", "-m", "papermill", "--no-progress-bar"]
        command += ["--kernel=python3", "--language=python", "--log-level=ERROR"]
        command += [f"--cwd={notebook.parent}", f"--execution-timeout={max(1, time_limit / 2):.0f}"]
        command += ["--parameters_yaml", yaml.safe_dump(parameters, sort_keys=False)]
        for path in (notebook, executed):  # papermill would take braces for a template's
            command.append(str(path).replace("{", "{{").replace("}", "}}"))
        options = {"stdin": subprocess.DEVNULL, "stderr": subprocess.STDOUT}
        options |= {"env": _environment(scratch), "start_new_session": True}  # Ctrl-C is ours
        with open(self._log, "wb") as log:
            self._process = subprocess.Popen(command, stdout=log, **options)

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self.started

    def finished(self) -> bool:
        """Whether it has ended; one that is over its time limit is ended here."""
        if self._process.poll() is None and self.seconds > self._time_limit:
            self._timed_out = True
            self.kill()
        return self._process.poll() is not None

    def kill(self) -> None:
        """End the process, its kernel, and all that the kernel has started."""
        import psutil

        # The kernel has a session of its own, so a signal to the process group would miss it.
        family = []
        with suppress(psutil.NoSuchProcess):
            worker = psutil.Process(self._process.pid)
            family = [worker, *worker.children(recursive=True)]
        for process in family:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.wait()
        psutil.wait_procs(family, timeout=10)

    def failure(self) -> str:
        """Why the finished run failed: the cell, numbered from 1, and its traceback; "" if not."""
        limit = ""
        if self._timed_out:
            limit = f"the time limit of {self._time_limit:g} s for the notebook was reached"
        log = self._log.read_text(errors="replace").strip()
        # What papermill itself says of an error in a cell stands in the cell, too.
        found = None if "PapermillExecutionError" in log else _LAST_ERROR.match(log)
        error = found[1] if found else ""
        cells = self._cells()
        for number, cell in cells:
            errors = [output for output in cell.outputs if output.output_type == "error"]
            lines = [line for each in errors for line in each.traceback or [each.ename]]
            traceback = _ANSI.sub("", "\n".join(lines)).strip()
            # papermill marks even the cell that its kernel died in as completed: go by the reply
            if traceback or "shell.execute_reply" not in cell.metadata.get("execution", {}):
                reason = limit or error or traceback or "the cell was not run to its end"
                return f"cell {number}\n{reason}"
        if limit or self._process.returncode or not cells:
            last = "\n".join(log.splitlines()[-20:])
            return limit or error or last or "its process died"
        return ""

    def _cells(self) -> "list[tuple[int, NotebookNode]]":
        """Code cells of the executed copy that hold code, with their numbers in the source."""
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


def _environment(scratch: Path) -> dict[str, str]:
    """Our environment, less what would make a figure depend on its user."""
    left_out = {"MPLBACKEND", "PYTHONPATH"}
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    return environment | {
        "OPENBLAS_NUM_THREADS": "1",  # the matrices are small, and notebooks run side by side
        "TQDM_DISABLE": "1",  # a bar without a terminal fills the executed copy with lines
        "JUPYTER_PREFER_ENV_PATH": "1",  # this environment's kernel, not the user's
        "JUPYTER_RUNTIME_DIR": str(scratch / "jupyter"),
        "IPYTHONDIR": str(scratch / "ipython"),  # no start-up files of the user's
        "MATPLOTLIBRC": str(Path(find_spec("matplotlib").origin).with_name("mpl-data")),
        "PYTHONHASHSEED": "0",
    }
