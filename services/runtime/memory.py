"""How a process takes and returns memory: the C library's allocator, and Python's search for garbage."""

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress

ARENAS = 2
"""Pools of memory that the threads of a process share."""
KEPT_BYTES = 32 << 20
"""Arrays up to this size are allocated from memory that the process keeps, of which as much again may lie idle. It is
the most that glibc comes to by itself."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Options of mallopt(3)."""


def limit_arenas() -> None:
    """Have the threads of this process allocate from a few pools, if the C library is glibc.

    By default glibc has eight pools per core, and each keeps, in fragments, what it once needed. In a process
    where many threads come and go, memory grows with every pool that was busy once.
    """
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, ARENAS)


def keep_memory() -> None:
    """Have glibc keep what tiles allocate and free over and over.

    dask has worker processes return all that is free (`MALLOC_TRIM_THRESHOLD_`), and to set this also ends glibc's own
    adaptation. Then a fifth of a recovery is spent in the kernel, which clears the same pages again and again.
    """
    with suppress(AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        library.mallopt(M_TRIM_THRESHOLD, 2 * KEPT_BYTES)


def return_free() -> None:
    """Return the memory that is free to the machine, also what lies between allocations, if the C library is glibc."""
    with suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def no_collections() -> Iterator[None]:
    """Look for no garbage while modules are imported: they are none, and to look takes a sixth of the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
