"""Threads for work that releases the interpreter lock. Numba's own threads don't support several callers."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from contextvars import copy_context
from functools import cache

from workflows.interruption import checkpoint

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_parts(work: Callable[[int], None], parts: Iterable[int], threads: int) -> None:
    """Call ``work`` with each of ``parts`` on several threads; with one thread, on the calling one.

    An error of a part, or of the `checkpoint` before it, is raised once all parts under way have ended.
    """
    todo = list(parts)
    following = iter(todo)  # `next` of a list's iterator is atomic

    def work_on() -> None:
        for part in following:
            checkpoint()
            work(part)

    if threads == 1 or len(todo) == 1:
        work_on()
        return
    # With the caller's context, that `checkpoint` asks for the same work.
    futures = [_pool().submit(copy_context().run, work_on) for _ in range(min(threads, len(todo)) - 1)]
    try:
        work_on()
    finally:
        for _ in following:  # after an error, take no further parts
            pass
        under_way = [future for future in futures if not future.cancel()]
        wait(under_way)
    for future in under_way:
        future.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2 * CORES, thread_name_prefix="parts")
