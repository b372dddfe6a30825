"""Processes that are asked to end while something hangs."""

import signal
import sys
import time

import psutil
import pytest

from tests.parts.processes import alive, running
from tests.parts.waiting import until

START = """
import asyncio, logging, subprocess, time
from contextlib import asynccontextmanager
from services.runtime import signals
signals.LIMIT = 0.5
logging.lastResort.acquire()  # what hangs may do so while it writes to a pipe that nobody reads
child = subprocess.Popen(["sleep", "600"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
"""
CODES = {
    "a process that runs until it exits": """
signals.exit_on_signal()
try:
    print(child.pid, flush=True)
    while True:
        time.sleep(0.1)  # a signal that comes just before a long one would be noticed after it
finally:
    time.sleep(600)
""",
    "a process that starts something": """
signals.exit_on_signal()
with signals.held_signals():
    print(child.pid, flush=True)
    time.sleep(600)
""",
    "a process with an event loop": """
@asynccontextmanager
async def service():
    print(child.pid, flush=True)
    yield
    await asyncio.sleep(600)
signals.run_until_signal(service())
""",
}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("code", CODES.values(), ids=CODES)
def test_process_ends_in_time_with_its_children_although_closing_hangs(
    code: str, number: signal.Signals
) -> None:
    with running([sys.executable, "-c", START + code]) as process:
        assert process.stdout is not None
        child = psutil.Process(int(process.stdout.readline()))
        start = time.monotonic()
        process.send_signal(number)
        assert process.wait(60) == 0
        until(lambda: not alive([child]))
        assert time.monotonic() - start < 5
