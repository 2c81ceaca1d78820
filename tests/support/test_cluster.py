import asyncio
import logging
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import closing, contextmanager
from itertools import repeat

import dask
import distributed
import numpy as np
import psutil
import pytest

from robsmooth._support import cluster as cluster_module
from robsmooth._support.cluster import connect, in_order, worker_threads, workers
from tests.helpers.clusters import LOOPBACK, cluster_of_threads, start_cluster
from tests.helpers.sockets import free_port, listening
from tests.helpers.waiting import PATIENCE, wait_until

# Functions that are sent to a worker are made within tests: they travel by value then, because a
# worker has no module of tests to import.


@pytest.fixture(scope="module")
def cluster():
    with start_cluster() as cluster:
        yield cluster


@pytest.fixture
def client(cluster):
    with connect(cluster.scheduler_address, timeout=PATIENCE) as client:
        yield client


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Time limits of Dask and of `cluster_module` that are longer than any test."""
    monkeypatch.setattr(cluster_module, "ANSWER_TIME", 2 * PATIENCE)
    monkeypatch.setattr(cluster_module, "JOIN_TIME", 2 * PATIENCE)
    with dask.config.set({"distributed.comm.timeouts.connect": 2 * PATIENCE}):
        yield


@pytest.fixture
def listener():
    """A socket that accepts connections and then says nothing."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:
        yield listener


def numbers(count):
    return ((number,) for number in range(count))


# --- here -----------------------------------------------------------------------------------------


def test_without_a_client_calls_are_computed_here_one_after_another():
    done = []
    results = in_order(lambda a, b: done.append(a) or a + b, ((i, 10) for i in range(3)))
    assert next(results) == 10
    assert done == [0]
    assert list(results) == [11, 12]


def test_dask_is_not_imported_before_a_cluster_is_asked_for():
    program = """
import sys
sys.modules["distributed"] = sys.modules["dask"] = None
from robsmooth._support.cluster import connect, in_order, worker_threads
assert list(in_order(divmod, [(7, 3)])) == [(2, 1)]
assert worker_threads() is None
with connect("") as client:
    assert client is None
with connect("tcp://127.0.0.1:8786") as client:
    pass
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    last = "a cluster needs the package distributed: pip install 'robsmooth[cluster]'"
    assert ended.stderr.splitlines()[-1].endswith(f"MissingExtraError: {last}")


# --- on a cluster ---------------------------------------------------------------------------------


def test_a_cluster_gives_the_results_of_here_in_the_same_order(client):
    def noise(seed, pause):
        time.sleep(pause)
        return np.random.default_rng(seed).normal(size=100)

    calls = [(seed, random.Random(seed).uniform(0, 0.1)) for seed in range(30)]
    here = list(in_order(noise, calls))
    there = list(in_order(noise, calls, client))
    np.testing.assert_array_equal(here, there)
    assert workers(client) == 2


def test_calls_are_computed_by_all_workers(client):
    pids = in_order(lambda: time.sleep(0.05) or os.getpid(), [()] * 20, client)
    assert len(set(pids) - {os.getpid()}) == 2


def test_few_calls_are_on_their_way_and_none_are_kept(cluster, client):
    def calls():
        nonlocal taken
        for taken in range(1, 101):
            yield (taken,)

    taken = 0
    most = cluster_module.CALLS_PER_THREAD * 2 + cluster_module.CALLS_AHEAD
    for result in in_order(lambda number: number, calls(), client):
        assert taken - result <= most
        assert len(client.futures) <= most + 2
        if result == 50:
            time.sleep(0.3)  # a reader that takes its time
    assert taken == 100
    wait_until(lambda: not cluster.scheduler.tasks)


class OwnError(Exception):
    pass


@pytest.mark.parametrize(
    "error",
    [ZeroDivisionError("none"), OSError(28, "full"), TimeoutError("late"), ImportError("x")],
)
def test_what_the_function_raises_comes_as_itself_after_the_results_before(client, error):
    def fail(number):
        if number == 5:
            raise error
        return number

    results = in_order(fail, numbers(20), client)
    assert [next(results) for _ in range(5)] == list(range(5))
    with pytest.raises(type(error)) as caught:
        next(results)
    assert caught.value.args == error.args
    assert list(results) == []


def test_a_call_that_takes_longer_than_an_answer_is_waited_for(client, monkeypatch):
    monkeypatch.setattr(cluster_module, "ANSWER_TIME", 0.5)
    assert list(in_order(lambda: time.sleep(1.8) or 3, [()], client)) == [3]


def test_an_iterator_that_is_closed_early_drops_what_is_on_its_way(
    cluster, client, tmp_path, request
):
    def note(number):
        (tmp_path / str(number)).touch()
        while number > 0 and not (tmp_path / "go on").exists():
            time.sleep(0.01)

    def known():
        return client.run(lambda dask_worker: list(dask_worker.state.tasks)).values()

    request.addfinalizer((tmp_path / "go on").touch)
    with closing(in_order(note, numbers(50), client)) as results:
        next(results)
        wait_until(lambda: len(os.listdir(tmp_path)) == 3)  # a call for each worker is not done
    wait_until(lambda: not cluster.scheduler.tasks)
    # what comes after all that each worker was sent, and is computed after it
    last = [
        client.submit(abs, 1, key=f"last-{address}", workers=[address], priority=-1000)
        for address in cluster.scheduler.workers
    ]
    wait_until(lambda: all(any("last" in key for key in keys) for keys in known()))
    (tmp_path / "go on").touch()
    client.gather(last)
    assert len(os.listdir(tmp_path)) == 3 + 1


def test_an_error_in_the_loop_over_the_results_drops_what_is_on_its_way(cluster, client):
    with pytest.raises(KeyboardInterrupt):
        for _ in in_order(time.sleep, [(0.1,)] * 50, client):
            raise KeyboardInterrupt
    wait_until(lambda: not cluster.scheduler.tasks)


def test_an_error_in_the_calls_drops_what_is_on_its_way(cluster, client):
    def calls():
        yield (0.1,)
        raise LookupError("no more")

    with pytest.raises(LookupError, match="no more"):
        list(in_order(time.sleep, calls(), client))
    wait_until(lambda: not cluster.scheduler.tasks)


# --- what goes wrong with workers -----------------------------------------------------------------


def test_a_killed_worker_changes_no_result(client):
    def work(number):
        time.sleep(0.05)
        return number, os.getpid()

    results = in_order(work, numbers(40), client)
    found = [next(results) for _ in range(5)]
    os.kill(found[-1][1], signal.SIGKILL)
    found += results
    assert [number for number, _ in found] == list(range(40))


def test_a_call_that_ends_its_workers_is_one_clear_error(tmp_path):
    started, ended = tmp_path / "started", tmp_path / "ended"

    def call():
        started.touch()
        wait_until(ended.exists)

    def end_worker():
        wait_until(started.exists)
        address = cluster.workers[0].worker_address
        cluster.sync(cluster.scheduler.remove_worker, address, stimulus_id="test")

    with cluster_of_threads() as (cluster, client):
        cluster.scheduler.allowed_failures = 0
        threading.Thread(target=end_worker).start()
        with pytest.raises(RuntimeError, match=r"the same call was on 1 worker\(s\) that ended"):
            list(in_order(call, [()], client))
        ended.touch()


class Clock:
    """A clock that goes on while somebody sleeps, and only then."""

    def __init__(self):
        self.now = 0.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_without_a_worker_there_is_an_error_and_one_that_joins_is_used(monkeypatch):
    with cluster_of_threads(n_workers=0) as (cluster, client):
        for function in (workers, lambda *a, **k: list(in_order(abs, numbers(1), *a, **k))):
            clock = Clock()
            with (
                monkeypatch.context() as patch,
                pytest.raises(ConnectionError, match=r"no worker has joined .* for 12 s: start"),
            ):
                patch.setattr(cluster_module, "time", clock)
                patch.setattr(cluster_module, "JOIN_TIME", 12)
                function(client)
            assert clock.now == pytest.approx(12, abs=0.2)
        cluster.scale(1)
        assert list(in_order(abs, numbers(3), client)) == [0, 1, 2]
        assert workers(client) == 2


def test_a_worker_that_joins_raises_the_number_of_calls_on_their_way():
    before = cluster_module.CALLS_PER_THREAD + cluster_module.CALLS_AHEAD
    with cluster_of_threads(threads_per_worker=1) as (cluster, client):
        results = in_order(time.sleep, repeat((0.01,)), client)
        with closing(results):
            for _ in range(10):
                next(results)
                assert len(client.futures) <= before
            cluster.scale(3)
            wait_until(lambda: next(results) or len(client.futures) > before)


def test_workers_that_all_leave_are_missed_after_a_while(monkeypatch):
    monkeypatch.setattr(cluster_module, "ANSWER_TIME", 0.5)
    with cluster_of_threads() as (cluster, client):
        monkeypatch.setattr(cluster_module, "JOIN_TIME", 0.5)
        results = in_order(time.sleep, repeat((0.05,)), client)
        next(results)
        cluster.scale(0)
        with pytest.raises(ConnectionError, match="no worker has joined"):
            deque(results, maxlen=0)


def test_a_worker_that_leaves_with_a_result_is_waited_for(monkeypatch):
    monkeypatch.setattr(cluster_module, "ANSWER_TIME", 0.5)
    take = cluster_module._result
    with cluster_of_threads() as (cluster, client):

        def result_that_left(future, client):
            if not left:
                future.exception(timeout=PATIENCE)
                cluster.scale(0)
                wait_until(lambda: not client.scheduler_info()["workers"])
                left.append(future.key)
                cluster.scale(joins)
            return take(future, client)

        monkeypatch.setattr(cluster_module, "_result", result_that_left)
        left, joins = [], 1
        assert list(in_order(abs, numbers(3), client)) == [0, 1, 2]
        assert left
        monkeypatch.setattr(cluster_module, "JOIN_TIME", 0.5)
        left, joins = [], 0
        with pytest.raises(ConnectionError, match="no worker has joined"):
            list(in_order(abs, numbers(3), client))


def test_a_worker_with_other_software_is_refused(client, monkeypatch):
    mine = {**cluster_module.software(), "numpy": "1.0", "robsmooth": "0" * 64}
    monkeypatch.setattr(cluster_module, "software", lambda: mine)
    with pytest.raises(RuntimeError, match="a worker has other software") as caught:
        list(in_order(abs, numbers(3), client))
    ends = r"robsmooth \w{16}\.\.\.\w{8} and not 0{16}\.\.\.0{8};"
    assert re.search(rf"numpy [\d.]+ and not 1\.0, {ends}", str(caught.value))


def test_the_digest_of_the_sources_depends_on_their_names_and_contents(tmp_path):
    def digest():
        return cluster_module._digest_sources(tmp_path)

    digests = [digest()]
    (tmp_path / "sub").mkdir()
    for name, text in [("a.py", ""), ("b.py", ""), ("sub/a.py", "1"), ("b.py", "1")]:
        (tmp_path / name).write_text(text)
        digests.append(digest())
    (tmp_path / "notes.txt").touch()
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "a.pyc").touch()
    assert digest() == digests[-1]
    assert len(set(digests)) == len(digests)


# --- what goes wrong with the scheduler -----------------------------------------------------------


@contextmanager
def missing_the_scheduler():
    """Expect the error, and that it comes before any time limit is over."""
    started = time.monotonic()
    with pytest.raises(ConnectionError, match="no connection to the Dask scheduler"):
        yield
    assert time.monotonic() - started < PATIENCE


def test_a_scheduler_that_closes_is_missed_at_once():
    with cluster_of_threads() as (cluster, client):
        results = in_order(time.sleep, repeat((0.05,)), client)
        next(results)
        threading.Thread(target=cluster.close).start()
        with missing_the_scheduler():
            deque(results, maxlen=0)
        with pytest.raises(ConnectionError, match="no connection to the Dask scheduler"):
            list(in_order(abs, [], client))


def test_a_worker_without_this_package_then_a_scheduler_that_freezes_and_is_killed(
    tmp_path, monkeypatch
):
    def start(*arguments):
        options = LOOPBACK
        started.append(
            subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments, *options],
                cwd=tmp_path,
                env=os.environ | {"PYTHONPATH": str(tmp_path)},
                stderr=subprocess.DEVNULL,
            )
        )

    package = tmp_path / "robsmooth" / "_support"  # found there instead of this one
    package.mkdir(parents=True)
    for folder in (package, package.parent):
        (folder / "__init__.py").touch()
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    started = []
    try:
        start("scheduler", "--port", str(port))
        start("worker", address, "--no-nanny", "--nthreads", "1")
        with connect(address, timeout=PATIENCE) as client:
            with pytest.raises(RuntimeError, match=r"cannot import robsmooth\._support\.cluster:"):
                list(in_order(abs, numbers(1), client))
            sleeps = "import time\ndef _compute(*_): time.sleep(0.05)"
            (package / "cluster.py").write_text(sleeps)
            some, results = (in_order(abs, repeat((1,)), client) for _ in range(2))
            next(some), next(results)
            os.kill(started[0].pid, signal.SIGSTOP)
            monkeypatch.setattr(cluster_module, "ANSWER_TIME", 0.5)
            with pytest.raises(ConnectionError, match=r"the client is running.*does not answer"):
                deque(some, maxlen=0)
            os.kill(started[0].pid, signal.SIGCONT)
            started[0].kill()
            with missing_the_scheduler():
                deque(results, maxlen=0)
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_what_is_no_client_is_refused():
    for client in ("tcp://127.0.0.1:8786", 3, distributed.Client):
        with pytest.raises(TypeError, match=r"client must be a distributed\.Client or None, got"):
            list(in_order(abs, [], client))
        with pytest.raises(TypeError, match="client must be"):
            workers(client)


def test_a_client_without_a_connection_is_refused(cluster):
    with connect(cluster.scheduler_address) as client:
        pass
    for function in (workers, lambda client: list(in_order(abs, [], client))):
        with pytest.raises(ConnectionError, match="the client is closed"):
            function(client)


def test_an_asynchronous_client_is_refused(cluster):
    async def use():
        async with distributed.Client(cluster.scheduler_address, asynchronous=True) as client:
            with pytest.raises(TypeError, match="client must be synchronous"):
                list(in_order(abs, [], client))

    asyncio.run(use())


# --- connecting -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("tcp://host", "missing port number"),
        ("tcp:/host:1", "invalid address"),
        ("tcp://host:1/path", "invalid .* '1/path'"),
        ("http://127.0.0.1:80", "unknown address scheme 'http'"),
        (" ", "missing port number"),
        (8786, "expected str, got 'int'"),
        (b"tcp://host:1", "expected str, got 'bytes'"),
    ],
)
def test_an_address_of_another_form_is_refused(address, reason):
    with pytest.raises(ConnectionError, match=f"answers at .*: {reason}"), connect(address):
        pass


def connection_error(address, timeout=0.5):
    started = time.monotonic()
    with pytest.raises(ConnectionError) as caught, connect(address, timeout=timeout):
        pass
    assert time.monotonic() - started < PATIENCE
    assert address in str(caught.value)
    return str(caught.value)


def test_a_scheduler_that_cannot_be_reached_is_an_error_in_time(listener):
    port = listener.getsockname()[1]
    assert "no Dask scheduler answers" in connection_error(f"tcp://127.0.0.1:{port}"), "mute"
    listener.close()
    assert "no Dask scheduler answers" in connection_error(f"tcp://127.0.0.1:{port}"), "refused"
    assert "TLS" in connection_error(f"tls://127.0.0.1:{port}"), "there are no certificates"


@pytest.mark.parametrize(
    "address",
    ["tcp://10.0.0.1:8786", "10.0.0.1:8786", "tcp://127.0.0.1.example:1", "ws://host:1"],
)
def test_off_the_loopback_a_scheduler_has_a_certificate_or_is_allowed(address, monkeypatch):
    def said(address, **settings):
        with pytest.raises((ConnectionError, TypeError)) as caught, connect(address, **settings):
            pass
        return str(caught.value)

    asked = []
    monkeypatch.setattr(cluster_module, "_check_scheduler", lambda *_: asked.append(1) or 1 / 0)
    assert "could run code here: give a tls:// address, or allow_insecure" in said(address)
    assert "allow_insecure must be" in said(address, allow_insecure="no")
    assert not asked, "nothing was sent"
    assert "division by zero" in said(address, allow_insecure=True)
    assert "division by zero" in said("tls://10.0.0.1:8786")


@pytest.mark.parametrize("host", ["localhost", "127.0.0.2", "[::1]"])
def test_the_loopback_needs_no_certificate(host):
    with pytest.raises(ConnectionError, match="is it running"), connect(f"tcp://{host}:1", 0.5):
        pass


def test_a_worker_is_no_scheduler(cluster):
    said = connection_error(cluster.workers[0].worker_address, PATIENCE)
    assert said.endswith("there is a Dask worker")


def test_a_notebook_can_connect_because_its_event_loop_is_left_alone(cluster):
    async def cell():
        with connect(cluster.scheduler_address) as client:
            return list(in_order(abs, numbers(2), client))

    assert asyncio.run(cell()) == [0, 1]


def test_loggers_are_set_back(cluster):
    levels = [logging.getLogger(name).level for name in cluster_module.LOGGERS]
    with connect(cluster.scheduler_address):
        assert not logging.getLogger("distributed.client").isEnabledFor(logging.ERROR)
    assert [logging.getLogger(name).level for name in cluster_module.LOGGERS] == levels


# --- sockets --------------------------------------------------------------------------------------


def test_the_clusters_of_tests_listen_on_the_loopback_alone(cluster):
    found = listening(psutil.Process())
    assert found and all(each.ip == "127.0.0.1" for each in found)


# --- in a worker ----------------------------------------------------------------------------------


def test_a_worker_knows_its_threads_and_computes_alone_where_asked(client):
    def enter(number):
        with cluster_module.ALONE, cluster_module.ALONE:
            inside.append(number)
            time.sleep(0.01)
            assert inside == [number]
            inside.clear()
        return worker_threads()

    assert worker_threads() is None
    assert list(in_order(lambda: cluster_module.worker_threads(), [()], client)) == [1]
    inside = []
    with cluster_of_threads(threads_per_worker=4) as (_, client):
        # Unpickled once, hence one list for all threads of the worker.
        assert list(in_order(enter, numbers(40), client)) == [4] * 40
