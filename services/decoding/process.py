"""A process that decodes one picture after another: the service's side of it, and the child's.

Requests and answers are a few fields of JSON, followed by the bytes of a picture or of pixels. Answers are validated
and never unpickled: an attacker who takes over a decoder controls that process, but not the service.
"""

import ctypes
import errno
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

SPARE_SECONDS = 5.0
"""Time beyond a picture's limit after which a decoder ends itself, in case the service is gone."""
KEPT_BYTES = 32 << 20
"""Freed memory that a decoder keeps for the next picture."""
NAME = "decoder"
"""Name of the process in `ps -o comm` and `top`."""
ADVICE = "save it again with another program or in another format"
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)
_HEAD = struct.Struct("<I")
_HEAD_BYTES = 1 << 16
_BUFFER = 1 << 18  # of the socket, in bytes: large, for fewer context switches

Side = Annotated[int, Field(ge=1)]
Channels = Annotated[int, Field(ge=1, le=4)]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class _Request(_Strict):
    """Sent to a child before the bytes of a picture."""

    size: int
    transfer: Transfer
    memory: int
    seconds: float


class _Decoded(_Strict):
    """Sent by a child before the values of the pixels."""

    height: Side
    width: Side
    channels: Channels
    dtype: Literal["uint8", "uint16", "float32"]


class Refused(_Strict):
    """Sent by a child for a picture that can't be decoded: the fields of an `ImageError`."""

    detail: Annotated[str, Field(max_length=10_000)]
    limit: int | None = None


class _Answer(_Strict):
    result: _Decoded | Refused


class Decoder:
    """A process that decodes one picture after another.

    Parameters
    ----------
    memory : int
        Bytes that the process may allocate after its start.
    """

    def __init__(self, memory: int) -> None:
        self._socket, child_socket = socket.socketpair()
        try:
            with child_socket:
                context = multiprocessing.get_context("forkserver")
                self._process = context.Process(
                    target=_serve, args=(child_socket, memory), name=NAME, daemon=True
                )
                self._process.start()
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        except BaseException:
            self._socket.close()
            raise

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

    def ask(self, data: bytes, transfer: Transfer, memory: int, seconds: float) -> Codes | Floats | Refused:
        """Have the child decode a picture.

        Raises
        ------
        TimeoutError
            If it takes too long.
        OSError, EOFError
            If the child has ended.
        ValueError
            If its answer is invalid.
        """
        deadline = time.monotonic() + seconds
        request = _Request(size=len(data), transfer=transfer, memory=memory, seconds=seconds)
        self._socket.settimeout(seconds)
        self._socket.sendall(_framed(request))
        self._socket.settimeout(_remaining(deadline))
        self._socket.sendall(data)
        result = _Answer.model_validate_json(_read_head(self._socket, deadline)).result
        if isinstance(result, Refused):
            return result
        shape, dtype = (result.height, result.width, result.channels), np.dtype(result.dtype)
        if result.height * result.width * result.channels * dtype.itemsize > memory:
            raise ValueError(f"{shape} values of {dtype} take more than the limit of {memory} bytes")
        if dtype == np.float32 and result.channels not in (1, 3):
            raise ValueError(f"float pixels can't have {result.channels} channels")
        pixels = np.empty(shape, dtype)
        _fill(self._socket, pixels.data.cast("B"), deadline)
        return pixels

    def end(self) -> str:
        """Kill the process if it is alive; returns how it ended."""
        self._process.kill()
        self._process.join(SPARE_SECONDS)
        self._socket.close()
        code = self._process.exitcode
        return _signal_of(-code) if code is not None and code < 0 else f"exit code {code}"


def _serve(connection: socket.socket, memory: int) -> None:
    """Decode pictures in the child process until the service closes the socket."""
    _keep_memory()
    gc.freeze()  # a collection would touch, and so copy, all memory shared with the fork server: about 60 MB
    _confine(memory)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    with connection:
        while True:
            try:
                request = _Request.model_validate_json(_read_head(connection))
                # The kernel ends the process then: while native code hangs, no Python code runs here.
                signal.setitimer(signal.ITIMER_REAL, request.seconds + SPARE_SECONDS)
                data = connection.recv(request.size, socket.MSG_WAITALL)
            except (EOFError, ConnectionError):
                return
            values = memoryview(b"")
            result: _Decoded | Refused
            try:
                pixels = _decode(data, request.transfer, request.memory)
                height, width, channels = pixels.shape
                size = {"height": height, "width": width, "channels": channels}
                result = _Decoded.model_validate(size | {"dtype": pixels.dtype.name})
                values = pixels.data.cast("B")
                del pixels
            except Exception as error:
                result = _refusal(error)
            try:
                connection.sendall(_framed(_Answer(result=result)))
                connection.sendall(values)
            except ConnectionError:
                return
            del values, data
            signal.setitimer(signal.ITIMER_REAL, 0)


def _decode(data: bytes, transfer: Transfer, memory: int) -> Codes | Floats:
    try:
        return decode.decode(data, transfer, memory=memory)
    except ImageError as error:
        if getattr(error.__cause__, "errno", None) != errno.EFBIG:
            raise
    # numba has compiled a kernel and may not write it to its cache here. The kernel is in memory now.
    return decode.decode(data, transfer, memory=memory)


def _refusal(error: Exception) -> Refused:
    """The answer for an error; only errors of ours are passed on as they are."""
    if isinstance(error, MemoryError) or isinstance(error.__cause__, MemoryError):
        return Refused(detail=f"decoding the image takes too much memory: send a smaller one, or {ADVICE}")
    if isinstance(error, ImageError):
        limit = error.fields.get("limit")
        return Refused(detail=error.detail[:10_000], limit=limit if isinstance(limit, int) else None)
    return Refused(detail=f"the image can't be decoded: {error!r:.1000}; {ADVICE}")


def _confine(memory: int) -> None:
    """Limit this process to what a decoder needs."""
    # A terminal sends SIGINT to all processes; the service ends its children itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limits = {resource.RLIMIT_CORE: 0, resource.RLIMIT_FSIZE: 0}
    if sys.platform == "linux":
        Path("/proc/self/comm").write_text(NAME)
        limits[resource.RLIMIT_DATA] = in_use() + memory
    for limit, value in limits.items():
        _, hard = resource.getrlimit(limit)
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(limit, (value, value))


def _keep_memory() -> None:
    """Have glibc keep some freed memory: otherwise small pictures spend a third of their time on allocation."""
    with suppress(AttributeError, OSError):  # another C library
        library = ctypes.CDLL(None)
        for option in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD):
            library.mallopt(option, KEPT_BYTES)


def _framed(message: BaseModel) -> bytes:
    text = message.model_dump_json().encode()
    return _HEAD.pack(len(text)) + text


def _read_head(connection: socket.socket, deadline: float | None = None) -> bytes:
    head = bytearray(_HEAD.size)
    _fill(connection, memoryview(head), deadline)
    (size,) = _HEAD.unpack(head)
    if size > _HEAD_BYTES:
        raise ValueError(f"a head of {size} bytes")
    text = bytearray(size)
    _fill(connection, memoryview(text), deadline)
    return bytes(text)


def _fill(connection: socket.socket, buffer: memoryview, deadline: float | None = None) -> None:
    """Fill a buffer from a connection."""
    while buffer:
        if deadline is not None:
            connection.settimeout(_remaining(deadline))
        count = connection.recv_into(buffer)
        if not count:
            raise EOFError("the connection was closed")
        buffer = buffer[count:]


def _remaining(deadline: float) -> float:
    remaining = deadline - time.monotonic()
    if remaining <= 0:
        raise TimeoutError
    return remaining


def _signal_of(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
