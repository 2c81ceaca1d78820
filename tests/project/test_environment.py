"""What environment.md says of clusters: its script and its commands, run on this machine."""

import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import dask
import psutil
import pytest

import robsmooth as rs
from robsmooth._support.cluster import workers
from robsmooth.workbench import connect
from tests.helpers.signals import heed_signals
from tests.helpers.sockets import listening
from tests.helpers.waiting import PATIENCE, wait_until

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "environment.md").read_text(encoding="utf-8")
DASK = Path(sys.executable).with_name("dask")


def smoother():
    return rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system(), copies=True)


def few_paths(client=None):
    return rs.monte_carlo(rs.homodyne.PAPER, smoother(), "paper", 64, 2e-5, client=client)


def replaced(text, **values):
    for old, new in values.items():
        assert old in text
        text = text.replace(old, new)
    return text


def test_the_script_on_processes_of_this_machine_runs(tmp_path):
    (script,) = re.findall(r"```python\n(.*?LocalCluster.*?)```", TEXT, flags=re.DOTALL)
    smaller = {"n_workers=8": "n_workers=2", '"paper", client': '"paper", 64, 2e-5, client'}
    smaller |= {"build/paper.sqlite": str(tmp_path / "paper.sqlite")}
    (tmp_path / "script.py").write_text(replaced(script, **smaller))
    run = [sys.executable, "script.py"]
    ended = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert "64 runs" in ended.stdout
    assert (tmp_path / "paper.sqlite").is_file()


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Files of a key and of a certificate, which is its own authority."""
    folder = tmp_path_factory.mktemp("certificate")
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1"]
    make += ["-subj", "/CN=localhost", "-keyout", "key.pem", "-out", "cert.pem"]
    try:
        subprocess.run(make, cwd=folder, check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip("there is no openssl")
    files = {"ca-file": "cert.pem", "cert": "cert.pem", "key": "key.pem"}
    return {name: str(folder / file) for name, file in files.items()}


@contextmanager
def started(folder, *command):
    """A program whose log is in the folder; it is ended as by Ctrl-C."""
    with open(folder / f"{command[0]}.log", "w") as log:
        program = subprocess.Popen(
            [DASK, *command], stdout=log, stderr=log, cwd=folder, preexec_fn=heed_signals
        )
        try:
            yield Path(log.name)
        finally:
            program.send_signal(signal.SIGINT)
            program.wait(PATIENCE)


@contextmanager
def cluster(folder, *options, secure=()):
    """The address of a scheduler with two workers, started by the commands of the page."""
    here = re.sub(r"\b10\.0\.0\.\d", "127.0.0.1", TEXT).replace(":8787", ":0")
    commands = [line.split("  ")[0].split() for line in here.splitlines() if "/dask " in line]
    scheduler, worker = (command[1:] for command in commands[:2])
    with started(folder, *scheduler, "--port", "0", *options, *secure) as log:

        def lines():
            return re.findall(r"Scheduler at:\s+(\S+)", log.read_text())

        wait_until(lines)
        worker[1] = lines()[0]
        worker[worker.index("--nworkers") + 1] = "2"
        with started(folder, *worker, *secure):
            yield worker[1]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The address of a cluster without certificates."""
    with cluster(tmp_path_factory.mktemp("plain")) as address:
        yield address


def test_the_commands_make_a_cluster_with_the_same_bits(plain):
    with connect(plain, timeout=PATIENCE) as client:
        assert plain.startswith("tcp://127.0.0.1:")
        assert few_paths(client).smoothed == few_paths().smoothed


def test_the_commands_open_no_port_elsewhere(plain):
    with connect(plain, timeout=PATIENCE) as client:
        wait_until(lambda: workers(client) == 2)
        found = [each for child in psutil.Process().children() for each in listening(child)]
    assert len(found) > 2 and {each.ip for each in found} == {"127.0.0.1"}


def test_with_certificates_only_those_who_have_them_are_served(tmp_path, certificate):
    options = [word for name, path in certificate.items() for word in (f"--tls-{name}", path)]
    named = {"ca-file": "CA_FILE", "cert": "CLIENT__CERT", "key": "CLIENT__KEY"}
    assert all(f"DASK_DISTRIBUTED__COMM__TLS__{name}`" in TEXT for name in named.values())
    with cluster(tmp_path, "--protocol", "tls", secure=options) as address:
        assert address.startswith("tls://127.0.0.1:")
        ours = {
            f"distributed.comm.tls.{named[name].lower().replace('__', '.').replace('_', '-')}": path
            for name, path in certificate.items()
        }
        with dask.config.set(ours), connect(address, timeout=PATIENCE) as client:
            assert few_paths(client).smoothed == few_paths().smoothed
        with pytest.raises(ConnectionError), connect(address, timeout=2):
            pass
        plain = address.replace("tls://", "tcp://")
        with pytest.raises(ConnectionError), connect(plain, timeout=2):
            pass
