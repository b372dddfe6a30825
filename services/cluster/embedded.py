"""A cluster of this machine's own processes, with as many workers as are of use."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from distributed import LocalCluster

from services.cluster.dask_config import SCHEDULER
from services.cluster.forkserver import PRELOAD, START, start_forkserver
from services.cluster.nanny import Nanny
from services.runtime import certificates
from services.runtime.signals import held_signals
from services.settings import CoordinatorSettings

IDLE = 300.0
"""Seconds without a job after which all workers but one stop. A worker holds 70 MB, and more while it works."""


@contextmanager
def embedded(settings: CoordinatorSettings) -> Iterator[LocalCluster]:
    """Start a scheduler and worker processes on loopback, and stop them on exit.

    Any program that could talk to them could run code as this user. So they take no connection without a certificate
    that only they have: other users of the machine can't join.
    """
    start_forkserver(PRELOAD)
    with ExitStack() as stack:
        with held_signals():
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=settings.workers,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    protocol="tls://",
                    security=certificates.new_security(),
                    dashboard_address=None,
                    scheduler_kwargs=SCHEDULER,
                    local_directory=str(settings.data.resolve() / "scratch"),
                    memory_limit=settings.worker_memory,
                    silence_logs=30,
                    death_timeout=f"{START} s",
                    preload=PRELOAD,
                    worker_class=Nanny,
                )
            )
        yield cluster


class Scale:
    """Starts and stops workers of the embedded cluster: as many as are of use, and one after idle minutes.

    Parameters
    ----------
    scale : callable
        Is called with the number of workers when it should change.
    most : int
        The largest number, and the number at the start.
    """

    def __init__(self, scale: Callable[[int], None], most: int) -> None:
        self._scale = scale
        self._most = self._now = most
        self._busy_at = time.monotonic()

    def __call__(self, tiles: int) -> None:
        """Adapt to the number of tiles that there are to do."""
        if tiles:
            self._busy_at = time.monotonic()
            number = min(max(tiles, self._now), self._most)
        else:
            number = self._now if time.monotonic() - self._busy_at < IDLE else 1
        if number != self._now:
            self._now = number
            self._scale(number)
