"""The event loop on which synchronous code awaits the object store."""

from __future__ import annotations

import asyncio
import atexit
import sys
import threading
import time
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Coroutine

PATIENCE = 2
"""Seconds that a process waits at its end for what it has begun, after Ctrl+C."""


def gather(*work: Coroutine[Any, Any, Any]) -> list[Any]:
    """Run coroutines concurrently from synchronous code, and return their results.

    A bucket takes tens of milliseconds to respond, and zarr about one to switch to its thread and back. All coroutines
    have ended when this returns, or raises the first error.
    """
    return asyncio.run_coroutine_threadsafe(finish_all(*work), _loop()).result()


async def finish_all(*work: Coroutine[Any, Any, Any]) -> list[Any]:
    """As `gather`, in asynchronous code."""
    ended = await asyncio.gather(*work, return_exceptions=True)
    for result in ended:
        if isinstance(result, BaseException):
            raise result
    return ended


@cache
def _loop() -> asyncio.AbstractEventLoop:
    """The event loop of `gather`, in its own thread, because a caller's loop must not be blocked.

    It is kept because zarr's compression threads belong to the loop.
    """
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="objects", daemon=True).start()
    return loop


@atexit.register
def _wait_for_store() -> None:
    """Wait until obstore's threads are done with Python: before 3.14, one that enters it afterwards aborts the process.

    They hand over a result before they leave, so that a program may end before them. Then they have frames of Python,
    and `threading` does not know them.
    """
    late = time.monotonic() + PATIENCE
    while (_has_work() or _foreign_threads()) and time.monotonic() < late:
        time.sleep(0.001)


def _has_work() -> bool:
    return bool(_loop.cache_info().currsize and asyncio.all_tasks(_loop()))


def _foreign_threads() -> set[int]:
    return sys._current_frames().keys() - {thread.ident for thread in threading.enumerate()}
