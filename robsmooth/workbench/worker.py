"""One notebook in papermill, in a process that ends when the one that started it does.

All that it starts inherits `FOLDER`, by which it is found even where its own parent has ended.
"""

import json
import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

FOLDER = "JUPYTER_RUNTIME_DIR"


def end_all(folder: Path) -> None:
    """Kill the processes whose `FOLDER` is in a folder, and theirs; wait until there are none."""
    import psutil  # comes with the notebooks

    found, deadline = True, time.monotonic() + 10.0
    while found and time.monotonic() < deadline:
        found = False
        for process in psutil.process_iter(["environ"]):  # None of other users' and of zombies
            place = (process.info["environ"] or {}).get(FOLDER)
            if place and Path(place).is_relative_to(folder) and process.pid != os.getpid():
                found = True
                with suppress(psutil.NoSuchProcess):
                    for each in (*process.children(recursive=True), process):
                        each.kill()
        time.sleep(0.01 * found)


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # nothing, once the other end is closed
    end_all(Path(os.environ[FOLDER]))
    os._exit(1)


if __name__ == "__main__":
    source, copy, parameters, seconds = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import papermill

    options = {"kernel_name": "python3", "language": "python", "progress_bar": False}
    papermill.execute_notebook(source, copy, parameters, execution_timeout=seconds, **options)
