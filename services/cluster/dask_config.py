"""How dask is configured in every process of a cluster, and the arguments of its schedulers and workers."""

import time
from typing import Any

import dask
from distributed import Scheduler, batched
from distributed.scheduler import DEFAULT_EXTENSIONS
from tornado.ioloop import IOLoop

CONFIG: dict[str, Any] = {
    # A tile of an innocent job must not be blamed for the workers that died with it: the ledger counts its losses.
    "distributed.scheduler.allowed-failures": 0,
    # After this long without a sign of life a worker is given up, and its tiles go to others.
    "distributed.scheduler.worker-ttl": "30 s",
    # A nanny restarts its worker however long that takes; the embedded cluster would close it for good meanwhile.
    "distributed.deploy.lost-worker-timeout": "365 days",
    # Results are numbers: there is nothing to spill. A pause would not help a worker that is short of memory, and it
    # would keep the tiles that it was given for ever; it is ended and restarted instead.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    # Nor are there copies of results to balance between workers.
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.worker.multiprocessing-method": "forkserver",
    # The last messages of every connection and the last bursts of tasks, which nothing reads; a thousand by default.
    "distributed.admin.low-level-log-length": 100,
    "distributed.diagnostics.computations.max-history": 10,
    # Stacks sampled every 10 ms, which nothing reads either, and the lag of the event loop measured every 20 ms: two
    # thirds of what an idle service takes.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1 s",
    "distributed.admin.system-monitor.interval": "2 s",
    "distributed.comm.timeouts.connect": "10 s",
    "distributed.comm.timeouts.tcp": "15 s",
    # Every scheduler and worker has an HTTP server, which can't be turned off and has no TLS: it serves nothing, and
    # listens on loopback only, see `NO_DASHBOARD`.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
NO_DASHBOARD: dict[str, Any] = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
"""Arguments of every scheduler and worker."""


class _NoSpans:
    """In place of the scheduler's extension for spans, which keeps a record of every burst of tasks for ever.

    Workers count by span too, and so by a single one.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        pass

    def observe_tasks(self, *tasks: object, **about: object) -> dict[str, Any]:
        """Put tasks into no span, and change none of their annotations."""
        return {}

    def heartbeat(self, worker: object, data: object) -> None:
        """Ignore what a worker has counted."""


_EXTENSIONS = {name: one for name, one in DEFAULT_EXTENSIONS.items() if name != "stealing"} | {
    "spans": _NoSpans
}
SCHEDULER: dict[str, Any] = NO_DASHBOARD | {"extensions": _EXTENSIONS}
"""Arguments of every scheduler. No worker has a tile that waits, which another could steal."""


def configure_dask() -> None:
    """Configure dask in this process, before it has a client, a scheduler or a nanny; nannies pass it on to workers."""
    dask.config.set(CONFIG)
    use_steady_clock()


def use_steady_clock() -> None:
    """Let the event loops of this process wait by elapsed time.

    They wait until a time of day otherwise: after a clock that goes back by an hour, messages and heartbeats would stop
    for that long.
    """
    IOLoop.time = lambda loop: time.monotonic()  # type: ignore[method-assign, assignment]
    batched.time = time.monotonic  # its deadlines are for the loop
