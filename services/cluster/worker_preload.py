"""The start of every worker process: `distributed` imports this module and calls `dask_setup`.

dask can't stop a running task. One that is no longer wanted, because its job was cancelled or its coordinator or
scheduler is gone, could run for long and write files that are never removed. So the worker process ends itself, and its
nanny starts another.
"""

import asyncio
import gc
import logging
import os
import time
from contextlib import nullcontext, suppress

from distributed import Worker
from distributed.core import Status
from tornado.ioloop import PeriodicCallback

from services.cluster.dask_config import use_steady_clock
from services.cluster.task import read_key
from services.runtime import tracing
from services.runtime.logs import about, configure_worker_logging
from services.runtime.memory import keep_memory, limit_arenas, no_collections
from workflows.untrusted import confinement

# All steps: importing their kernels takes seconds, and the first task of a worker must not wait for it.
with no_collections():
    import workflows.composite.video.steps
    import workflows.ingest.steps
    import workflows.mattes.steps  # noqa: F401

logger = logging.getLogger(__name__)

POLL = 0.2
"""Seconds between two checks of what runs."""
PATIENCE = 0.5
"""Seconds that a task may continue after it was cancelled."""
ANSWER = 0.5
"""Seconds that the scheduler has to answer."""
ENDING = (Status.closing, Status.closed)
"""States of a worker that is stopped."""
NICE = 10
"""Niceness of workers: a job takes minutes, while composites and other users of the machine should not wait."""


def dask_setup(worker: Worker) -> None:
    """Configure this worker process, and end it when a task runs that is no longer wanted."""
    gc.freeze()  # a collection would touch, and so copy, all that it shares with the fork server
    use_steady_clock()  # before the worker's callbacks start
    os.nice(NICE)  # of this thread and the ones it starts
    limit_arenas()
    keep_memory()
    configure_worker_logging()

    def is_news(record: logging.LogRecord) -> bool:
        # `services.cluster.task` has logged what a task raised, and a worker that is stopped loses what it had.
        return "Compute Failed" not in str(record.msg) and worker.status not in ENDING

    for name in ("distributed.worker", "distributed.worker.state_machine"):
        logging.getLogger(name).addFilter(is_news)
    tracing.start("worker")
    lacking = confinement.missing()
    worker.metrics["unconfined_decoders"] = lambda _: lacking  # sent with every heartbeat
    if lacking:
        logger.warning("%s", lacking)
    # Not one of the worker's own callbacks, which stop when it begins to close.
    PeriodicCallback(_Strays(worker).look, 1000 * POLL).start()


class _Strays:
    """Tasks that run in a worker although they are no longer wanted, and since when."""

    def __init__(self, worker: Worker) -> None:
        self._worker = worker
        self._since: dict[str, float] = {}

    async def look(self) -> None:
        """Look for them, and end this process if one has run for too long."""
        worker, now = self._worker, time.monotonic()
        ending = worker.status in ENDING
        strays = {task.key for task in worker.state.executing if ending or task.state == "cancelled"}
        self._since = {key: self._since.get(key, now) for key in strays}
        for key, since in self._since.items():
            if now - since > PATIENCE:
                found = read_key(key)
                with about(*found) if found else nullcontext():
                    logger.info("ending this process: its task was cancelled and still runs")
                if not ending:
                    await _leave(worker)
                os._exit(1)


async def dask_teardown(worker: Worker) -> None:
    """Give back the task of a worker that is stopped: otherwise it would count as one that killed its worker."""
    await _leave(worker)


async def _leave(worker: Worker) -> None:
    """Take a worker off its scheduler, which gives the tasks that it has to others and blames none of them.

    A task of another job may have come since: for the scheduler a thread is free as soon as its task is cancelled.
    """
    leaving = worker.scheduler.unregister(
        address=worker.address, expected=True, close=False, stimulus_id="worker-leaves"
    )
    with suppress(OSError, TimeoutError):  # it ends all the same
        await asyncio.wait_for(leaving, ANSWER)
