"""Pictures that strangers send are decoded in processes that the service can lose.

A decoder is native code, and a file may crash it, keep it for ever, or have it take all memory. So each picture goes to
a child process, forked from the one that workers are forked from, that has limits of memory and of time, and the worst
that comes of it is that its own request is refused.
"""

import logging
import threading

from services.decoding.process import AGAIN, Decoder, Refused
from storage.errors import ImageError, Unavailable
from workflows.images.decode import Transfer
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes
from workflows.untrusted import decoder_guard

logger = logging.getLogger(__name__)

SECONDS = 20.0
"""That decoding a picture may take, if it may have `USUAL` bytes or less; more in proportion."""
USUAL = 128 << 20


class Decoders:
    """Child processes that decode pictures, as many as are asked for at once, each of which is kept for the next.

    Parameters
    ----------
    memory : int
        Bytes that a decoded picture may take.
    seconds : float, optional
        That decoding one may take; default by the memory.
    """

    def __init__(self, memory: int, seconds: float | None = None) -> None:
        self._memory = memory
        self._seconds = SECONDS * max(memory / USUAL, 1) if seconds is None else seconds
        self._lock = threading.Lock()
        self._idle: list[Decoder] = []
        self._children: set[Decoder] = set()
        self._closed = False

    def decode(self, data: bytes, transfer: Transfer) -> Codes | Floats:
        """Decode a picture, as `pictures.decode`; for any number of threads.

        Raises
        ------
        ImageError
            Also if it takes too long, or ends the process that decodes it.
        """
        child = self._take()
        try:
            answer = child.ask(data, transfer, self._memory, self._seconds)
        except BaseException as error:
            with self._lock:
                self._children.discard(child)
            ended = child.end()
            if isinstance(error, TimeoutError):
                logger.warning("a picture of %d bytes took its decoder too long", len(data))
                raise ImageError(
                    f"decoding the image takes more than {self._seconds:g} s: send a smaller one, or {AGAIN}"
                ) from error
            if isinstance(error, OSError | EOFError | ValueError):
                logger.warning("a picture of %d bytes ended its decoder: %s, %r", len(data), ended, error)
                raise ImageError(
                    f"decoding the image ended the process that did it ({ended}): {AGAIN}"
                ) from error
            raise
        with self._lock:
            if not self._closed:
                self._idle.append(child)  # the last one used is the next: it has in memory what it needs
        if isinstance(answer, Refused):
            raise ImageError(answer.detail, **({} if answer.limit is None else {"limit": answer.limit}))
        return answer

    def close(self) -> None:
        """End the children, whatever they are doing."""
        with self._lock:
            self._closed = True
            children = list(self._children)
        for child in children:
            child.end()

    def _take(self) -> Decoder:
        """A child that has nothing to do."""
        while (child := self._idle_one()) is not None:
            if child.is_waiting():
                return child
            logger.warning("a decoder that had nothing to do is gone: %s", child.end())
            with self._lock:
                self._children.discard(child)
        child = Decoder(decoder_guard.room(self._memory))
        with self._lock:
            self._children.add(child)
        if self._closed:  # meanwhile
            child.end()
            raise _stopping()
        return child

    def _idle_one(self) -> Decoder | None:
        with self._lock:
            if self._closed:
                raise _stopping()
            return self._idle.pop() if self._idle else None


def _stopping() -> Unavailable:
    return Unavailable("the service is being stopped; send it again to the next one")
