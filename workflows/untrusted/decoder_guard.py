"""Limits of time and memory for decoders, which run in the process of a worker at files of strangers."""

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
"""More than the largest frame takes on a machine that is busy with much else, or a store that answers late."""
COPIES, BESIDES = 8, 256 << 20
"""Frames of the largest size that a decoder has room for, and bytes besides: twice what decoders of pictures and of
films of 4K have been seen to take."""


class Guard:
    """What watches over the decoder of one file, whenever that is at work.

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
        self._most: float = math.inf
        self._then = 0

    @contextmanager
    def on(self) -> Iterator[None]:
        """Bound what is done inside. One thread at a time may be there, as in workers.

        If it takes longer than `SECONDS`, this process is ended, once its stacks are on stderr: a thread can't be
        stopped, and a decoder may hold the interpreter, and let nothing else of the process run. A worker is started
        again then, and its tile is one that was lost.

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
                    "is damaged, or too large. Copy it anew from the camera, or make it smaller",
                    entry=self._entry,
                    limit=self._memory,
                ) from error
            raise
        finally:
            faulthandler.cancel_dump_traceback_later()

    @contextmanager
    def _limited(self) -> Iterator[None]:
        """Have this process get no more memory than the decoder may take, all the times together that it is at work.

        Other threads of the worker are refused memory too, from when the decoder has taken all until it gives up. That
        is a moment, and most decoders ask for more at once than the others need; at worst the worker is lost.
        """
        if sys.platform != "linux":  # others have the limit and do not keep to it
            yield
            return
        now = in_use()
        # What was taken since the last time is not the decoder's; what was given back may be.
        self._most = min(self._most + max(now - self._then, 0), now + self._memory)
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        most = int(self._most) if soft == resource.RLIM_INFINITY else min(soft, int(self._most))
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
            self._then = in_use()


def room(image: int) -> int:
    """Bytes that a decoder may take, one decoded frame of which may take `image`."""
    return COPIES * image + BESIDES


def in_use() -> int:
    """Bytes of this process that count for RLIMIT_DATA, used or not; on Linux alone."""
    return int(Path("/proc/self/statm").read_text().split()[5]) * os.sysconf("SC_PAGE_SIZE")
