"""What the processes of a cluster have in common: how they log, and how they end."""

import asyncio
import logging
import signal
from contextlib import AbstractAsyncContextManager


def log() -> None:
    """Log to stderr; of dask only what somebody has to know."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    logging.getLogger("distributed").setLevel(logging.WARNING)


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
