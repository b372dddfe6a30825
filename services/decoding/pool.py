"""A pool of child processes that decode untrusted pictures.

Decoders are native code: a hostile file may crash one, hang it, or make it use all memory. So each picture is decoded
in a child process with limits of memory and time. If the child fails, only its own request is refused. Children are
forked from the fork server that workers are forked from.
"""

import logging
import threading

from services.decoding.process import ADVICE, Decoder, Refused
from storage.errors import ImageError, Unavailable
from workflows.images.decode import Transfer
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes
from workflows.untrusted import decoder_guard

logger = logging.getLogger(__name__)

SECONDS = 20.0
"""Time to decode a picture of up to `USUAL_BYTES`; a larger limit of bytes gives proportionally more time."""
USUAL_BYTES = 128 << 20


class Decoders:
    """Child processes that decode pictures: one for each concurrent request, kept for later requests.

    Parameters
    ----------
    memory : int
        Bytes that a decoded picture may take.
    seconds : float, optional
        Time to decode one picture. Default: in proportion to ``memory``.
    """

    def __init__(self, memory: int, seconds: float | None = None) -> None:
        self._memory = memory
        self._seconds = SECONDS * max(memory / USUAL_BYTES, 1) if seconds is None else seconds
        self._lock = threading.Lock()
        self._idle: list[Decoder] = []
        self._children: set[Decoder] = set()
        self._closed = False

    def decode(self, data: bytes, transfer: Transfer) -> Codes | Floats:
        """Decode a picture, as `workflows.images.decode.decode` does. Any number of threads may call it.

        Raises
        ------
        ImageError
            If the picture can't be decoded, takes too long, or ends the process that decodes it.
        Unavailable
            If the pool is closed.
        """
        child = self._take()
        try:
            answer = child.ask(data, transfer, self._memory, self._seconds)
        except BaseException as error:
            with self._lock:
                self._children.discard(child)
            ended = child.end()
            if isinstance(error, TimeoutError):
                logger.warning("decoding a picture of %d bytes took too long", len(data))
                raise ImageError(
                    f"decoding the image takes more than {self._seconds:g} s: send a smaller one, or {ADVICE}"
                ) from error
            if isinstance(error, OSError | EOFError | ValueError):
                logger.warning("a picture of %d bytes ended its decoder: %s, %r", len(data), ended, error)
                raise ImageError(
                    f"decoding the image ended the process of the decoder ({ended}): {ADVICE}"
                ) from error
            raise
        with self._lock:
            if not self._closed:
                self._idle.append(
                    child
                )  # the most recently used child is taken next: its memory is still mapped
        if isinstance(answer, Refused):
            raise ImageError(answer.detail, **({} if answer.limit is None else {"limit": answer.limit}))
        return answer

    def close(self) -> None:
        """Kill all children, also busy ones."""
        with self._lock:
            self._closed = True
            children = list(self._children)
        for child in children:
            child.end()

    def _take(self) -> Decoder:
        """Take an idle child, or start one."""
        while (child := self._idle_one()) is not None:
            if child.is_waiting():
                return child
            logger.warning("an idle decoder has ended: %s", child.end())
            with self._lock:
                self._children.discard(child)
        child = Decoder(decoder_guard.room(self._memory))
        with self._lock:
            self._children.add(child)
        if self._closed:  # while the child was started
            child.end()
            raise _stopping()
        return child

    def _idle_one(self) -> Decoder | None:
        with self._lock:
            if self._closed:
                raise _stopping()
            return self._idle.pop() if self._idle else None


def _stopping() -> Unavailable:
    return Unavailable("the service is being stopped; send the request again later")
