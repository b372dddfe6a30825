"""Pools of memory that threads of a process share."""

import subprocess
import sys

import pytest

ARENAS = """
import ctypes, io, os, re, sys, threading
from services.runtime.malloc import ARENAS, limit_arenas

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


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_threads_share_a_few_pools_of_memory() -> None:
    subprocess.run([sys.executable, "-c", ARENAS], check=True, timeout=120)
