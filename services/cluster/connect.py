"""The dask cluster that does the work: processes of this machine, or a scheduler somewhere else."""

import asyncio
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import cache, partial
from multiprocessing import forkserver
from typing import Any

import dask
from distributed import Client, LocalCluster, Scheduler
from distributed.comm import connect as open_comm
from distributed.scheduler import DEFAULT_EXTENSIONS
from distributed.security import Security
from distributed.utils import get_mp_context
from tornado.ioloop import IOLoop

from services.cluster.dispatcher import Dispatcher
from services.settings import Settings
from storage.errors import Unavailable

PATIENCE = 5
"""Seconds that a scheduler may take to answer a new client."""
START = 60
"""Seconds that a worker may take to start on a busy machine."""
PRELOAD = "services.cluster.worker_preload"
"""What a worker imports before it takes work."""
DECODING = "services.decoding.pool"
"""What a decoder of the API does."""
IDLE = 300.0
"""Seconds without a job after which all workers but one are let go: they hold 70 MB each, and more while they work."""

CONFIG: dict[str, Any] = {
    # A tile of an innocent job must not be blamed for the workers that died with it: the ledger counts its misses.
    "distributed.scheduler.allowed-failures": 0,
    # A worker whose machine is gone without a word has gone after this long, and its tiles are given to others.
    "distributed.scheduler.worker-ttl": "30 s",
    # A nanny starts its worker again however long that takes; the embedded cluster would close it for good meanwhile.
    "distributed.deploy.lost-worker-timeout": "365 days",
    # Results are numbers: there is nothing to spill. A worker that is short of memory is no better off for a pause,
    # in which it would hold the tiles it was given for ever; it is ended and started again.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.worker.multiprocessing-method": "forkserver",
    # The last messages of every connection and the last bursts of tasks, which nobody looks at; a thousand by default.
    "distributed.admin.low-level-log-length": 100,
    "distributed.diagnostics.computations.max-history": 10,
    # Stacks by the hundredth of a second, which nobody looks at either, and how late the event loop is by the fiftieth:
    # two thirds of what a service takes while it has nothing to do.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1 s",
    "distributed.admin.system-monitor.interval": "2 s",
    "distributed.comm.timeouts.connect": "10 s",
    "distributed.comm.timeouts.tcp": "15 s",
    # Every scheduler and worker has an HTTP server, which can't be left out and knows no TLS: it serves nothing, and
    # listens on loopback alone, see `NO_DASHBOARD`.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
NO_DASHBOARD: dict[str, Any] = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
"""For whoever starts a scheduler or a worker."""


class _NoSpans:
    """In place of the scheduler's extension for spans, which has a record of every burst of tasks, for ever.

    Workers too count by the span, and so by one alone then.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        pass

    def observe_tasks(self, *tasks: object, **about: object) -> dict[str, Any]:
        """Put tasks into no span: no annotation of theirs changes."""
        return {}

    def heartbeat(self, worker: object, data: object) -> None:
        """Leave what a worker has counted uncounted."""


SCHEDULER: dict[str, Any] = NO_DASHBOARD | {"extensions": DEFAULT_EXTENSIONS | {"spans": _NoSpans}}
"""For whoever starts a scheduler."""

dask.config.set(
    CONFIG
)  # here, and so before any of them is made in whatever process; nannies hand it on to workers


def share_start(*modules: str) -> None:
    """Have the children of this process, workers and decoders, forked from one that has imported what they need.

    Importing it takes each worker two seconds of its own otherwise, and memory.
    """
    for name, value in dask.config.get("distributed.nanny.pre-spawn-environ").items():
        os.environ[name] = str(value)  # as nannies do, but before libraries that read it are loaded
    get_mp_context().set_forkserver_preload([*modules])  # after distributed has set what it prefers
    forkserver.ensure_running()


@contextmanager
def embedded(settings: Settings) -> Iterator[LocalCluster]:
    """Start a scheduler and worker processes on loopback, and end them at the end."""
    share_start(PRELOAD)
    with LocalCluster(
        n_workers=settings.workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        scheduler_kwargs=SCHEDULER,
        local_directory=str(settings.data.resolve() / "scratch"),
        memory_limit=settings.worker_memory,
        silence_logs=30,
        death_timeout=f"{START} s",
        preload=PRELOAD,
    ) as cluster:
        yield cluster


async def reach(address: str, security: Security | None, role: str = "client") -> None:
    """See that a scheduler answers.

    Raises
    ------
    OSError
        If none does within some seconds; dask alone would wait for ever for one that takes a connection and is silent.
    """
    args = (security or Security()).get_connection_args(role)
    comm = await asyncio.wait_for(open_comm(address, timeout=PATIENCE, **args), PATIENCE + 1)
    comm.abort()


def connect(address: str, security: Security | None) -> Client:
    """A client of a scheduler that runs.

    Parameters
    ----------
    address : str
        ``tls://HOST:PORT``, or ``tcp://HOST:PORT`` without TLS.
    security : distributed.security.Security or None
        As `services.runtime.certificates.security_of` makes it, for TLS.

    Returns
    -------
    distributed.Client
        Synchronous; may be used from any thread.

    Raises
    ------
    Unavailable
        If no scheduler answers within some seconds, or not to these certificates.
    """
    try:
        asyncio.run(reach(address, security))
        return Client(address, security=security, timeout=PATIENCE, set_as_default=False, loop=_loop())
    except OSError as error:  # a time-out too
        raise Unavailable(
            f"no scheduler answers at {address}: see that `envmatte scheduler` runs there, can be reached from here "
            "and has the same certificates"
        ) from error


@cache
def _loop() -> IOLoop:
    """The loop of all clients, in a thread: a client that nobody answered would leave one of its own running."""
    running: Future[IOLoop] = Future()

    async def run() -> None:
        running.set_result(IOLoop.current())
        await asyncio.Event().wait()

    threading.Thread(target=asyncio.run, args=(run(),), name="clients", daemon=True).start()
    return running.result()


@contextmanager
def dispatcher_of(settings: Settings) -> Iterator[Dispatcher]:
    """What hands tiles to the cluster that the settings name, reached or not yet, or to one of its own."""
    if settings.cluster:
        with Dispatcher(
            partial(connect, settings.cluster, settings.security()), settings.store_url
        ) as dispatcher:
            yield dispatcher
    else:
        with (
            embedded(settings) as cluster,
            Dispatcher(
                partial(Client, cluster, set_as_default=False),
                settings.store_url,
                Scale(cluster.scale, settings.workers),
            ) as dispatcher,
        ):
            yield dispatcher


class Scale:
    """How many workers a cluster of this machine has: as many as are of use, and one while there is nothing to do.

    Parameters
    ----------
    scale : callable
        Told the number of workers, whenever another one is wanted.
    most : int
        The largest number, and how many there are to begin with.
    """

    def __init__(self, scale: Callable[[int], None], most: int) -> None:
        self._scale = scale
        self._most = self._now = most
        self._busy_at = time.monotonic()

    def __call__(self, tiles: int) -> None:
        """Say how many tiles there are to do."""
        if tiles:
            self._busy_at = time.monotonic()
            number = min(max(tiles, self._now), self._most)
        else:
            number = self._now if time.monotonic() - self._busy_at < IDLE else 1
        if number != self._now:
            self._now = number
            self._scale(number)
