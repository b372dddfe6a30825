"""Pools of memory that threads of a process share, memory that is used again, and searches for garbage."""

import os
import subprocess
import sys

import pytest

ARENAS = """
import ctypes, io, os, re, sys, threading
from services.runtime.memory import ARENAS, limit_arenas

limit_arenas()
together = threading.Barrier(16)

def work() -> None:
    held = [bytearray(5000) for _ in range(100)]
    together.wait()

threads = [threading.Thread(target=work) for _ in range(16)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
libc = ctypes.CDLL(None)
read, write = os.pipe()
libc.fdopen.restype = ctypes.c_void_p
stream = ctypes.c_void_p(libc.fdopen(write, b"w"))
libc.malloc_info(0, stream)
libc.fclose(stream)
report = os.fdopen(read).read()
assert len(re.findall("<heap nr", report)) <= ARENAS, report
"""

KEPT = """
from resource import RUSAGE_SELF, getrusage
from services.runtime.memory import keep_memory

def faults() -> int:
    before = getrusage(RUSAGE_SELF).ru_minflt
    for _ in range(20):
        bytes([1]) * (8 << 20)
    return getrusage(RUSAGE_SELF).ru_minflt - before

returned = faults()
keep_memory()
faults()
kept = faults()
assert 10 * kept < returned, (kept, returned)
"""

RETURNED = """
import psutil
from services.runtime.memory import keep_memory, return_free

keep_memory()
process = psutil.Process()
held = [bytes([1]) * (1 << 20) for _ in range(100)]
last = bytes([1]) * (1 << 20)  # keeps the pool from shrinking at its end
del held
before = process.memory_info().rss
return_free()
assert before - process.memory_info().rss > 50 << 20
"""

IMPORTED = """
import gc
from services.runtime.memory import no_collections

before = [of["collections"] for of in gc.get_stats()]
with no_collections():
    import fastapi
    after = [of["collections"] for of in gc.get_stats()]
assert after == before
assert gc.isenabled()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_threads_share_a_few_pools_of_memory() -> None:
    subprocess.run([sys.executable, "-c", ARENAS], check=True, timeout=120)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_memory_that_was_freed_is_used_again() -> None:
    as_dask_sets_it = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
    subprocess.run([sys.executable, "-c", KEPT], check=True, timeout=120, env=as_dask_sets_it)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_free_memory_is_returned_at_once_when_asked() -> None:
    subprocess.run([sys.executable, "-c", RETURNED], check=True, timeout=120)


def test_modules_are_imported_without_a_search_for_garbage() -> None:
    subprocess.run([sys.executable, "-c", IMPORTED], check=True, timeout=120)
