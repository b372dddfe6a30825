"""Work that a request waits for: within its owner's share, and only as long as somebody wants its result."""

import asyncio
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import TypeVar

import anyio.to_thread
from fastapi import Request
from starlette.requests import ClientDisconnect

from services.runtime.memory import return_free
from services.runtime.problems import TooLarge
from storage.errors import InvalidInput, TooMany
from workflows.interruption import interruptible
from workflows.threads import CORES

T = TypeVar("T")
CHECK_SECONDS = 0.25
"""Seconds between two looks whether the client is still there."""
LARGE = 128 << 20
"""Bytes from which on the memory of a request is returned to the machine once its work has ended."""


@dataclass(frozen=True, eq=False)
class _Turn:
    owner: str
    amount: int
    came: asyncio.Event = field(default_factory=asyncio.Event)


class Shares:
    """Slots, or bytes, that requests take while they work; no owner can have all of them.

    Owners take turns: what is free goes to the one who has waited longest since their last turn, however many requests
    others have waiting. The requests of an owner who has their share wait for that owner's own. All calls are from one
    event loop.

    Parameters
    ----------
    total : int
    each : int
        The most that the requests of one owner may have together.
    name : str, optional
        The setting that the total comes from, for errors.
    """

    def __init__(self, total: int, each: int, name: str | None = None) -> None:
        self._free, self.each, self._name = total, each, name
        self._taken: Counter[str] = Counter()
        self._waiting: list[_Turn] = []
        self._turns: dict[str, int] = {}
        """The number of the last turn of each owner."""
        self._numbers = count(1)

    @asynccontextmanager
    async def take(self, owner: str, seconds: float, amount: int = 1) -> AsyncIterator[None]:
        """Wait for an amount, and have it during the block.

        Raises
        ------
        TooLarge
            If it is more than an owner may have.
        TooMany
            If its turn does not come within ``seconds``.
        """
        if amount > self.each:
            raise TooLarge(
                f"this request takes {amount} bytes of memory, and one may take {self.each}, half of what all may "
                f"take together; raise ENVMATTE_{(self._name or '').upper()}",
                **({"name": self._name} if self._name else {}),
                limit=self.each,
                value=amount,
            )
        turn = _Turn(owner, amount)
        self._waiting.append(turn)
        self._admit()
        try:
            try:
                async with asyncio.timeout(seconds):
                    await turn.came.wait()
            except TimeoutError as error:
                raise TooMany("other requests are served first; send this one again later") from error
            yield
        finally:
            if turn.came.is_set():
                self._give_back(owner, amount)
            else:
                self._waiting.remove(turn)
                self._admit()

    def keep(self, owner: str, amount: int) -> Callable[[], None]:
        """Have an amount at once, even if it is more than is free. The function that is returned gives it back."""
        self._free -= amount
        self._taken[owner] += amount
        return partial(self._give_back, owner, amount)

    def exceeded(self, owner: str) -> bool:
        """Whether what an owner has, or all have, is more than they may take."""
        return self._taken[owner] > self.each or self._free < 0

    def _give_back(self, owner: str, amount: int) -> None:
        self._free += amount
        self._taken[owner] -= amount
        self._admit()

    def _admit(self) -> None:
        while eligible := [
            turn for turn in self._waiting if self._taken[turn.owner] + turn.amount <= self.each
        ]:
            turn = min(eligible, key=lambda turn: self._turns.get(turn.owner, 0))
            if turn.amount > self._free:
                break  # else small ones would pass a large one for ever
            self._waiting.remove(turn)
            self._free -= turn.amount
            self._taken[turn.owner] += turn.amount
            self._turns[turn.owner] = next(self._numbers)
            turn.came.set()


@dataclass(frozen=True)
class RequestShares:
    """All that requests share while they work, for one app."""

    memory: Shares
    """Bytes that frames, pixels, layers, composites and archives take while they are read, computed and encoded."""
    backdrops: Shares
    """Bytes of backdrops on disk, from their first byte until they are composited."""
    lists: Shares = field(default_factory=lambda: Shares(4, 1))
    """Lists, captures and reports made at once: a capture's program may take 60 MB. One an owner, since they compute
    all the time, and each thread that does delays all other requests."""
    pictures: Shares = field(default_factory=lambda: Shares(4, 3))
    """Pictures of programs drawn at once. Like the shares below, it bounds the memory that they take."""
    films: Shares = field(default_factory=lambda: Shares(2, 1))
    """Videos of programs encoded at once."""
    composites: Shares = field(default_factory=lambda: Shares(CORES + 1, CORES))
    """Composites computed at once: one more than there are cores."""
    captures: Shares = field(default_factory=lambda: Shares(2, 1))
    """Capture archives checked at once."""
    archives: Shares = field(default_factory=lambda: Shares(8, 4))
    """Archives of mattes sent at once: of each its entries are kept, 10 MB for a matte of 16 megapixels."""
    imports: Shares = field(default_factory=lambda: Shares(2, 1))
    """Archives of mattes unpacked at once."""
    layers: Shares = field(default_factory=lambda: Shares(2, 1))
    """Layers of mattes, and mattes for browsers, encoded at once."""
    answers: Shares = field(default_factory=lambda: Shares(4 << 30, 2 << 30))
    """Bytes of answers in temporary files until they are read. How many one has is known once it is computed: it begins
    while its owner has less than their share, and may exceed it."""
    calls: Shares = field(default_factory=lambda: Shares(8, 4))
    """Short calls at once: each takes a thread, and most of them a connection to the database or its write lock."""


async def run(
    request: Request,
    owner: str,
    seconds: float,
    needed: Sequence[tuple[Shares, int]],
    work: Callable[[], T],
) -> T:
    """Do the work of a request in a thread, once its owner's shares have room for it.

    Work that calls `checkpoint` ends when the client goes away, the service stops or the time is over. What it has
    taken of the shares it keeps until it has really ended, and until then the request goes on too.

    Parameters
    ----------
    seconds : float
        How long it may wait for its turn, and how long the work may take.
    needed : sequence of (Shares, int)
        What the work takes of each, in this order. All requests that take several must take them in the same order.

    Raises
    ------
    ClientDisconnect
        If the client goes away.
    InvalidInput
        If the work takes more than ``seconds``.
    TooLarge
        If it needs more than an owner may have.
    TooMany
        If its turn does not come within ``seconds``.
    """
    if await request.is_disconnected():
        raise ClientDisconnect
    unwanted, begun = threading.Event(), threading.Event()
    last = time.monotonic() + seconds

    async def in_turn() -> T:
        async with AsyncExitStack() as taken:
            for shares, amount in needed:
                await taken.enter_async_context(shares.take(owner, last - time.monotonic(), amount))
            begun.set()
            here = partial(_interruptibly, work, seconds, unwanted)
            if any(amount >= LARGE for _, amount in needed):
                here = partial(_returning_memory, here)
            return await anyio.to_thread.run_sync(here, limiter=anyio.CapacityLimiter(1))

    answer, left = asyncio.create_task(in_turn()), asyncio.create_task(_disconnected(request))
    answer.add_done_callback(lambda task: task.cancelled() or task.exception())  # nobody else may ask for it
    try:
        await asyncio.wait((answer, left), return_when=asyncio.FIRST_COMPLETED)
        if not answer.done():
            unwanted.set()
            if not begun.is_set():
                raise ClientDisconnect
            await asyncio.wait((answer,))  # it may still use what its request cleans up
        return answer.result()
    finally:
        left.cancel()
        unwanted.set()
        if not begun.is_set():
            answer.cancel()


def _interruptibly(work: Callable[[], T], seconds: float, unwanted: threading.Event) -> T:
    """Do work that ends at a `checkpoint` once it is unwanted, or takes too long."""
    end = time.monotonic() + seconds

    def check() -> None:
        if unwanted.is_set():
            raise ClientDisconnect
        if time.monotonic() > end:
            raise InvalidInput(
                f"the answer takes more than {seconds:g} s to compute; ask for less, or raise "
                "ENVMATTE_REQUEST_SECONDS",
                name="request_seconds",
                limit=seconds,
            )

    with interruptible(check):
        return work()


def _returning_memory(work: Callable[[], T]) -> T:
    """Do work, and return what it has freed to the machine."""
    try:
        return work()
    finally:
        return_free()


async def _disconnected(request: Request) -> None:
    """Return once the client has closed the connection."""
    while not await request.is_disconnected():
        await asyncio.sleep(CHECK_SECONDS)
