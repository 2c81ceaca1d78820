"""Calls computed here or on a Dask cluster, with the results in order.

When a worker ends, Dask repeats its calls on another. A worker refuses calls from other software:
Dask only warns of other versions, of its own packages. Dask is optional, and imported when needed.
"""

import asyncio
import hashlib
import ipaddress
import itertools
import logging
import pickle
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robsmooth._support import validation
from robsmooth._support.extras import extra

if TYPE_CHECKING:
    from distributed import Client as Client
    from distributed import Future

CALLS_PER_THREAD = 2  # one is computed, one waits
CALLS_AHEAD = 2  # more, while results travel
LOOK_EVERY = 1.0  # s, between counts of threads: a scheduler that closes may not answer a call
ANSWER_TIME = 30.0  # s, for the scheduler to answer, and between questions during a call
QUESTION_TIME = 5.0  # s, after which it is seen whether there is a scheduler still
JOIN_TIME = 30.0  # s, for the first worker to join
PACKAGES = ("numpy", "numba", "scipy")  # on which the last bits of results depend
LOGGERS = ("distributed", "distributed.client", "tornado.application")
# Numba's thread pool "workqueue" ends the process when two threads enter it at once.
ALONE = threading.RLock()


def in_order(
    function: Callable, calls: Iterable[tuple], client: "Client | None" = None
) -> Iterator[Any]:
    """Yield ``function(*call)`` for each call, in order, or raise its error.

    The function, of less than about 100 kB, is sent with each call. Only as many calls are sent as
    keep all threads at work; closing the iterator drops them. ConnectionError: no worker or no
    scheduler. RuntimeError: a worker has other software, or a call ended workers.
    """
    if client is None:
        yield from itertools.starmap(function, calls)
        return
    _check_client(client)
    import cloudpickle

    shipped, numbered = cloudpickle.dumps(function), enumerate(calls)
    pending: deque[Future] = deque()
    look_at = 0.0
    try:
        while True:
            if time.monotonic() >= look_at:
                threads, look_at = workers(client), time.monotonic() + LOOK_EVERY
            room = CALLS_PER_THREAD * threads + CALLS_AHEAD - len(pending)
            for index, call in itertools.islice(numbered, max(room, 0)):
                task = pickle.dumps(_Call((software(), shipped, cloudpickle.dumps(call))))
                pending.append(client.submit(pickle.loads, task, pure=False, priority=-index))
            if not pending:
                return
            for result in _result(pending[0], client):
                pending.popleft()
                yield result
    finally:
        for future in pending:  # an error's traceback would keep them
            with suppress(RuntimeError):  # no connection
                future.release()


def workers(client: "Client") -> int:
    """Return the number of the workers' threads; wait for the first worker."""
    _check_client(client)
    asked = time.monotonic()
    while True:
        try:
            threads = sum(client.nthreads(callback_timeout=QUESTION_TIME).values())
        except Exception as error:
            late = not isinstance(error, TimeoutError) or time.monotonic() >= asked + ANSWER_TIME
            if late or client.status != "running":
                raise _lost(client) from error
            continue
        if threads:
            return threads
        if time.monotonic() >= asked + JOIN_TIME:
            address = client.scheduler.address
            none = f"no worker has joined the scheduler at {address} for {JOIN_TIME:g} s"
            raise ConnectionError(f"{none}: start one, as with `dask worker {address}`")
        time.sleep(0.1)


@contextmanager
def connect(
    address: str, timeout: float = 5.0, *, allow_insecure: bool = False
) -> "Iterator[Client | None]":
    """Connect to the scheduler at an address; the empty address gives None.

    What answers can run code here. So off the loopback the address must be ``tls://host:port``, or
    `allow_insecure` True, where the network is trusted. Else, or without answer: ConnectionError.
    """
    allow_insecure = validation.boolean("allow_insecure", allow_insecure)
    if address == "":
        yield None
        return
    with extra("cluster", "a cluster"):
        from distributed import Client
    with ExitStack() as stack:
        for logger in map(logging.getLogger, LOGGERS):  # errors come as exceptions
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        try:
            if allowed := allow_insecure or _is_safe(address):
                _check_scheduler(address, timeout)
                client = Client(address, timeout=timeout, set_as_default=False)
        except Exception as error:
            reason = "is it running?" if isinstance(error, OSError) else str(error)
            message = f"no Dask scheduler answers at {address} within {timeout:g} s: {reason}"
            raise ConnectionError(message) from None
        if not allowed:
            advice = "give a tls:// address, or allow_insecure where you trust the network"
            raise ConnectionError(f"what answers at {address} could run code here: {advice}")
        yield stack.enter_context(client)


def worker_threads() -> int | None:
    """Return the number of threads of this process as a worker of a cluster, or None."""
    with suppress(AttributeError, ValueError):  # Dask is not imported, or this is no worker
        return sys.modules.get("distributed").get_worker().state.nthreads
    return None


@cache
def software() -> dict[str, str]:
    """Return the versions on which results depend, and the SHA-256 of this package's sources."""
    versions = {"python": f"{sys.version_info.major}.{sys.version_info.minor}"}
    versions |= {name: metadata.version(name) for name in PACKAGES}
    return {**versions, "robsmooth": _SOURCES}


def _digest_sources(package: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


# At import: later the files may have been edited.
_SOURCES = _digest_sources(Path(__file__).resolve().parent.parent)


class _Call(tuple):
    """A call that unpickling computes, so that a worker needs only ``pickle.loads`` and bytes."""

    def __reduce__(self):
        return _compute, tuple(self)


def _compute(wanted: dict[str, str], function: bytes, arguments: bytes) -> Any:
    """Check the worker's software and do a call."""
    if found := validation.differences("{} {} and not {}", software(), wanted):
        differences = ", ".join(found)
        advice = "start the workers in the same environment, and again after each change of it"
        raise RuntimeError(f"a worker has other software than the client: {differences}; {advice}")
    return _loads(function)(*pickle.loads(arguments))


_loads = lru_cache(maxsize=1)(pickle.loads)  # a function comes with each of its calls


def _result(future: "Future", client: "Client") -> list[Any]:
    """Wait for a result; return none while its call goes on or is repeated elsewhere."""
    from distributed import KilledWorker

    try:
        return [future.result(timeout=ANSWER_TIME)]
    except KilledWorker as error:
        ended = f"the same call was on {error.allowed_failures + 1} worker(s) that ended"
        raise RuntimeError(f"{ended}: it may need more memory than they have") from None
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "robsmooth":
            raise
        advice = "start the workers in an environment with the same robsmooth as here"
        raise RuntimeError(f"a worker cannot import {error.name}: {advice}") from None
    except (OSError, CancelledError) as error:
        if future.status == "error":  # the function's own
            raise
        if isinstance(error, TimeoutError) and client.status == "running":
            return []  # the scheduler repeats a lost call
        raise _lost(client) from error


def _check_client(client: "Client") -> None:
    distributed = sys.modules.get("distributed")
    if distributed is None or not isinstance(client, distributed.Client):
        given = validation.shown(client)
        raise TypeError(f"client must be a distributed.Client or None, got {given}")
    if client.asynchronous:
        raise TypeError("client must be synchronous: make it without asynchronous=True")
    if client.status != "running":
        raise _lost(client)


def _lost(client: "Client") -> ConnectionError:
    why = "it ended, does not answer or was restarted, or the client was closed"
    lost = f"there is no connection to the Dask scheduler (the client is {client.status})"
    return ConnectionError(f"{lost}: {why}")


def _is_safe(address: str) -> bool:
    """Say whether what answers at an address has a certificate, or is of this machine."""
    from distributed.comm.addressing import parse_address, parse_host_port

    scheme, location = parse_address(address)
    if scheme in ("tls", "wss", "inproc"):
        return True
    host, _ = parse_host_port(location)
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def _check_scheduler(address: str, timeout: float) -> None:
    """Ask what is at an address; a client would wait for ever if nothing answers."""
    from distributed.core import rpc
    from distributed.security import Security

    async def ask() -> None:
        security = Security().get_connection_args("client")
        server = rpc(address, timeout=timeout, connection_args=security)
        async with asyncio.timeout(timeout), server:
            if (kind := (await server.identity())["type"]) != "Scheduler":
                raise ValueError(f"there is a Dask {kind.lower()}")

    with ThreadPoolExecutor(1) as thread:  # a notebook's own has an event loop already
        thread.submit(asyncio.run, ask()).result()
