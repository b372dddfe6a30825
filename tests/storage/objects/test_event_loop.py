"""Coroutines run from synchronous code."""

import asyncio
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from storage.objects.event_loop import gather

UNFINISHED = """
import threading, time
import numpy as np
from storage.objects.event_loop import gather
from storage.objects.store import Objects

objects = Objects("memory:///")

async def read():
    for _ in range(40):
        await objects.array("a")

gather(objects.put_array("a", np.zeros(4, "u1")))
threading.Thread(target=lambda: gather(*(read() for _ in range(64))), daemon=True).start()
time.sleep(0.05)
print("end")
"""


def test_gather_waits_for_all_before_raising() -> None:
    ended = []

    async def work(seconds: float, error: Exception | None = None) -> float:
        await asyncio.sleep(seconds)
        ended.append(seconds)
        if error:
            raise error
        return seconds

    assert gather(work(0.02), work(0.0), work(0.01)) == [0.02, 0.0, 0.01]
    assert ended == [0.0, 0.01, 0.02]
    with pytest.raises(KeyError):
        gather(work(0.03), work(0.02, KeyError()), work(0.01, ValueError()))
    assert ended[3:] == [0.01, 0.02, 0.03]


def test_gather_from_threads_and_running_loop() -> None:
    async def double(n: int) -> int:
        return 2 * n

    async def inside() -> list[int]:
        return gather(double(1), double(2))

    assert asyncio.run(inside()) == [2, 4]
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(lambda n: gather(double(n)), range(50))) == [[2 * n] for n in range(50)]


@pytest.mark.parametrize("time", range(3))
def test_process_ends_well_while_the_store_is_read(time: int) -> None:
    """Four in five were aborted when nothing waited for the threads of obstore."""
    done = subprocess.run([sys.executable, "-c", UNFINISHED], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "end\n", "")
