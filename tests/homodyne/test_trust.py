"""What a long Monte Carlo can be trusted with: interruptions, damage, threads and clusters.

Whatever happens to it, a computation ends with the bits that it would have had on its own, or with
one clear error. The loop here is so noisy that some paths slip: their counts are at stake, too.
"""

import os
import signal
import sqlite3
import subprocess
import sys
import threading
import types
import warnings
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numba
import numpy as np
import pytest

import robsmooth as rs
from robsmooth._support import cluster as cluster_module
from robsmooth._support.checkpoint import CheckpointError
from robsmooth.homodyne.montecarlo import LossOfLockWarning
from robsmooth.homodyne.montecarlo.protocols import (
    PILOT_BLOCK,
    PROTOCOLS,
    ErgodicSimulation,
)
from robsmooth.simulation import groups
from robsmooth.simulation.simulate import _Run
from robsmooth.simulation.statistics import InadmissibleWarning, Tally
from tests.helpers.checkpoints import largest_file, records
from tests.helpers.clusters import cluster_of_threads, start_cluster
from tests.helpers.loops import printed_smoother, same_numbers, threads_of_kernels, with_parameters
from tests.helpers.waiting import PATIENCE, wait_until

NOISY = with_parameters(kappa=4e5)
RUNS, BLOCKS = 677, 11  # the last block is not a whole one
MORE_THREADS = min(numba.config.NUMBA_NUM_THREADS, 2)
WITH_THE_TESTS = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}

each_protocol = pytest.mark.parametrize("protocol", ["paper", "ergodic", "general"])


def simulate(protocol="ergodic", parameters=NOISY, estimator=None, threads=None, **arguments):
    """The numbers of a small run, as a text of all their bits; "general" is `rs.simulate`."""
    arguments = {"runs": RUNS, "duration": 2e-5} | arguments
    estimator = estimator or printed_smoother()
    with warnings.catch_warnings(), threads_of_kernels(threads):
        warnings.simplefilter("ignore", LossOfLockWarning)
        warnings.simplefilter("ignore", InadmissibleWarning)
        if protocol == "general":
            found = vars(rs.simulate(estimator, **arguments))
            return repr({name: np.asarray(value).tolist() for name, value in found.items()})
        return same_numbers(rs.monte_carlo(parameters, estimator, protocol, **arguments))


@pytest.fixture(autouse=True)
def block_by_block(monkeypatch):
    """A group for each block, a call for each group of a thread, and a record for each call."""
    monkeypatch.setattr(groups, "BLOCKS_OF_A_GROUP", 1)
    monkeypatch.setattr(groups, "GROUPS_OF_A_CALL", 1)
    monkeypatch.setattr(groups, "CHECKPOINT_EVERY", 0.0)


@pytest.fixture
def simulated(monkeypatch):
    """The blocks that are simulated in this process, in order."""
    blocks = []
    for simulation in (*PROTOCOLS.values(), _Run):

        def noted(self, first, count, *report, simulate=simulation.simulate):
            blocks.extend(range(first, first + count) if first != PILOT_BLOCK else ())
            return simulate(self, first, count, *report)

        monkeypatch.setattr(simulation, "simulate", noted)
    return blocks


@pytest.fixture
def merging(monkeypatch):
    """Counts the blocks that are merged, wherever simulated; calls `before[n]()` before block n."""
    merging = types.SimpleNamespace(count=0, before={})

    def noted(*arguments, merge=Tally.__add__):
        merging.before.pop(merging.count, lambda: None)()
        merging.count += 1
        return merge(*arguments)

    monkeypatch.setattr(Tally, "__add__", noted)
    return merging


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.checkpoint"


def interrupt():
    raise KeyboardInterrupt


# --- resuming -------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_some_paths_slip_so_that_every_number_is_at_stake(protocol):
    with pytest.warns(LossOfLockWarning):
        result = rs.monte_carlo(NOISY, printed_smoother(), protocol, runs=RUNS, duration=2e-5)
    assert 0 < result.slipped_paths < RUNS


@each_protocol
def test_a_checkpoint_changes_no_bit_and_a_finished_one_needs_no_simulation(
    protocol, path, simulated
):
    expected = simulate(protocol)
    assert simulate(protocol, checkpoint=path) == expected
    assert simulated == [*range(BLOCKS)] * 2
    assert simulate(protocol, checkpoint=str(path)) == expected
    assert len(simulated) == 2 * BLOCKS


@each_protocol
def test_a_run_that_is_interrupted_before_every_block_has_the_same_bits(
    protocol, path, simulated, merging
):
    expected = simulate(protocol)
    for done in range(1, BLOCKS):
        simulated.clear()
        merging.count, merging.before = done - 1, {done: interrupt}
        with pytest.raises(KeyboardInterrupt):
            simulate(protocol, checkpoint=path, threads=1)
        assert records(path) == done
        assert simulated == [done - 1, done], "no finished block is simulated again"
    simulated.clear()
    assert simulate(protocol, checkpoint=path, threads=MORE_THREADS) == expected
    assert simulated == [BLOCKS - 1]


@each_protocol
def test_other_threads_may_resume(protocol, path, merging):
    expected = simulate(protocol)
    for before, after in [(1, MORE_THREADS), (MORE_THREADS, 1)]:
        path.unlink(missing_ok=True)
        merging.count, merging.before = 0, {5: interrupt}
        with pytest.raises(KeyboardInterrupt):
            simulate(protocol, checkpoint=path, threads=before)
        merging.count = 0
        assert simulate(protocol, checkpoint=path, threads=after) == expected
        assert BLOCKS - 5 <= merging.count < BLOCKS


def test_a_run_that_is_killed_resumes_with_the_same_bits(path, simulated):
    program = """
import sys
from robsmooth._support.checkpoint import Journal
from tests.homodyne import test_trust

def noted(*arguments, append=Journal.append):
    append(*arguments)
    print("one more", flush=True)

Journal.append = noted
test_trust.groups.BLOCKS_OF_A_GROUP, test_trust.groups.CHECKPOINT_EVERY = 1, 0.0
test_trust.simulate(runs=50_000, checkpoint=sys.argv[1], threads=1)
"""
    with subprocess.Popen(
        [sys.executable, "-c", program, path],
        env=WITH_THE_TESTS,
        stdout=subprocess.PIPE,
    ) as process:
        try:
            assert all(process.stdout.readline() for _ in range(6))
        finally:
            process.kill()
    assert process.returncode == -signal.SIGKILL
    assert 6 <= records(path) < 50_000 / RUNS * BLOCKS
    resumed = simulate(runs=50_000, checkpoint=path)
    assert simulated[0] > 5
    assert resumed == simulate(runs=50_000)


def test_without_fcntl_as_on_windows_a_run_is_checkpointed_and_resumed(path):
    program = """
import sys
sys.modules["fcntl"] = None
import robsmooth as rs
from robsmooth._support import files
from tests.helpers.loops import PARAMETERS, printed_smoother
for _ in range(2):
    with files.exclusive_lock(sys.argv[1] + ".lock"):
        rs.monte_carlo(PARAMETERS, printed_smoother(), runs=64, checkpoint=sys.argv[1])
"""
    subprocess.run([sys.executable, "-c", program, path], check=True, env=WITH_THE_TESTS)
    assert records(path) == 1


@each_protocol
def test_a_full_disk_is_a_clear_error_and_the_run_resumes_once_there_is_room(
    protocol, path, simulated
):
    many, blocks = 4 * RUNS, 43
    expected = simulate(protocol, runs=many)
    with (
        pytest.raises(OSError, match=r"run\.checkpoint takes no more, .*; .* the same run resumes"),
        largest_file(12_000),
    ):
        simulate(protocol, runs=many, checkpoint=path, threads=1)
    kept = records(path)
    assert 1 < kept < blocks
    simulated.clear()
    assert simulate(protocol, runs=many, checkpoint=path) == expected
    assert simulated == [*range(kept, blocks)]


def test_a_damaged_record_is_set_aside_and_never_taken_for_a_result(path, simulated):
    simulate(checkpoint=path, threads=1)
    with closing(sqlite3.connect(path)) as database, database:
        last = f"number = {BLOCKS}"
        database.execute(f"UPDATE record SET text = replace(text, '0.', '1.') WHERE {last}")
    simulated.clear()
    with pytest.warns(UserWarning, match=rf"{BLOCKS - 1} of its records are whole, and kept here"):
        found = simulate(checkpoint=path)
    assert simulated == [BLOCKS - 1]
    assert found == simulate()
    assert path.with_name(f"{path.name}.damaged-1").exists()


def test_progress_goes_on_from_where_it_was(path, merging, terminal):
    merging.before = {4: interrupt}
    with pytest.raises(KeyboardInterrupt):
        simulate(checkpoint=path, threads=1)
    simulate(checkpoint=path, progress=True)
    first, *_ = terminal.readouterr().err.strip("\r").split("\r")
    assert "38%" in first  # 512 of 1333 paths


# --- checkpoints that are refused -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"seed": 1}, "seed is 0 there and 1 here"),
        ({"runs": RUNS - 1}, f"runs is {RUNS} there and {RUNS - 1} here"),
        ({"duration": 4e-5}, "duration is .* there and .* here"),
        ({"step": 3.1e-6 / 9}, r"step is 3\.875e-07 there and 3\.4\d*e-07 here"),
        ({"precision": "single"}, 'precision is "mixed" there and "single" here'),
        ({"protocol": "paper"}, 'protocol is "ergodic" there and "paper" here'),
        ({"parameters": with_parameters(kappa=4.1e5)}, r"\.kappa is 400000\.0 there and 410000\.0"),
        ({"estimator": printed_smoother(6.2e-6)}, "delay is 3.1e-06 there and 6.2e-06 here"),
        ({"shot_noise": 2.0}, r"shot_noise is 1\.0 there and 2\.0 here"),
        ({"oscillator": "smoothed"}, 'oscillator is "filtered" there and "smoothed" here'),
        ({"copy": False}, "copy is true there and false here"),
    ],
    ids=str,
)
def test_a_checkpoint_of_another_run_is_refused_with_the_difference(
    path, simulated, change, difference
):
    simulate(checkpoint=path)
    content = path.read_bytes()
    simulated.clear()
    with pytest.raises(CheckpointError, match=f"of another computation: .*{difference}"):
        simulate(**change, checkpoint=path)
    assert simulated == []
    assert path.read_bytes() == content


@pytest.mark.parametrize("matrix", ["A_c", "B_c", "C_c", "C_a"])
def test_a_checkpoint_of_another_estimator_is_refused(path, simulated, matrix):
    simulate(checkpoint=path)
    simulated.clear()
    other = printed_smoother()
    other = replace(other, **{matrix: getattr(other, matrix) * (1 + 1e-15)})
    with pytest.raises(CheckpointError, match=r"estimator_sha256 is .* there and .* here"):
        simulate(estimator=other, checkpoint=path)
    assert simulated == []


@pytest.mark.parametrize("name", ["python", "numpy", "numba", "scipy", "robsmooth"])
def test_a_checkpoint_of_another_version_is_refused(monkeypatch, path, simulated, name):
    simulate(checkpoint=path)
    simulated.clear()
    other = {**cluster_module.software(), name: "0.0.1"}
    monkeypatch.setattr(cluster_module, "software", lambda: other)
    with pytest.raises(CheckpointError, match=rf'software\.{name} is .* there and "0\.0\.1" here'):
        simulate(checkpoint=path)
    assert simulated == []


def test_a_checkpoint_that_cannot_be_one_is_refused_before_anything_is_simulated(
    tmp_path, simulated
):
    notes = tmp_path / "notes.txt"
    notes.write_text("of a user\n")
    for checkpoint, error, message in [
        (tmp_path, CheckpointError, "not a checkpoint of this version of robsmooth: give another"),
        (notes, CheckpointError, "is not a checkpoint"),
        (notes / "run", CheckpointError, "cannot be opened"),
        ("", TypeError, "checkpoint must be the path of a file"),
        (True, TypeError, "checkpoint must be the path of a file"),
    ]:
        with pytest.raises(error, match=message):
            simulate(checkpoint=checkpoint)
    assert simulated == []
    assert notes.read_text() == "of a user\n"


# --- on a cluster ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster():
    """Workers of several threads, with the pool that ends a process which two of them enter."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_THREADING_LAYER", "workqueue")
        with start_cluster(threads_per_worker=2) as cluster:
            yield cluster


@pytest.fixture
def client(cluster):
    with cluster_module.connect(cluster.scheduler_address, timeout=PATIENCE) as client:
        yield client


@each_protocol
def test_a_cluster_gives_the_same_bits(protocol, client, simulated, monkeypatch):
    pids = client.run(os.getpid)
    for runs in (1, 128, RUNS):
        expected = simulate(protocol, runs=runs)
        simulated.clear()
        assert simulate(protocol, runs=runs, client=client) == expected
        assert simulated == []
    monkeypatch.setattr(groups, "GROUPS_OF_A_CALL", 4)  # 11 blocks are not a multiple of that
    monkeypatch.setattr(groups, "CALLS_OF_A_THREAD", 0.5)
    assert simulate(protocol, client=client) == expected
    assert client.run(os.getpid) == pids, "no worker has crashed"


@each_protocol
def test_groups_of_several_blocks_change_no_bit(protocol, client, path, merging, monkeypatch):
    monkeypatch.setattr(groups, "BLOCKS_OF_A_GROUP", 3)
    expected = simulate(protocol, threads=1)
    assert merging.count == 4, "the last of them is not a whole one"
    assert simulate(protocol, threads=MORE_THREADS) == expected
    assert simulate(protocol, client=client) == expected
    merging.count, merging.before = 0, {2: interrupt}
    with pytest.raises(KeyboardInterrupt):
        simulate(protocol, checkpoint=path, threads=1)
    assert simulate(protocol, client=client, checkpoint=path) == expected
    assert merging.count == 4


def test_workers_have_the_weights_of_the_control_variates_from_here(monkeypatch):
    def noted(self, first, count, *report, simulate=ErgodicSimulation.simulate):
        if first == PILOT_BLOCK:
            pilots.append(threading.current_thread())
        return simulate(self, first, count, *report)

    pilots = []
    monkeypatch.setattr(ErgodicSimulation, "simulate", noted)
    with cluster_of_threads() as (_, client):
        simulate(client=client)
    assert pilots == [threading.main_thread()]


def test_a_killed_worker_changes_no_bit(client, merging):
    # Each worker once: Dask gives up one that is lost twice within a quarter of a minute.
    pids = client.run(os.getpid).values()
    for protocol, pid in zip(PROTOCOLS, pids, strict=True):
        expected = simulate(protocol, runs=10 * RUNS)
        merging.count, merging.before = 0, {20: partial(os.kill, pid, signal.SIGKILL)}
        assert simulate(protocol, runs=10 * RUNS, client=client) == expected
        assert merging.before == {}
    wait_until(lambda: not {*pids} & {*client.run(os.getpid, on_error="ignore").values()})


@each_protocol
def test_a_run_moves_between_this_machine_and_a_cluster(protocol, client, path, merging):
    expected = simulate(protocol)
    merging.count, merging.before = 0, {3: interrupt, 8: interrupt}
    with pytest.raises(KeyboardInterrupt):
        simulate(protocol, client=client, checkpoint=path)
    assert records(path) == 3
    with pytest.raises(KeyboardInterrupt):
        simulate(protocol, checkpoint=path, threads=1)
    assert records(path) == 8
    assert simulate(protocol, client=client, checkpoint=path) == expected
    assert merging.count == BLOCKS
    assert simulate(protocol, client=client, checkpoint=path) == expected
    assert merging.count == BLOCKS


def test_a_path_that_overflows_is_named_from_a_cluster_as_from_here(client):
    errors, unstable = [], replace(printed_smoother(), A_c=1e6 * np.eye(3))
    for where in (None, client):
        with pytest.raises(RuntimeError, match=r"path 0 of seed 0 overflowed, with lam=") as caught:
            simulate("paper", estimator=unstable, step=3.1e-8, duration=1e-3, client=where)
        errors.append(str(caught.value))
    assert errors[0] == errors[1]


def test_a_cluster_that_is_lost_leaves_a_checkpoint_to_resume_from(path, merging):
    expected = simulate(runs=10 * RUNS)
    blocks = merging.count
    with cluster_of_threads() as (cluster, client):
        merging.count, merging.before = 0, {30: cluster.close}
        with pytest.raises(ConnectionError, match="no connection to the Dask scheduler"):
            simulate(runs=10 * RUNS, client=client, checkpoint=path)
    kept = records(path)
    assert 30 <= kept < blocks
    merging.count = 0
    assert simulate(runs=10 * RUNS, checkpoint=path) == expected
    assert merging.count == blocks - kept


def test_what_is_no_client_is_refused(simulated):
    with pytest.raises(TypeError, match=r"client must be a distributed\.Client or None, got 'tcp"):
        simulate(client="tcp://127.0.0.1:8786")
    assert simulated == []
