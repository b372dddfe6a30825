"""Reads that many requests share, since they follow the same thing."""

import asyncio
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import anyio.to_thread

T = TypeVar("T")
INTERVAL = 0.5
"""Seconds between two reads of the same thing."""


class SharedReads:
    """Reads what requests follow: all of an owner's at once, and each thing once, however many requests follow it."""

    def __init__(self) -> None:
        self._wanted: dict[str, dict[Hashable, tuple[Callable[[], Any], asyncio.Future[Any]]]] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    async def read(self, owner: str, what: Hashable, read: Callable[[], T]) -> T:
        """Read something, in a thread, after `INTERVAL` at most.

        Parameters
        ----------
        owner : str
            Whose requests share answers: nobody waits for what others read.
        what : hashable
            What is read.
        read : callable
            Reads it. Whatever it raises is raised here.
        """
        if owner not in self._wanted:
            self._wanted[owner] = {}
            task = asyncio.create_task(self._read_all(owner))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        _, answer = self._wanted[owner].setdefault(what, (read, asyncio.get_running_loop().create_future()))
        found: T | Exception = await asyncio.shield(answer)  # a request that ends must not end it for others
        if isinstance(found, Exception):
            raise found
        return found

    async def _read_all(self, owner: str) -> None:
        await asyncio.sleep(INTERVAL)
        wanted = self._wanted.pop(owner).values()
        found = await anyio.to_thread.run_sync(lambda: [_found(read) for read, _ in wanted])
        for (_, answer), one in zip(wanted, found, strict=True):
            answer.set_result(one)


def _found(read: Callable[[], Any]) -> Any:
    """What a function returns or raises."""
    try:
        return read()
    except Exception as error:
        return error
