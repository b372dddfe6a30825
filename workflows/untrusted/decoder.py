"""Decoders: processes that read untrusted files for this one, confined so that they can do nothing else.

Decoders are native code: a hostile file may crash one, hang it, make it use all memory, or take it over. What a decoder
answers is validated and never unpickled: an attacker who takes one over controls that process and the pixels of its
files, but not the service.
"""

import io
import json
import logging
import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, JsonValue, TypeAdapter

from storage.errors import CaptureError, ImageError, Unavailable
from workflows.untrusted.decoder_process import ADVICE, HEAD, PIECE, Function
from workflows.untrusted.decoder_server import EXIT, server

logger = logging.getLogger(__name__)
SECONDS = 180.0
"""More than the largest frame takes on a busy machine, or with a slow store."""
COPIES, EXTRA = 8, 256 << 20
"""A decoder may take so many pictures of the largest size, and so many bytes more: twice what decoders of pictures and
of 4K films took when measured."""
LEAST_BYTES = 8 << 20
"""The most that an array may take that is no picture, such as the times of a film's frames."""
END_SECONDS = 5.0
"""Time in which a killed process ends."""
_HEAD_BYTES = 1 << 16
_BUFFER = 1 << 18  # of the socket, in bytes: large, for fewer context switches


class DecoderEnded(Exception):
    """A decoder ended, or sent something invalid and was ended; the message says how."""


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class _Read(_Strict):
    """Asks for bytes of the file."""

    read: Annotated[int, Field(ge=0)]
    count: Annotated[int, Field(ge=1, le=PIECE)]


class _Alive(_Strict):
    """Says that the process goes on."""

    alive: Literal[True]


class _Array(_Strict):
    """Is followed by the values of an array."""

    shape: Annotated[list[Annotated[int, Field(ge=0)]], Field(max_length=4)]
    dtype: Literal["uint8", "uint16", "float32", "int64"]


class _Value(_Strict):
    """Fields, for the caller to validate."""

    value: dict[str, JsonValue]


class _Refused(_Strict):
    """The file can't be decoded: the fields of an `ImageError`."""

    refused: Annotated[str, Field(max_length=10_000)]
    limit: int | None


class _Failed(_Strict):
    """The file can't be decoded, by an error of a library, in its words."""

    failed: Annotated[str, Field(max_length=1000)]


class _OutOfMemory(_Strict):
    """The file takes too much memory."""

    out_of_memory: Literal[True]


class _Done(_Strict):
    """The function has returned."""

    done: Literal[True]


_Answer = _Read | _Alive | _Array | _Value | _Refused | _Failed | _OutOfMemory | _Done
_ANSWERS: TypeAdapter[_Answer] = TypeAdapter(_Answer)


class Decoder:
    """A process that decodes one file after another, for one thread at a time.

    Parameters
    ----------
    image_bytes : int
        Bytes that one decoded picture may take. The process may allocate `room` for it.
    seconds : float
        Time for each answer. While a file is read piece by piece, time between two signs of life.
    """

    def __init__(self, image_bytes: int, seconds: float = SECONDS) -> None:
        self.image_bytes, self._seconds = image_bytes, seconds
        self._socket, self._wanted = server.fork(room(image_bytes))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._how: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def has_ended(self) -> bool:
        """Whether `end` was called, as it is when anything goes wrong with the process."""
        return self._how is not None

    def is_waiting(self) -> bool:
        """Whether the process is alive and has sent nothing unasked."""
        self._socket.setblocking(False)
        try:
            self._socket.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return True
        except OSError:
            return False
        return False

    def run(
        self, function: Function, file: bytes | IO[bytes], *, whole: bool = False, **arguments: Any
    ) -> Iterator[Any]:
        """Run a function on a file in the process.

        Parameters
        ----------
        function : callable
            At the top of a module of `workflows`; it takes a seekable file and the arguments, and yields arrays and
            fields.
        file : bytes or IO[bytes]
            Bytes are sent whole; of an open file, what the function reads.
        whole : bool
            Whether an open file is sent whole too.
        **arguments
            Plain values.

        Yields
        ------
        dict or numpy.ndarray
            What the function yields, to be validated by the caller.

        Raises
        ------
        ImageError
            If the function refuses the file.
        MemoryError
            If it takes too much memory.
        TimeoutError
            If it takes too long. This and whatever is raised below ends the process.
        DecoderEnded
            If the process ends or sends something invalid.
        """
        if isinstance(file, bytes):
            file, whole = io.BytesIO(file), True
        length = file.seek(0, os.SEEK_END)
        name = f"{function.__module__}:{function.__qualname__}"
        request = {"function": name, "arguments": arguments, "length": length, "sent": whole}
        text = json.dumps(request).encode()
        deadline = time.monotonic() + self._seconds
        answer: _Answer | None = None
        try:
            with self.checking():
                self._send(HEAD.pack(len(text)) + text, deadline)
                file.seek(0)
                while whole and (piece := file.read(PIECE)):
                    self._send(piece, deadline)
            while not isinstance(answer, _Done | _Refused | _Failed | _OutOfMemory):
                with self.checking():
                    answer = self._receive(deadline)
                    values = self._array(answer, deadline) if isinstance(answer, _Array) else None
                    if whole and isinstance(answer, _Read | _Alive):
                        raise ValueError("it has the whole file, and to answer in time")
                    if isinstance(answer, _Read) and answer.read + answer.count > length:
                        raise ValueError("it asks for more than the file has")
                if isinstance(answer, _Value):
                    yield answer.value
                elif values is not None:
                    yield values
                deadline = time.monotonic() + self._seconds
                if isinstance(answer, _Read):
                    piece = _read(file, answer)
                    with self.checking():
                        self._send(piece, deadline)
        except BaseException:
            self.end()
            raise
        if isinstance(answer, _OutOfMemory):
            raise MemoryError
        if isinstance(answer, _Failed):
            logger.warning("a file can't be decoded: %s", answer.failed)
            raise ImageError(f"the file can't be decoded: it is damaged, or of an unusual kind; {ADVICE}")
        if isinstance(answer, _Refused):
            raise ImageError(answer.refused, **({} if answer.limit is None else {"limit": answer.limit}))

    def picture(self, function: Function, file: bytes | IO[bytes], **arguments: Any) -> NDArray[Any]:
        """Run a function that yields a single picture on a file that is sent whole, and check that it is one.

        Returns
        -------
        (height, width, 1 to 4) uint8 or uint16, or (height, width, 1 or 3) float32

        Raises
        ------
        ImageError, MemoryError, TimeoutError, DecoderEnded
            As `run`.
        """
        with self.checking():
            (pixels,) = self.run(function, file, whole=True, **arguments)  # a second one would be an error
            if not isinstance(pixels, np.ndarray) or pixels.ndim != 3 or not pixels.size:
                raise ValueError("it sent no picture")
            if pixels.shape[2] not in ((1, 3) if pixels.dtype == np.float32 else (1, 2, 3, 4)):
                raise ValueError(f"a picture can't have {pixels.shape[2]} channels of {pixels.dtype}")
            if pixels.dtype == np.int64 or pixels.nbytes > self.image_bytes:
                raise ValueError(f"{pixels.nbytes} bytes of {pixels.dtype} are not allowed")
        return pixels

    def end(self) -> str:
        """Kill the process if it is alive; returns how it ended."""
        if self._how is None:
            self._socket.close()
            with self._wanted:
                self._how = _how_it_ended(self._wanted)
        return self._how

    @contextmanager
    def checking(self) -> Iterator[None]:
        """End the process if what it has sent is found to be invalid, or nothing more can come.

        Raises
        ------
        TimeoutError
        DecoderEnded
            In place of any other `OSError`, `EOFError` or `ValueError`.
        """
        try:
            yield
        except TimeoutError:
            raise
        except (OSError, EOFError, ValueError) as error:
            raise DecoderEnded(self.end()) from error

    def _receive(self, deadline: float) -> _Answer:
        (size,) = HEAD.unpack(self._take(HEAD.size, deadline))
        if size > _HEAD_BYTES:
            raise ValueError(f"a head of {size} bytes")
        return _ANSWERS.validate_json(self._take(size, deadline))

    def _array(self, head: _Array, deadline: float) -> NDArray[Any]:
        dtype = np.dtype(head.dtype)
        size = dtype.itemsize
        for side in head.shape:
            size *= side
        if size > max(self.image_bytes, LEAST_BYTES):
            raise ValueError(
                f"{head.shape} values of {dtype} take more than the limit of {self.image_bytes} bytes"
            )
        values = np.empty(head.shape, dtype)
        self._fill(values.reshape(-1).view(np.uint8).data, deadline)
        return values

    def _fill(self, buffer: memoryview, deadline: float) -> None:
        while buffer:
            self._socket.settimeout(_remaining(deadline))
            count = self._socket.recv_into(buffer)
            if not count:
                raise EOFError("the connection was closed")
            buffer = buffer[count:]

    def _take(self, size: int, deadline: float) -> bytearray:
        data = bytearray(size)
        self._fill(memoryview(data), deadline)
        return data

    def _send(self, data: bytes, deadline: float) -> None:
        self._socket.settimeout(_remaining(deadline))
        self._socket.sendall(data)


def room(image_bytes: int) -> int:
    """Bytes that a decoder may take if one decoded picture may take ``image_bytes``."""
    return COPIES * image_bytes + EXTRA


@contextmanager
def blaming(entry: str, decoder: Decoder) -> Iterator[None]:
    """Translate the errors of a decoder into those of a capture, for a step of a job.

    Parameters
    ----------
    entry : str
        The name of the file.
    decoder : Decoder

    Raises
    ------
    CaptureError
        If the file can't be decoded, or takes too much memory.
    Unavailable
        If it ended the decoder, which may have had another reason.
    """
    try:
        yield
    except MemoryError as error:
        limit = room(decoder.image_bytes)
        raise CaptureError(
            f"decoding {entry} takes more than the {limit >> 20} MB of memory allowed for it: it is damaged, or too "
            "large. Copy it again from the camera, or make it smaller",
            entry=entry,
            limit=limit,
        ) from error
    except ImageError as error:
        raise CaptureError(error.detail, entry=entry, **error.fields) from error
    except TimeoutError as error:
        raise Unavailable(
            f"decoding {entry} did not go on for {SECONDS:g} s: the machine is busy, or the file makes the decoder "
            f"hang; {ADVICE}"
        ) from error
    except DecoderEnded as error:
        raise Unavailable(f"decoding {entry} ended the process of the decoder ({error}): {ADVICE}") from error


def _read(file: IO[bytes], asked: _Read) -> bytes:
    file.seek(asked.read)
    return file.read(asked.count)


def _remaining(deadline: float) -> float:
    remaining = deadline - time.monotonic()
    if remaining <= 0:
        raise TimeoutError
    return remaining


def _how_it_ended(wanted: socket.socket) -> str:
    """Have a decoder killed, if it is alive; returns its signal or exit code."""
    wanted.settimeout(END_SECONDS)
    try:
        with suppress(OSError):
            wanted.shutdown(socket.SHUT_WR)
        data = wanted.recv(EXIT.size, socket.MSG_WAITALL)
    except OSError:
        data = b""
    if len(data) < EXIT.size:
        return "with the process that it was forked from"
    (code,) = EXIT.unpack(data)
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
