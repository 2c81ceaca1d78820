"""JupyterLab as `make lab` starts it, with folders and a port of its own."""

import json
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path

import psutil
from jupyter_server.serverapp import list_running_servers

from tests.helpers.waiting import PATIENCE

ROOT = Path(__file__).resolve().parents[2]
STAMPS = [f"--old-file=.venv/{kind}.stamp" for kind in ("run", "dev", "bench")]


@dataclass(frozen=True)
class Lab:
    """A running JupyterLab."""

    home: Path
    port: int
    token: str
    make: psutil.Popen

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def request(
        self, method: str, path: str, token: str = "", content: object = None
    ) -> tuple[int, bytes]:
        """Status and content of the server's answer, redirections not followed."""
        headers = {"Authorization": f"token {token}"} if token else {}
        body = None if content is None else json.dumps(content)
        with closing(HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)) as connection:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            return answer.status, answer.read()

    def start_kernel(self, notebook: str) -> Path:
        """Start the kernel of a notebook, as its page does; give its connection file."""
        session = {
            "type": "notebook",
            "name": notebook,
            "path": notebook,
            "kernel": {"name": "python3"},
        }
        status, content = self.request("POST", "/api/sessions", self.token, session)
        assert status == 201, content
        return self.home / f"runtime/kernel-{json.loads(content)['kernel']['id']}.json"

    def end_kernels(self) -> None:
        """End all kernels."""
        for session in json.loads(self.request("GET", "/api/sessions", self.token)[1]):
            self.request("DELETE", f"/api/sessions/{session['id']}", self.token)


@contextmanager
def running_lab(home: Path, options: str = "") -> Iterator[Lab]:
    """Start JupyterLab, and end it with all that it has started.

    All that Jupyter and IPython keep is in `home`, where several can be at home.
    """
    log = home / f"log-{time.monotonic_ns()}.txt"
    own = {
        "JUPYTER_CONFIG_DIR": home / "config",
        "JUPYTER_DATA_DIR": home / "data",
        "JUPYTER_RUNTIME_DIR": home / "runtime",
        "IPYTHONDIR": home / "ipython",
    }
    # settings of a make around us and of the user, and what hides progress bars
    left_out = ("MAKE", "MFLAGS", "JUPYTER", "MPLBACKEND", "CI", "TQDM")
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(left_out)
    }
    options = f"--no-browser --LabApp.workspaces_dir={home / 'workspaces'} {options}"
    with open(log, "wb") as output:
        make = psutil.Popen(
            ["make", *STAMPS, "lab", f"LAB={options}"],
            cwd=ROOT,
            env=environment | {name: str(folder) for name, folder in own.items()},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        lab = _wait_for_lab(make, home, log)
        yield lab
        lab.request("POST", "/api/shutdown", lab.token)
        make.wait(PATIENCE)
    finally:
        _kill(make)


def _wait_for_lab(make: psutil.Popen, home: Path, log: Path) -> Lab:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and make.poll() is None:
        family = {process.pid for process in make.children(recursive=True)}
        try:
            for server in list_running_servers(str(home / "runtime")):
                lab = Lab(home, server["port"], server["token"], make)
                if server["pid"] in family and lab.request("GET", "/api/status", lab.token):
                    return lab
        except (ValueError, OSError):
            pass  # its file is being written, or its port not open yet
        time.sleep(0.1)
    raise AssertionError(f"JupyterLab has not started: {log.read_text()}")


def _kill(make: psutil.Popen) -> None:
    """End what is left of a JupyterLab; its kernels have sessions of their own."""
    family = [*make.children(recursive=True), make] if make.is_running() else []
    for process in family:
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
    psutil.wait_procs(family, timeout=PATIENCE)
