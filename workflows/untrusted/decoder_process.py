"""A decoder: a process that reads untrusted files for another one, confined so that it can do nothing else."""

import ctypes
import io
import json
import os
import resource
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from storage.errors import EnvmatteError
from workflows.untrusted import confinement

Function = Callable[..., Iterator[dict[str, Any] | NDArray[Any]]]
"""What a decoder runs: it takes a file and arguments, and yields fields and arrays."""
NAME = "decoder"
"""Name of the process in `ps -o comm` and `top`."""
ADVICE = "save it again with another program or in another format"
HEAD = struct.Struct("<I")
"""Before each message of JSON: its length."""
ALIVE_SECONDS = 1.0
"""Time between two signs of life."""
PIECE = 1 << 18
"""Bytes that are read at a time of a file that is too large to be sent whole."""
KEPT_BYTES = 32 << 20
"""Freed memory that a decoder keeps for the next picture."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)
# The open files of a decoder besides the standard ones, which lead nowhere.
_CONNECTION, _OPEN_UNTIL_END = 3, 4

_signs: "_Signs | None" = None


def say_alive() -> None:
    """Tell the service that this decoder goes on, though it has no answer yet; outside of a decoder, do nothing."""
    if _signs:
        _signs.send()


def run(connection: int, open_until_end: int, memory: int) -> None:
    """Answer requests until the connection is closed.

    Parameters
    ----------
    connection, open_until_end : int
        File descriptors; the second is only kept open.
    memory : int
        Bytes that the process may allocate.
    """
    confinement.end_with_parent(signal.SIGKILL)
    copies = os.dup(connection), os.dup(open_until_end)  # the first is the smaller number
    for copy, number in zip(copies, (_CONNECTION, _OPEN_UNTIL_END), strict=True):
        os.dup2(copy, number)
    # The rest are the server's: a decoder that was taken over could ask it for others, or for their files.
    os.closerange(_OPEN_UNTIL_END + 1, os.sysconf("SC_OPEN_MAX"))
    null = os.open(os.devnull, os.O_RDWR)
    _keep_memory()
    _limit(memory)
    confinement.confine()
    for number in (0, 1, 2):  # afterwards, because an error should be seen
        os.dup2(null, number)
    os.close(null)
    file = io.FileIO(_CONNECTION, "r+")
    global _signs
    _signs = _Signs(file)
    _serve(file)


def _serve(connection: io.FileIO) -> None:
    """Run functions on files, as they are requested, and send what they yield."""
    while head := connection.read(HEAD.size):  # so few bytes come together
        request = json.loads(_read(connection, *HEAD.unpack(head)))
        sent, length = request["sent"], request["length"]
        file = _whole(connection, length) if sent else _remote(connection, length)
        module, _, name = request["function"].partition(":")
        answer: dict[str, Any]
        try:
            for found in getattr(import_module(module), name)(file, **request["arguments"]):
                if isinstance(found, np.ndarray):
                    values = np.ascontiguousarray(found)
                    _send(connection, {"shape": values.shape, "dtype": values.dtype.name})
                    _write(connection, values.reshape(-1).view(np.uint8).data)
                else:
                    _send(connection, {"value": found})
        except ConnectionError:
            return
        except Exception as error:
            answer = _refusal(error)
        else:
            answer = {"done": True}
        _send(connection, answer)


class _Signs:
    """Sends signs of life, not too many."""

    def __init__(self, connection: io.FileIO) -> None:
        self._connection, self._at = connection, time.monotonic()

    def send(self) -> None:
        if time.monotonic() - self._at > ALIVE_SECONDS:
            _send(self._connection, {"alive": True})
            self._at = time.monotonic()


class _Remote(io.RawIOBase):
    """A file of the service, of which each piece is asked for."""

    def __init__(self, connection: io.FileIO, length: int) -> None:
        self._connection, self._length, self._at = connection, length, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = max((0, self._at, self._length)[whence] + offset, 0)
        return self._at

    def readinto(self, buffer: Any) -> int:
        count = max(min(len(buffer), self._length - self._at, PIECE), 0)
        if count:
            _send(self._connection, {"read": self._at, "count": count})
            buffer[:count] = _read(self._connection, count)
            self._at += count
        return count


def _whole(connection: io.FileIO, length: int) -> BinaryIO:
    """A file that is sent whole. It is in memory once, also when a function has read all of it."""
    file = io.BytesIO()
    for start in range(0, length, PIECE):
        file.write(_read(connection, min(PIECE, length - start)))
    file.getvalue()  # cuts the buffer to its length; only then `read` shares it
    file.seek(0)
    return file


def _remote(connection: io.FileIO, length: int) -> BinaryIO:
    return io.BufferedReader(_Remote(connection, length), PIECE)


def _refusal(error: Exception) -> dict[str, Any]:
    """The answer for an error; only errors of ours are passed on as they are, others are for the log."""
    if isinstance(error, MemoryError) or isinstance(error.__cause__, MemoryError):
        return {"out_of_memory": True}
    if isinstance(error, EnvmatteError):
        limit = error.fields.get("limit")
        return {"refused": error.detail[:10_000], "limit": limit if isinstance(limit, int) else None}
    return {"failed": f"{error!r:.1000}"}


def in_use() -> int:
    """Bytes of this process that count towards RLIMIT_DATA, used or not; on Linux only."""
    return int(Path("/proc/self/statm").read_text().split()[5]) * os.sysconf("SC_PAGE_SIZE")


def _limit(memory: int) -> None:
    """Limit the resources of this process."""
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


def _send(connection: io.FileIO, message: dict[str, Any]) -> None:
    text = json.dumps(message).encode()
    _write(connection, memoryview(HEAD.pack(len(text)) + text))


def _write(connection: io.FileIO, data: memoryview) -> None:
    while data:
        data = data[connection.write(data) :]


def _read(connection: io.FileIO, count: int) -> bytearray:
    """Read so many bytes; the decoder ends if there are fewer."""
    data = bytearray(count)
    left = memoryview(data)
    while left:
        got = connection.readinto(left)
        if not got:
            raise ConnectionError("the service has closed the connection")
        left = left[got:]
    return data
