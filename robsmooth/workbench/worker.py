"""One notebook in papermill, in a process that ends when the one that started it does.

All that it starts inherits `FOLDER`, by which it is found even where its own parent has ended.
"""

import json
import logging
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

    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        found = set()
        for process in psutil.process_iter(["environ"]):  # None of other users' and of zombies
            place = (process.info["environ"] or {}).get(FOLDER)
            if place and Path(place).is_relative_to(folder) and process.pid != os.getpid():
                with suppress(psutil.NoSuchProcess):
                    found |= {process, *process.children(recursive=True)}
        for process in found:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        if not found:
            return
        time.sleep(0.01)


def _end_with_parent() -> None:
    while os.read(sys.stdin.fileno(), 1):  # empty once the other end is closed
        pass
    end_all(Path(os.environ[FOLDER]))
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import papermill

    logging.basicConfig(level=logging.ERROR, format="%(message)s")
    papermill.execute_notebook(**json.loads(Path(sys.argv[1]).read_text()))
