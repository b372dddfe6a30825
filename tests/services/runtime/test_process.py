"""What a process of the service does to itself."""

import subprocess
import sys

import pytest

ARENAS = """
import ctypes, io, os, re, sys, threading
from services.runtime.process import ARENAS, share_memory

share_memory()
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
told = os.fdopen(read).read()
assert len(re.findall("<heap nr", told)) <= ARENAS, told
"""


@pytest.mark.skipif(sys.platform != "linux", reason="it is glibc that is told")
def test_threads_share_a_few_pools_of_memory() -> None:
    subprocess.run([sys.executable, "-c", ARENAS], check=True, timeout=120)
