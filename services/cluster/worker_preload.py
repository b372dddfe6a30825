"""What dask runs in every worker process at its start: `distributed` calls `dask_setup`.

A task can't be stopped, and one that nobody wants any more (its job was cancelled, its coordinator or its scheduler is
gone) may run on for long, and write what nobody will remove. So its process ends with it, and the nanny starts another.
"""

import logging
import os
import time
from contextlib import nullcontext

from distributed import Worker
from distributed.core import Status
from tornado.ioloop import PeriodicCallback

# All steps, because importing their kernels takes seconds: the first task of a worker must not wait for it.
import workflows.composite.video.steps
import workflows.ingest.steps
import workflows.mattes.steps  # noqa: F401
from services.cluster.task import read_key
from services.runtime import tracing
from services.runtime.logs import about, configure_worker_logging
from services.runtime.malloc import limit_arenas

logger = logging.getLogger(__name__)

LOOK = 0.2
"""Seconds between two looks at what runs."""
PATIENCE = 0.5
"""Seconds that a task may run on after it was cancelled."""
NICE = 10
"""Of workers: a job takes a while anyway, and who asks for a composite beside it, or uses the machine, won't wait."""


def dask_setup(worker: Worker) -> None:
    """Log and trace, and watch for tasks that nobody wants any more while they run."""
    os.nice(NICE)  # of this thread, and those that it starts
    limit_arenas()
    configure_worker_logging()
    tracing.start("worker")
    since: dict[str, float] = {}

    def look() -> None:
        now = time.monotonic()
        ending = worker.status in (Status.closing, Status.closed)
        strays = {task.key for task in worker.state.executing if ending or task.state == "cancelled"}
        for key in since.keys() - strays:
            del since[key]
        for key in strays:
            if now - since.setdefault(key, now) > PATIENCE:
                found = read_key(key)
                with about(*found) if found else nullcontext():
                    logger.info("nobody wants it any more, and it runs on: ending this process")
                os._exit(1)

    # Not one of the worker's own, which stop as soon as it begins to close.
    PeriodicCallback(look, 1000 * LOOK).start()
