"""Uploads under way: a record each, and the bytes that have come, in parts.

In the store, ``uploads/ID/NAME.part``, an object for each stretch of bytes: a bucket can append to none. Which of
them count, and in which order, the database says: a part is stored first and then written down, so that a killed
writer leaves one that nothing refers to, and of two writers at one offset the first to write it down wins. An
archive that is complete gets an index, ``uploads/ID/parts.json``, for workers, who have no database; it keeps its
id and its place as a capture.
"""

from __future__ import annotations

import io
import json
from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, BinaryIO

from storage.errors import Corrupt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from storage.objects.store import Objects

INDEX = "parts.json"


@dataclass(frozen=True)
class Part:
    """A stretch of an upload: the name of its object, and its bytes."""

    name: str
    size: int


def path(upload: str) -> str:
    """Where an upload lies in the store, and the archive of a capture until it is ingested."""
    return f"uploads/{upload}"


def part_path(upload: str, name: str) -> str:
    """Where a part of it lies."""
    return f"{path(upload)}/{name}.part"


def remove(objects: Objects, upload: str) -> None:
    """Remove the bytes of an upload whose row is deleted, and of an archive that is ingested."""
    # Whoever writes to it still, and makes a file here meanwhile, finds the row gone and removes what he wrote.
    with suppress(OSError):
        objects.delete(path(upload))


def seal(objects: Objects, upload: str, parts: Sequence[Part]) -> None:
    """Write the index of an upload that is complete, so that `read` can read it."""
    objects.put(f"{path(upload)}/{INDEX}", json.dumps([[part.name, part.size] for part in parts]).encode())


def read(objects: Objects, upload: str) -> BinaryIO:
    """A seekable file over the parts of a sealed upload; reading it is `Corrupt` where a part is cut short.

    Raises
    ------
    FileNotFoundError
        If there is none, or one of its parts is missing.
    """
    with objects.read(f"{path(upload)}/{INDEX}") as file:
        parts = [Part(name, size) for name, size in json.load(file)]
    missing = {f"{part.name}.part" for part in parts} - set(objects.names(path(upload)))
    if missing:
        raise FileNotFoundError(f"{path(upload)}/{min(missing)}")
    return io.BufferedReader(_Joined(objects, upload, parts), 1 << 16)


def sweep(objects: Objects, upload: str, parts: Sequence[str]) -> None:
    """Remove what killed writers have left of an upload that nobody writes to: all but its parts, by their names."""
    known = {f"{part}.part" for part in parts}
    for name in objects.names(path(upload)):
        if name not in known:
            objects.delete(f"{path(upload)}/{name}")


class _Joined(io.RawIOBase):
    """Parts as one raw file, of which one is open at a time: an archive of gigabytes is read without a copy."""

    def __init__(self, objects: Objects, upload: str, parts: Sequence[Part]) -> None:
        self._paths = [part_path(upload, part.name) for part in parts]
        self._objects = objects
        self._starts = list(accumulate((part.size for part in parts), initial=0))
        self._at = 0
        self._open: tuple[int, BinaryIO] | None = None

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = (0, self._at, self._starts[-1])[whence]
        if base + offset < 0:
            raise ValueError(f"a seek to {base + offset}, before the start")
        self._at = base + offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        n = bisect_right(self._starts, self._at) - 1
        if n == len(self._paths):
            return 0
        file = self._part(n)
        file.seek(self._at - self._starts[n])
        count = file.readinto(memoryview(buffer)[: self._starts[n + 1] - self._at])  # type: ignore[attr-defined]
        if not count:
            raise Corrupt(f"{self._paths[n]} is shorter than it was; upload the capture again")
        self._at += count
        return int(count)

    def close(self) -> None:
        if self._open:
            self._open[1].close()
            self._open = None
        super().close()

    def _part(self, n: int) -> BinaryIO:
        if self._open is None or self._open[0] != n:
            if self._open:
                self._open[1].close()
            self._open = n, self._objects.read(self._paths[n])
        return self._open[1]
