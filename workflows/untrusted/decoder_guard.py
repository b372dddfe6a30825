"""Limits of time and memory for decoders, which read untrusted files in the process of a worker."""

import faulthandler
import math
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage.errors import CaptureError, ImageError

SECONDS = 180
"""More than the largest frame takes on a busy machine, or with a slow store."""
COPIES, EXTRA = 8, 256 << 20
"""A decoder may take so many frames of the largest size, and so many bytes more: twice what decoders of pictures and of
4K films took when measured."""


class Guard:
    """Limits the decoder of one file while it works.

    Parameters
    ----------
    entry : str
        The file's name, for errors.
    image : int
        Bytes that one decoded frame may take.
    """

    def __init__(self, entry: str, image: int) -> None:
        self._entry = entry
        self._memory = room(image)
        self._limit: float = math.inf
        self._used_before = 0

    @contextmanager
    def on(self) -> Iterator[None]:
        """Limit what runs inside the with statement. Only one thread at a time may be inside, as in workers.

        If it takes longer than `SECONDS`, the stacks are written to stderr and this process ends, because a thread
        can't be stopped, and a decoder may hold the interpreter lock. The worker is then started again, and its tile
        counts as lost.

        Raises
        ------
        CaptureError
            If it takes too much memory.
        """
        faulthandler.dump_traceback_later(SECONDS, exit=True, file=2)
        try:
            with self._limited():
                yield
        except (MemoryError, ImageError) as error:
            if isinstance(error, MemoryError) or isinstance(error.__cause__, MemoryError):
                raise CaptureError(
                    f"decoding {self._entry} takes more than the {self._memory >> 20} MB of memory allowed for it: it "
                    "is damaged, or too large. Copy it again from the camera, or make it smaller",
                    entry=self._entry,
                    limit=self._memory,
                ) from error
            raise
        finally:
            faulthandler.cancel_dump_traceback_later()

    @contextmanager
    def _limited(self) -> Iterator[None]:
        """Limit the memory of this process to what the decoder may take, over all its calls together.

        Other threads of the worker are refused memory as well between the decoder reaching its limit and giving up.
        That time is short, and most decoders ask for larger pieces than the other threads; at worst the worker is lost.
        """
        if sys.platform != "linux":  # other systems do not enforce the limit
            yield
            return
        now = in_use()
        # Memory taken since the last call is not the decoder's; memory given back may be.
        self._limit = min(self._limit + max(now - self._used_before, 0), now + self._memory)
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = int(self._limit) if soft == resource.RLIM_INFINITY else min(soft, int(self._limit))
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
            self._used_before = in_use()


def room(image: int) -> int:
    """Bytes that a decoder may take if one decoded frame may take ``image`` bytes."""
    return COPIES * image + EXTRA


def in_use() -> int:
    """Bytes of this process that count towards RLIMIT_DATA, used or not; on Linux only."""
    return int(Path("/proc/self/statm").read_text().split()[5]) * os.sysconf("SC_PAGE_SIZE")
