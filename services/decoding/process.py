"""A process that decodes one picture after another: its side, and that of whoever asks.

What it is told, and what it says, is a few fields of JSON and the bytes of a picture or of pixels. What it says is
checked and never unpickled: who takes a decoder over has that process, and not the service.
"""

import ctypes
import gc
import multiprocessing
import resource
import signal
import socket
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from storage.errors import ImageError
from workflows.images import decode
from workflows.images.decode import Transfer
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes
from workflows.untrusted.decoder_guard import in_use

SPARE = 5.0
"""Seconds more, after which a decoder whose service is gone ends by itself, whatever it is doing."""
KEPT = 32 << 20
"""Bytes of memory that it keeps for the next picture."""
NAME = "decoder"
"""What `ps -o comm` and `top` show of it."""
AGAIN = "save it anew with another program, or in another format"
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)
_HEAD = struct.Struct("<I")
_HEAD_BYTES = 1 << 16
_BUFFER = 1 << 18  # bytes on their way between two processes, which then change places less often

Side = Annotated[int, Field(ge=1)]
Channels = Annotated[int, Field(ge=1, le=4)]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class _Asked(_Strict):
    """What a child is told before the bytes of a picture."""

    size: int
    transfer: Transfer
    memory: int
    seconds: float


class _Decoded(_Strict):
    """What a child says before the values of pixels."""

    height: Side
    width: Side
    channels: Channels
    dtype: Literal["uint8", "uint16", "float32"]


class Refused(_Strict):
    """What it says of a picture that can't be used, as `ImageError` has it."""

    detail: Annotated[str, Field(max_length=10_000)]
    limit: int | None = None


class _Answer(_Strict):
    said: _Decoded | Refused


class Decoder:
    """A process that decodes one picture after another.

    Parameters
    ----------
    memory : int
        Bytes that it may take more than when it starts.
    """

    def __init__(self, memory: int) -> None:
        self._socket, theirs = socket.socketpair()
        try:
            with theirs:
                context = multiprocessing.get_context("forkserver")
                self._process = context.Process(target=_serve, args=(theirs, memory), name=NAME, daemon=True)
                self._process.start()
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        except BaseException:
            self._socket.close()
            raise

    def is_waiting(self) -> bool:
        """Whether it lives, and says nothing that it was not asked."""
        self._socket.setblocking(False)
        try:
            self._socket.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return True
        except OSError:
            return False
        return False

    def ask(self, data: bytes, transfer: Transfer, memory: int, seconds: float) -> Codes | Floats | Refused:
        """Have a picture decoded.

        Raises
        ------
        TimeoutError
            If it takes too long.
        OSError, EOFError
            If the child is gone.
        ValueError
            If it answers what it never should.
        """
        until = time.monotonic() + seconds
        asked = _Asked(size=len(data), transfer=transfer, memory=memory, seconds=seconds)
        self._socket.settimeout(seconds)
        self._socket.sendall(_framed(asked))
        self._socket.settimeout(_left(until))
        self._socket.sendall(data)
        said = _Answer.model_validate_json(_read_head(self._socket, until)).said
        if isinstance(said, Refused):
            return said
        shape, dtype = (said.height, said.width, said.channels), np.dtype(said.dtype)
        if said.height * said.width * said.channels * dtype.itemsize > memory:
            raise ValueError(
                f"{shape} values of {dtype} are more than the {memory} bytes that it was allowed"
            )
        if dtype == np.float32 and said.channels not in (1, 3):
            raise ValueError(f"float pixels have no {said.channels} channels")
        pixels = np.empty(shape, dtype)
        _fill(self._socket, pixels.data.cast("B"), until)
        return pixels

    def end(self) -> str:
        """Kill it, unless it is gone, and say what it died of."""
        self._process.kill()
        self._process.join(SPARE)
        self._socket.close()
        code = self._process.exitcode
        return _signal_of(-code) if code is not None and code < 0 else f"exit code {code}"


def _serve(connection: socket.socket, memory: int) -> None:
    """What a child does: decode, until the service hangs up."""
    _keep_memory()
    gc.freeze()  # what it was forked with: a collection would look at all of it, and so have it copied, some 60 MB
    _confine(memory)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    with connection:
        while True:
            try:
                asked = _Asked.model_validate_json(_read_head(connection))
                # Ended by the system: a decoder that hangs may let nothing else of this process run.
                signal.setitimer(signal.ITIMER_REAL, asked.seconds + SPARE)
                data = connection.recv(asked.size, socket.MSG_WAITALL)
            except (EOFError, ConnectionError):
                return
            values = memoryview(b"")
            said: _Decoded | Refused
            try:
                pixels = decode.decode(data, asked.transfer, memory=asked.memory)
                height, width, channels = pixels.shape
                size = {"height": height, "width": width, "channels": channels}
                said = _Decoded.model_validate(size | {"dtype": pixels.dtype.name})
                values = pixels.data.cast("B")
                del pixels
            except Exception as error:  # of others than ours, it is not known what they hold
                said = _refusal(error)
            try:
                connection.sendall(_framed(_Answer(said=said)))
                connection.sendall(values)
            except ConnectionError:
                return
            del values, data
            signal.setitimer(signal.ITIMER_REAL, 0)


def _refusal(error: Exception) -> Refused:
    """What to say of an error."""
    if isinstance(error, MemoryError) or isinstance(error.__cause__, MemoryError):
        return Refused(detail=f"decoding the image takes too much memory: send a smaller one, or {AGAIN}")
    if isinstance(error, ImageError):
        limit = error.fields.get("limit")
        return Refused(detail=error.detail[:10_000], limit=limit if isinstance(limit, int) else None)
    return Refused(detail=f"the image can't be decoded: {error!r:.1000}; {AGAIN}")


def _confine(memory: int) -> None:
    """Take from this process what a decoder does not need."""
    # A terminal sends it to all: the service ends its children.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limits = {resource.RLIMIT_CORE: 0, resource.RLIMIT_FSIZE: 0}
    if sys.platform == "linux":
        Path("/proc/self/comm").write_text(NAME)
        limits[resource.RLIMIT_DATA] = in_use() + memory
    for limit, most in limits.items():
        _, hard = resource.getrlimit(limit)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(limit, (most, most))


def _keep_memory() -> None:
    """Have glibc keep some of what is freed: to get it anew for each small picture takes a third of the time."""
    with suppress(AttributeError, OSError):  # with another library of C
        library = ctypes.CDLL(None)
        for option in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD):
            library.mallopt(option, KEPT)


def _framed(message: BaseModel) -> bytes:
    text = message.model_dump_json().encode()
    return _HEAD.pack(len(text)) + text


def _read_head(connection: socket.socket, until: float | None = None) -> bytes:
    head = bytearray(_HEAD.size)
    _fill(connection, memoryview(head), until)
    (size,) = _HEAD.unpack(head)
    if size > _HEAD_BYTES:
        raise ValueError(f"a head of {size} bytes")
    text = bytearray(size)
    _fill(connection, memoryview(text), until)
    return bytes(text)


def _fill(connection: socket.socket, buffer: memoryview, until: float | None = None) -> None:
    """Fill a buffer with what comes."""
    while buffer:
        if until is not None:
            connection.settimeout(_left(until))
        count = connection.recv_into(buffer)
        if not count:
            raise EOFError("the other side has hung up")
        buffer = buffer[count:]


def _left(until: float) -> float:
    left = until - time.monotonic()
    if left <= 0:
        raise TimeoutError
    return left


def _signal_of(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
