"""Reads that requests share, each test in an event loop of its own."""

import asyncio
import threading
import time
from itertools import count

import pytest

from services.api.http.shared_reads import INTERVAL, SharedReads
from storage.errors import NotFound


def test_requests_that_follow_the_same_share_one_read() -> None:
    shared, numbers, letters = SharedReads(), count(), iter("ab")

    async def follow() -> list[list[object]]:
        reads = [lambda: shared.read("alice", "numbers", lambda: next(numbers))] * 200
        reads += [lambda: shared.read("alice", "letters", lambda: next(letters))] * 200
        return [await asyncio.gather(*(read() for read in reads)) for _ in range(2)]

    assert asyncio.run(follow()) == [[0] * 200 + ["a"] * 200, [1] * 200 + ["b"] * 200]


def test_an_error_is_raised_for_all_that_asked_and_for_no_others() -> None:
    shared = SharedReads()

    def fail() -> None:
        raise NotFound("it is gone")

    async def follow() -> list[object]:
        reads = [shared.read("alice", "gone", fail), shared.read("alice", "gone", fail)]
        reads.append(shared.read("alice", "there", lambda: None))
        return await asyncio.gather(*reads, return_exceptions=True)

    one, other, none = asyncio.run(follow())
    assert isinstance(one, NotFound)
    assert isinstance(other, NotFound)
    assert none is None


def test_a_request_that_ends_leaves_the_read_to_others() -> None:
    shared = SharedReads()

    async def follow() -> str:
        ends, stays = (asyncio.create_task(shared.read("alice", "it", lambda: "read")) for _ in range(2))
        await asyncio.sleep(0)
        ends.cancel()
        with pytest.raises(asyncio.CancelledError):
            await ends
        return await stays

    assert asyncio.run(follow()) == "read"


def test_slow_reads_of_one_owner_hold_up_no_other() -> None:
    shared, read = SharedReads(), threading.Event()

    async def follow() -> bool:
        slow = asyncio.create_task(shared.read("mallory", "it", lambda: read.wait(60)))
        await asyncio.sleep(2 * INTERVAL)
        await shared.read("alice", "it", time.time)
        waiting = not slow.done()
        read.set()
        await slow
        return waiting

    assert asyncio.run(follow())
