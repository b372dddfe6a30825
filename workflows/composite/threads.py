"""Threads of this process, for work that releases the interpreter: numba's own may not be used by several callers."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_parts(work: Callable[[int], None], parts: Iterable[int], threads: int) -> None:
    """Do all parts of a work, each by whichever thread is free; with one thread, here.

    Raises what a part raises, when no other of this work is under way any more.
    """
    todo = list(parts)
    if threads == 1 or len(todo) == 1:
        for part in todo:
            work(part)
        return
    following = iter(todo)  # `next` of a list's iterator is atomic

    def go_on() -> None:
        for part in following:
            work(part)

    futures = [_pool().submit(go_on) for _ in range(min(threads, len(todo)) - 1)]
    try:
        go_on()
    finally:
        for _ in following:  # after an error nobody takes another
            pass
        under_way = [future for future in futures if not future.cancel()]
        wait(under_way)
    for future in under_way:
        future.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2 * CORES, thread_name_prefix="composite")
