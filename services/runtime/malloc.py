"""Settings of the C library's memory allocator."""

import ctypes
from contextlib import suppress

ARENAS = 2
"""Pools of memory that the threads of a process share."""
M_ARENA_MAX = -8
"""Option of mallopt(3)."""


def limit_arenas() -> None:
    """Have the threads of this process allocate from a few pools, if the C library is glibc.

    By default glibc has eight pools per core, and each keeps, in fragments, what it once needed. In a process
    where many threads come and go, memory grows with every pool that was busy once.
    """
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, ARENAS)
