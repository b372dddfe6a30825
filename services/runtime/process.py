"""What the processes of a cluster have in common: how they log, and how they end."""

import asyncio
import ctypes
import fcntl
import logging
import signal
from collections.abc import Iterator
from contextlib import AbstractAsyncContextManager, contextmanager, suppress
from pathlib import Path

from storage.errors import Conflict

logger = logging.getLogger(__name__)

ARENAS = 2
"""Pools of memory that the threads of a process share."""
M_ARENA_MAX = -8
"""Of mallopt(3)."""


@contextmanager
def sole_user(data: Path) -> Iterator[None]:
    """Hold a data folder's lock: two services on one folder would drive the same jobs.

    Raises
    ------
    Conflict
        If another holds it.
    """
    with (data / "lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise Conflict(
                f"another envmatte serves {data} already; use it, stop it, or name another folder with --data"
            ) from error
        yield


def share_memory() -> None:
    """Have the threads of this process take memory from a few pools, where the C library lets one say so.

    glibc has eight a core, and each keeps free what it once needed, in pieces: of a hundred threads that come and go,
    ever more of them have had their busiest moment.
    """
    with suppress(AttributeError):  # of another library
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, ARENAS)


def keep_open(running: AbstractAsyncContextManager[object]) -> None:
    """Keep something open, in a loop of this thread, until SIGTERM.

    Raises
    ------
    KeyboardInterrupt
        At SIGINT, when it is closed.
    """

    async def until_asked() -> int:
        loop = asyncio.get_running_loop()
        asked: asyncio.Queue[int] = asyncio.Queue()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, asked.put_nowait, number)
        async with running:
            return await asked.get()

    if asyncio.run(until_asked()) == signal.SIGINT:
        raise KeyboardInterrupt
