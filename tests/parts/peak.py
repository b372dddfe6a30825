"""What an ingest takes in memory: in a process of its own, by its resident peak.

Decoders and compressors allocate where tracemalloc does not look. Linux's VmHWM, for ru_maxrss begins at what the
process that started it had. A small ingest comes first, so that libraries and thread pools are in the baseline.
"""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from storage.layout.captures import Stack
from storage.objects.store import Objects
from workflows.ingest import steps as ingest_steps
from workflows.ingest.camera.border_exposure import BorderValues
from workflows.ingest.camera.calibration import calibrate
from workflows.jobs import Task
from workflows.untrusted.limits import Limits


def of_large_after_small(objects: Objects, memory: int) -> tuple[int, int]:
    """Slabs of the capture `large`, and the bytes by which ingesting it takes more than ingesting `small`."""
    command = [sys.executable, "-m", __name__, objects.url, str(memory)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    tiles, grown = map(int, done.stdout.split())
    return tiles, grown


def _ingest(objects: Objects, capture: str, memory: int) -> int:
    task = Task("j", capture, "", {}, Limits(1 << 30, memory))
    task = replace(task, plan=ingest_steps.prepare(objects, task))
    for tile in range(task.plan["tiles"]):
        ingest_steps.work(objects, task, tile)
    stack = Stack(objects, capture)
    calibrate(stack, BorderValues.of(stack))
    return int(task.plan["tiles"])


def peak() -> int:
    """The most bytes that this process has had."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) << 10


if __name__ == "__main__":
    store = Objects(sys.argv[1])
    _ingest(store, "small", int(sys.argv[2]))
    before = peak()
    print(_ingest(store, "large", int(sys.argv[2])), peak() - before)
