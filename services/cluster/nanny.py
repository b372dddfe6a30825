"""The process that starts a worker process, and another when it dies."""

import asyncio
import logging
from typing import Any

import distributed
from distributed.core import Status
from tornado.ioloop import PeriodicCallback

from services.cluster.forkserver import ensure_running

logger = logging.getLogger(__name__)

PAUSE = 0.5
"""Seconds between two attempts to start a worker process."""
POLL = 2.0
"""Seconds between two checks of what worker processes need."""
SERVER_DIED = (EOFError, AttributeError)
"""What distributed raises if the fork server dies after it has taken a request, or before: an `AttributeError` then
hides the `OSError`, since distributed wants to end a process that was never started."""


class Nanny(distributed.Nanny):  # type: ignore[misc]
    """A nanny that also replaces a worker whose fork server dies while it starts.

    That of distributed gives up then, and lives on without a worker. This one also starts the fork server and the
    resource tracker again if they die: multiprocessing itself does so only when it next needs them.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.periodic_callbacks["servers"] = PeriodicCallback(ensure_running, POLL * 1e3)

    async def instantiate(self) -> Status:
        """Start the worker process, or wait until it has started."""
        while True:
            try:
                ensure_running()  # multiprocessing would start one that Ctrl-C reaches
                return await super().instantiate()
            except SERVER_DIED:
                if self.status in (Status.closing, Status.closed):
                    raise
                logger.warning("the fork server died while a worker started; starting both again")
                self.process = None  # it counts as starting for ever
                await asyncio.sleep(PAUSE)
