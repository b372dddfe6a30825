"""How a process ends when it is asked to."""

import asyncio
import signal
import sys
from contextlib import AbstractAsyncContextManager


def exit_on_sigterm() -> None:
    """Raise SystemExit in the main thread at SIGTERM, so that everything open is closed."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))


def run_until_signal(service: AbstractAsyncContextManager[object]) -> None:
    """Keep a service open, in an event loop of this thread, until SIGTERM or SIGINT.

    Raises
    ------
    KeyboardInterrupt
        At SIGINT, after the service is closed.
    """

    async def run() -> int:
        loop = asyncio.get_running_loop()
        received: asyncio.Queue[int] = asyncio.Queue()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, received.put_nowait, number)
        async with service:
            return await received.get()

    if asyncio.run(run()) == signal.SIGINT:
        raise KeyboardInterrupt
