"""Where calls are computed: here, or on a Dask cluster; the results come in the same order.

On a cluster a call may move to another worker when one dies, so a function must give the same
result wherever it runs. To that end a worker computes only with the same software as here.

Dask is an optional dependency: nothing here imports it before a cluster is asked for.
"""

import asyncio
import hashlib
import logging
import pickle
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from robsmooth._support.extras import extra

if TYPE_CHECKING:
    from distributed import Client, Future

CALLS_PER_THREAD = 2  # sent ahead: one that is computed and one that waits for it to end
CALLS_AHEAD = 2  # and some more, while results are on their way
LOOK_EVERY = 1.0  # s, how often the cluster is looked at
ANSWER_TIME = 30.0  # s, for the scheduler to answer
SCHEMES = ("tcp", "tls")
PACKAGES = ("numpy", "numba", "scipy")  # what results depend on to the last bit
LOGGERS = ("distributed", "distributed.client", "tornado.application")

_ALONE = threading.RLock()


def in_order(
    function: Callable,
    calls: Iterable[tuple],
    client: "Client | None" = None,
    *,
    timeout: float = 30.0,
) -> Iterator[Any]:
    """Yield ``function(*call)`` for each call, in the order of the calls.

    Closing the iterator early, as an error or Ctrl-C in the loop over it does, drops the calls that
    are on their way.

    Parameters
    ----------
    function : callable
        Sent along with each call: it should pickle to less than about 100 kB.
    calls : iterable of tuple
        Arguments; taken as they are needed, a few calls ahead of the results.
    client : distributed.Client, optional
        The cluster that computes. Default: computed here, one after another.
    timeout : float
        How long the cluster may be without a worker, s.

    Raises
    ------
    ConnectionError
        Where there is no worker, or the scheduler is lost.
    RuntimeError
        For a worker with other software, or where a call ended several workers.
    Exception
        Whatever the function raises, as itself.
    """
    _check_client(client)
    if client is None:
        return (function(*call) for call in calls)
    return _on_cluster(function, calls, client, timeout)


def workers(client: "Client | None", *, timeout: float = 30.0) -> int:
    """Number of threads that the workers have for calls; 1 for None, where calls come one by one.

    Parameters
    ----------
    client : distributed.Client, optional
    timeout : float
        How long to wait for the first worker, s.

    Raises
    ------
    ConnectionError
        Where no worker joins within `timeout` seconds, or the scheduler is lost.
    """
    _check_client(client)
    if client is None:
        return 1
    deadline = time.monotonic() + timeout
    while not (threads := _threads(client)):
        if time.monotonic() >= deadline:
            raise _no_worker(client, timeout)
        time.sleep(min(0.1, timeout))
    return threads


@contextmanager
def connect(address: str, timeout: float = 5.0) -> "Iterator[Client | None]":
    """Connect to the scheduler at an address; with the empty address, give None.

    What Dask logs on the side is silenced meanwhile: what matters comes as an exception.

    Parameters
    ----------
    address : str
        "", or as in ``tcp://host:port``.
    timeout : float
        s.

    Raises
    ------
    ValueError
        For an address of another form.
    ImportError
        Where Dask is not installed.
    ConnectionError
        Where no scheduler answers in time.
    """
    if address == "":
        yield None
        return
    _check_address(address)
    with extra("cluster", "a cluster"):
        import distributed
    with _quiet():
        _check_scheduler(address, timeout)
        try:
            client = distributed.Client(address, timeout=timeout, set_as_default=False)
        except OSError as error:
            raise _no_scheduler(address, timeout, error) from None
        with client:
            yield client


def alone() -> AbstractContextManager:
    """Keep other threads of this process out of a block.

    numba's thread pool, where it is of the kind "workqueue", ends the process when two threads
    enter it at once, as the threads of a worker may.
    """
    return _ALONE


def worker_threads() -> int | None:
    """Number of threads that this process has as a worker of a cluster; None where it is none."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return distributed.get_worker().state.nthreads
    except ValueError:
        return None


@cache
def software() -> dict[str, str]:
    """Versions of what a result depends on, with a digest of this package's sources."""
    versions = {"python": f"{sys.version_info.major}.{sys.version_info.minor}"}
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return {**versions, "robsmooth": sources_version()}


def sources_version() -> str:
    """SHA-256 of this package's Python sources as they were imported, in hexadecimal digits."""
    return _SOURCES


def _digest_sources(package: Path) -> str:
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(package).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


# Of now, and not of when it is asked for: by then the files may have been edited.
_SOURCES = _digest_sources(Path(__file__).resolve().parents[1])


# --- on a worker ----------------------------------------------------------------------------------


class _Call:
    """A call that is computed by unpickling it.

    Thus scheduler and worker are sent nothing but ``pickle.loads`` and bytes, which any of them
    understands, and it is robsmooth that says what is wrong with the software of a worker.
    """

    def __init__(self, *parts: object):
        self.parts = parts

    def __reduce__(self):
        return _compute, self.parts


def _compute(wanted: dict[str, str], function: bytes, arguments: bytes) -> Any:
    _check_software(wanted)
    return _loads(function)(*pickle.loads(arguments))


_loads = lru_cache(maxsize=1)(pickle.loads)  # a function comes with each of its calls


def _check_software(wanted: dict[str, str]) -> None:
    here = software()
    if here != wanted:
        differences = ", ".join(
            f"{name} {here.get(name, 'absent')[:12]} and not {wanted.get(name, 'absent')[:12]}"
            for name in sorted(here | wanted)
            if here.get(name) != wanted.get(name)
        )
        raise RuntimeError(
            f"a worker has other software than the client: {differences}; the results would "
            "differ: start the workers in the same environment, and anew after each change of it"
        )


# --- on the client --------------------------------------------------------------------------------


class _Cluster:
    """A client's cluster, of which the number of threads is kept up to date."""

    def __init__(self, client: "Client", timeout: float):
        self.client = client
        self.timeout = timeout
        self.threads = workers(client, timeout=timeout)
        self.looked = time.monotonic()
        self.missed: float | None = None  # since when there is no worker

    def look(self) -> None:
        """Raise where the scheduler is lost, or there has been no worker for too long."""
        _check_running(self.client)
        now = time.monotonic()
        if now < self.looked + LOOK_EVERY:
            return
        self.looked = now
        self.threads = _threads(self.client)
        if self.threads:
            self.missed = None
        elif self.missed is None:
            self.missed = now
        elif now > self.missed + self.timeout:
            raise _no_worker(self.client, self.timeout)

    @property
    def room(self) -> int:
        """Number of calls that may be on their way."""
        return CALLS_PER_THREAD * self.threads + CALLS_AHEAD


def _on_cluster(
    function: Callable, calls: Iterable[tuple], client: "Client", timeout: float
) -> Iterator[Any]:
    import cloudpickle

    shipped = cloudpickle.dumps(function)
    cluster = _Cluster(client, timeout)
    pending: deque[Future] = deque()
    try:
        for index, call in enumerate(calls):
            while len(pending) >= cluster.room:
                yield _result(cluster, pending.popleft())
            cluster.look()
            pending.append(
                client.submit(
                    pickle.loads,
                    pickle.dumps(_Call(software(), shipped, cloudpickle.dumps(call))),
                    key=f"robsmooth-{uuid.uuid4()}",
                    priority=-index,
                )
            )
        while pending:
            yield _result(cluster, pending.popleft())
    finally:
        for future in pending:
            _release(future)


def _result(cluster: _Cluster, future: "Future") -> Any:
    """Wait for a call, and take its result off the cluster."""
    patience = LOOK_EVERY  # with a result's transfer: it may be large, or lost with its worker
    try:
        while True:
            cluster.look()
            with suppress(TimeoutError):
                future.exception(timeout=LOOK_EVERY)  # waits for the end, and fetches no result
            if future.status == "finished":
                try:
                    return future.result(timeout=patience)
                except TimeoutError:
                    patience *= 2
                except (OSError, CancelledError) as error:
                    if future.status != "error":
                        raise _lost(cluster.client) from error
            if future.status == "error":
                _raise_error(future)
            if future.status == "cancelled":
                raise _lost(cluster.client)
    finally:
        _release(future)


def _raise_error(future: "Future") -> None:
    """Raise what a call has raised, or what ended it."""
    from distributed import KilledWorker

    try:
        future.result()
    except KilledWorker as error:
        raise RuntimeError(
            f"the same call was on {error.allowed_failures + 1} worker(s) that ended: it may need "
            "more memory than they have"
        ) from None
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "robsmooth":
            raise
        raise RuntimeError(
            f"a worker cannot import {error.name}: start the workers in an environment with the "
            "same robsmooth as here"
        ) from None


def _release(future: "Future") -> None:
    """Let the cluster forget a call, and drop it where it is not computed yet."""
    with suppress(Exception):  # there may be no connection any more
        future.release()


def _threads(client: "Client") -> int:
    """Number of threads that the cluster has now."""
    _check_running(client)
    try:
        return sum(client.nthreads(callback_timeout=ANSWER_TIME).values())
    except Exception as error:
        raise _lost(client) from error


# --- checks ---------------------------------------------------------------------------------------


def _check_client(client: "Client | None") -> None:
    if client is None:
        return
    distributed = sys.modules.get("distributed")
    if distributed is None or not isinstance(client, distributed.Client):
        raise TypeError(f"client must be a distributed.Client or None, got {client!r}")
    if client.asynchronous:
        raise TypeError("client must be synchronous: make it without asynchronous=True")
    _check_running(client)


def _check_running(client: "Client") -> None:
    if client.status != "running":
        raise _lost(client)


def _check_address(address: str) -> None:
    try:
        parts = urlsplit(address)
        valid = bool(parts.hostname and parts.port) and address in (
            f"{scheme}://{parts.netloc}" for scheme in SCHEMES
        )
    except (AttributeError, TypeError, ValueError):
        valid = False
    if not valid:
        allowed = " or ".join(f"{scheme}://host:port" for scheme in SCHEMES)
        raise ValueError(f"the address of a scheduler must be {allowed}, got {address!r}")


def _check_scheduler(address: str, timeout: float) -> None:
    """Check that a scheduler answers: a client waits for ever for a peer that says nothing."""
    from distributed.core import rpc
    from distributed.security import Security

    async def identity() -> dict:
        security = Security().get_connection_args("client")
        async with rpc(address, timeout=timeout, connection_args=security) as scheduler:
            return await scheduler.identity()

    async def identity_in_time() -> dict:
        return await asyncio.wait_for(identity(), timeout)

    try:
        with ThreadPoolExecutor(1) as thread:  # a notebook's own runs an event loop already
            kind = thread.submit(asyncio.run, identity_in_time()).result()["type"]
    except Exception as error:
        raise _no_scheduler(address, timeout, error) from None
    if kind != "Scheduler":
        raise ConnectionError(f"at {address} is a Dask {kind.lower()}, not a scheduler")


def _no_scheduler(address: str, timeout: float, error: Exception) -> ConnectionError:
    reason = "is it running?" if isinstance(error, OSError) else str(error)
    return ConnectionError(f"no Dask scheduler answers at {address} within {timeout:g} s: {reason}")


def _no_worker(client: "Client", timeout: float) -> ConnectionError:
    address = client.scheduler.address
    return ConnectionError(
        f"no worker has joined the scheduler at {address} for {timeout:g} s: start some there, "
        f"as with `dask worker {address}`"
    )


def _lost(client: "Client") -> ConnectionError:
    if client.status == "running":
        return ConnectionError("the cluster has dropped a call: it may have been restarted")
    return ConnectionError(
        f"there is no connection to the Dask scheduler (the client is {client.status}): it ended, "
        "or the client was closed"
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's loggers, and set them back."""
    before = {name: logging.getLogger(name).level for name in LOGGERS}
    for name in LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)
