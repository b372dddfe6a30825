"""A pool of decoders for the pictures of requests.

If a decoder fails, only its own request is refused.
"""

import logging
import threading
from typing import IO

from storage.errors import ImageError, Unavailable
from workflows.images.decode import Transfer, decode_file
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes
from workflows.untrusted import confinement
from workflows.untrusted.decoder import Decoder, DecoderEnded
from workflows.untrusted.decoder_process import ADVICE
from workflows.untrusted.decoder_server import server

logger = logging.getLogger(__name__)

SECONDS = 20.0
"""Time to decode a picture of up to `USUAL_BYTES`; a larger limit of bytes gives proportionally more time."""
USUAL_BYTES = 128 << 20


class Decoders:
    """Processes that decode pictures: one for each concurrent request, kept for later requests.

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
        self._decoders: set[Decoder] = set()
        self._closed = False
        if lacking := confinement.missing():
            logger.warning("%s", lacking)
        server.start()  # at the same time as the service

    def decode(self, file: bytes | IO[bytes], transfer: Transfer) -> Codes | Floats:
        """Decode a picture, as `workflows.images.decode.decode` does. Any number of threads may call it.

        Raises
        ------
        ImageError
            If the picture can't be decoded, takes too long, or ends the process that decodes it.
        Unavailable
            If the pool is closed.
        """
        decoder = self._take()
        try:
            return decoder.picture(decode_file, file, transfer=transfer, memory=self._memory)
        except MemoryError as error:
            raise ImageError(
                f"decoding the image takes too much memory: send a smaller one, or {ADVICE}"
            ) from error
        except TimeoutError as error:
            logger.warning("decoding a picture took too long")
            raise ImageError(
                f"decoding the image takes more than {self._seconds:g} s: send a smaller one, or {ADVICE}"
            ) from error
        except DecoderEnded as error:
            logger.warning("a picture ended its decoder: %s, %.300r", error, error.__cause__)
            raise ImageError(
                f"decoding the image ended the process of the decoder ({error}): {ADVICE}"
            ) from error
        finally:
            self._give_back(decoder)

    def close(self) -> None:
        """Kill all decoders, also busy ones."""
        with self._lock:
            self._closed = True
            decoders = list(self._decoders)
        for decoder in decoders:
            decoder.end()

    def _take(self) -> Decoder:
        """Take an idle decoder, or start one."""
        while (decoder := self._idle_one()) is not None:
            if decoder.is_waiting():
                return decoder
            logger.warning("an idle decoder has ended: %s", decoder.end())
            self._give_back(decoder)
        decoder = Decoder(self._memory, self._seconds)
        with self._lock:
            self._decoders.add(decoder)
        if self._closed:  # while it was started
            decoder.end()
            raise _stopping()
        return decoder

    def _idle_one(self) -> Decoder | None:
        with self._lock:
            if self._closed:
                raise _stopping()
            # The most recently used one: its memory is still mapped.
            return self._idle.pop() if self._idle else None

    def _give_back(self, decoder: Decoder) -> None:
        with self._lock:
            if not decoder.has_ended and not self._closed:
                self._idle.append(decoder)
                return
            self._decoders.discard(decoder)
        decoder.end()


def _stopping() -> Unavailable:
    return Unavailable("the service is being stopped; send the request again later")
