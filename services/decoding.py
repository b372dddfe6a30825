"""Pictures that strangers send are decoded in processes that the service can lose.

A decoder is native code, and a file may crash it, keep it for ever, or have it take all memory. So each picture goes to
a child process, forked from the one that workers are forked from, that has limits of memory and of time. What comes
back is a few fields of JSON and the bytes of pixels, which are checked, and never unpickled: who takes a decoder over
has that process, and not the service.
"""

import ctypes
import gc
import logging
import multiprocessing
import os
import resource
import signal
import socket
import struct
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from storage.errors import ImageError, Unavailable
from workflows import pictures
from workflows.floats import Floats
from workflows.images import Codes
from workflows.pictures import Transfer

logger = logging.getLogger(__name__)

SECONDS = 20.0
"""That decoding a picture may take: some five at most take the largest there may be, on a machine with nothing else."""
SPARE = 5.0
"""Seconds more, after which a child whose service is gone ends by itself, whatever it is doing."""
COPIES, BESIDES = 8, 256 << 20
"""Pictures of the largest size that a child has room for, one of them as it was sent, and bytes besides."""
KEPT = 32 << 20
"""Bytes of memory that a child keeps for the next picture."""
NAME = "decoder"
"""Of a child, as `ps -o comm` and `top` show it."""
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


class _Refused(_Strict):
    """What it says of a picture that can't be used, as `ImageError` has it."""

    detail: Annotated[str, Field(max_length=10_000)]
    fields: dict[str, str | int | float]


class _Answer(_Strict):
    said: _Decoded | _Refused


class Decoders:
    """Child processes that decode pictures, as many as are asked for at once, each of which is kept for the next.

    Parameters
    ----------
    memory : int
        Bytes that a decoded picture may take.
    seconds : float
        That decoding one may take.
    """

    def __init__(self, memory: int, seconds: float = SECONDS) -> None:
        self._memory, self._seconds = memory, seconds
        self._lock = threading.Lock()
        self._idle: list[_Child] = []
        self._children: set[_Child] = set()
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
        if isinstance(answer, _Refused):
            raise ImageError(answer.detail, **answer.fields)
        return answer

    def close(self) -> None:
        """End the children, whatever they are doing."""
        with self._lock:
            self._closed = True
            children = list(self._children)
        for child in children:
            child.end()

    def _take(self) -> "_Child":
        """A child that has nothing to do."""
        while True:
            with self._lock:
                if self._closed:
                    raise Unavailable("the service is being stopped; send it again to the next one")
                child = self._idle.pop() if self._idle else None
                if child is None:
                    break
            if child.is_waiting():
                return child
            logger.warning("a decoder that had nothing to do is gone: %s", child.end())
            with self._lock:
                self._children.discard(child)
        child = _Child(COPIES * self._memory + BESIDES)
        with self._lock:
            self._children.add(child)
        return child


class _Child:
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

    def ask(self, data: bytes, transfer: Transfer, memory: int, seconds: float) -> Codes | Floats | _Refused:
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
        if isinstance(said, _Refused):
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
            said: _Decoded | _Refused
            try:
                pixels = pictures.decode(data, asked.transfer, memory=asked.memory)
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


def _refusal(error: Exception) -> _Refused:
    """What to say of an error."""
    if isinstance(error, MemoryError) or isinstance(error.__cause__, MemoryError):
        return _Refused(
            detail=f"decoding the image takes too much memory: send a smaller one, or {AGAIN}", fields={}
        )
    if isinstance(error, ImageError):
        return _Refused(detail=error.detail[:10_000], fields=error.fields)
    return _Refused(detail=f"the image can't be decoded: {error!r:.1000}; {AGAIN}", fields={})


def _confine(memory: int) -> None:
    """Take from this process what a decoder does not need."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # which a terminal sends to all: the service ends its children
    limits = {resource.RLIMIT_CORE: 0, resource.RLIMIT_FSIZE: 0}
    if sys.platform == "linux":
        Path("/proc/self/comm").write_text(NAME)
        pages = int(Path("/proc/self/statm").read_text().split()[5])
        limits[resource.RLIMIT_DATA] = pages * os.sysconf("SC_PAGE_SIZE") + memory
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
