"""How a process ends when it is asked to: in order, but within a time that all it has to close shares."""

import asyncio
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractAsyncContextManager, contextmanager, suppress
from typing import Any

import psutil

logger = logging.getLogger(__name__)

LIMIT = 5.0
"""Seconds from the first signal until the process and its children are killed. All that is stored survives a sudden end
at any moment, as after a crash."""


def end_in_time() -> None:
    """Kill this process and its children in `LIMIT` seconds, unless it ends before."""
    threading.Thread(target=_end, args=(time.monotonic() + LIMIT,), daemon=True).start()


def _end(last: float) -> None:
    # Listed now: those whose parent ends meanwhile are no longer below this process.
    children = psutil.Process().children(recursive=True)
    time.sleep(max(last - time.monotonic(), 0))
    text = "not everything has ended %g s after the signal; the process ends all the same"
    said = threading.Thread(target=logger.warning, args=(text, LIMIT), daemon=True)
    said.start()
    # Workers and decoders would notice it only some seconds later.
    for child in {*children, *psutil.Process().children(recursive=True)}:
        with suppress(psutil.NoSuchProcess):
            child.kill()
    said.join(0.2)  # what hangs may hold a lock of the log
    os._exit(0)


def exit_on_signal() -> None:
    """Raise SystemExit in the main thread at SIGTERM, KeyboardInterrupt at SIGINT; what is open closes in time."""

    def end(number: int, frame: object) -> None:
        end_in_time()
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(0)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)


@contextmanager
def held_signals() -> Iterator[None]:
    """Put a first SIGTERM or SIGINT off until what starts here has started: half of it could not be closed in order.

    What takes too long is killed, see `end_in_time`.
    """
    held: list[int] = []

    def hold(number: int, frame: object) -> None:
        if held:
            handlers[number](number, frame)
        else:
            end_in_time()
        held.append(number)

    handlers: dict[int, Any] = {
        number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)
    }
    for number in handlers:
        signal.signal(number, hold)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for number in held:
        signal.raise_signal(number)


def run_until_signal(service: AbstractAsyncContextManager[object]) -> None:
    """Keep a service open, in an event loop of this thread, until SIGTERM or SIGINT; then close it, in time.

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
            last = await received.get()
            end_in_time()
            return last

    if asyncio.run(run()) == signal.SIGINT:
        raise KeyboardInterrupt
