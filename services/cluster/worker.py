"""`envmatte worker`: worker processes of this machine, for a scheduler that may come and go."""

import asyncio
import logging
import multiprocessing
import socket
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

from distributed.security import Security

from services.cluster.connect import reach
from services.cluster.dask_config import NO_DASHBOARD, configure_dask
from services.cluster.forkserver import PRELOAD, START, start_forkserver
from services.cluster.nanny import Nanny
from services.runtime.addresses import is_loopback
from services.runtime.logs import configure_logging
from services.runtime.signals import run_until_signal
from services.settings import ClusterSettings, warn_of_unknown
from storage.errors import InvalidInput
from storage.outage import Outage

logger = logging.getLogger(__name__)

PAUSE = 1.0
"""Seconds between two attempts to join, and between two checks that a worker process is alive."""


def work(settings: ClusterSettings, host: str | None) -> None:
    """Work for a scheduler until SIGTERM, however often it goes away.

    Parameters
    ----------
    settings : ClusterSettings
    host : str, optional
        Address to listen on, for the scheduler and other workers. Default: the one that reaches the scheduler.

    Raises
    ------
    InvalidInput
        If no cluster is named, or it would listen beyond loopback without TLS.
    KeyboardInterrupt
        At SIGINT.
    """
    configure_logging(settings.log, settings.log_level, "nanny")
    warn_of_unknown()
    configure_dask()
    if settings.cluster is None:
        raise InvalidInput(
            "name the scheduler to work for with --cluster tls://HOST:PORT, or ENVMATTE_CLUSTER"
        )
    security = settings.security()
    if security is None and not is_loopback(host or "127.0.0.1"):
        raise InvalidInput(
            f"without TLS, anyone who reaches {host} could run arbitrary code on this machine. Name a scheduler that "
            "has TLS with --cluster tls://HOST:PORT, or listen on 127.0.0.1"
        )
    start_forkserver(PRELOAD)
    run_until_signal(_Workers(settings.cluster, security, settings, host).running())


class _Workers:
    """Nannies in this process. Each has a worker process, which it restarts when it dies."""

    def __init__(
        self, scheduler: str, security: Security | None, settings: ClusterSettings, host: str | None
    ) -> None:
        self._scheduler = scheduler
        self._security = security or Security()
        self._settings = settings
        self._host = host
        self._looking = asyncio.Lock()
        self._outage = Outage(logger)
        self._ending = False

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        with tempfile.TemporaryDirectory(prefix="envmatte-worker-", ignore_cleanup_errors=True) as scratch:
            kept = [asyncio.create_task(self._keep(scratch)) for _ in range(self._settings.workers)]
            try:
                yield
            finally:
                self._ending = True
                for task in kept:
                    task.cancel()
                await asyncio.gather(*kept, return_exceptions=True)
                for process in multiprocessing.active_children():
                    process.kill()  # a nanny that is still starting can't end its own

    async def _keep(self, scratch: str) -> None:
        """Keep one nanny running: start another when it ends, as it does when its scheduler does."""
        while not self._ending:
            await self._find_scheduler()
            try:
                await self._run_nanny(scratch)
            except Exception as error:
                if self._ending:  # closing a nanny that is starting raises in place of the cancellation
                    return
                logger.warning("a worker could not join %s: %r; trying again", self._scheduler, error)
            await asyncio.sleep(PAUSE)

    async def _find_scheduler(self) -> None:
        """Wait until the scheduler answers, for ever."""
        async with self._looking:  # one nanny at a time, so that it is logged once
            while True:
                try:
                    await reach(self._scheduler, self._security, "worker")
                except OSError as error:
                    self._outage.goes_on("waiting for the scheduler at %s: %s", self._scheduler, error)
                    await asyncio.sleep(PAUSE)
                else:
                    self._outage.is_over("the scheduler at %s answers", self._scheduler)
                    return

    async def _run_nanny(self, scratch: str) -> None:
        nanny = Nanny(
            self._scheduler,
            nthreads=1,
            # Without a host it would listen on all addresses of the machine.
            host=self._host or _address_towards(self._scheduler),
            security=self._security,
            memory_limit=self._settings.worker_memory,
            local_directory=scratch,
            preload=PRELOAD,
            death_timeout=START,
            silence_logs=logging.WARNING,
            **NO_DASHBOARD,
        )
        try:
            await nanny
            logger.info("worker %s has joined %s", nanny.worker_address, self._scheduler)
            finished = asyncio.create_task(nanny.finished())
            alive_at = time.monotonic()
            # A nanny that could not restart its process would continue without one for ever.
            while not finished.done() and time.monotonic() - alive_at < 2 * START:
                await asyncio.wait([finished], timeout=PAUSE)
                if nanny.is_alive():
                    alive_at = time.monotonic()
            logger.info("worker of %s has ended", self._scheduler)
        finally:
            await nanny.close()


def _address_towards(address: str) -> str:
    """The address of this machine that reaches another machine; nothing is sent."""
    url = urlsplit(address)
    family, kind, protocol, _, there = socket.getaddrinfo(url.hostname, url.port, type=socket.SOCK_DGRAM)[0]
    with socket.socket(family, kind, protocol) as towards:
        towards.connect(there)
        return str(towards.getsockname()[0])
