"""Bytes of uploads in the store, in parts.

Each part is an object ``uploads/ID/NAME.part``, because objects in a bucket cannot be appended to. The database says
which parts belong to an upload, and in which order. A part is stored first and recorded then: a writer that is killed
in between leaves an object that nothing refers to, and of two writers at the same offset the first to record its part
wins. A complete upload gets an index, ``uploads/ID/parts.json``, for workers, which do not use the database. An upload
that becomes a capture keeps its id and its place. While a film is ingested, ``uploads/ID/sums/NAME`` are sums of its
frames, see `workflows.ingest.plateau_sums`; they are removed with it.
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
SUMS = "sums"


@dataclass(frozen=True)
class Part:
    """A part of an upload: the name of its object and its size in bytes."""

    name: str
    size: int


def path(upload: str) -> str:
    """Path of an upload in the store, and of the archive of a capture until it is ingested."""
    return f"uploads/{upload}"


def part_path(upload: str, name: str) -> str:
    """Path of a part of an upload."""
    return f"{path(upload)}/{name}.part"


def remove(objects: Objects, upload: str) -> None:
    """Remove the bytes of an upload whose row is deleted, or of an archive that is ingested."""
    # A request that is still writing here may create a file meanwhile; it finds the row deleted and cleans up itself.
    with suppress(OSError):
        objects.delete(path(upload))


def seal(objects: Objects, upload: str, parts: Sequence[Part]) -> None:
    """Write the index of a complete upload, which `read` needs."""
    objects.put(f"{path(upload)}/{INDEX}", json.dumps([[part.name, part.size] for part in parts]).encode())


def put_sum(objects: Objects, upload: str, name: str, data: memoryview) -> None:
    """Keep a sum of frames of an archive's film until it is ingested."""
    objects.put(f"{path(upload)}/{SUMS}/{name}", data)


def sums(objects: Objects, upload: str) -> set[str]:
    """The names of all that `put_sum` has kept."""
    return set(objects.names(f"{path(upload)}/{SUMS}"))


def read_sum(objects: Objects, upload: str, name: str) -> BinaryIO:
    """A file over what `put_sum` has kept."""
    return objects.read(f"{path(upload)}/{SUMS}/{name}")


def read(objects: Objects, upload: str) -> BinaryIO:
    """A seekable file over the parts of a sealed upload; reading raises `Corrupt` where a part is damaged.

    Raises
    ------
    FileNotFoundError
        If there is no index, or a part is missing.
    """
    with objects.read(f"{path(upload)}/{INDEX}") as file:
        parts = [Part(name, size) for name, size in json.load(file)]
    missing = {f"{part.name}.part" for part in parts} - set(objects.names(path(upload)))
    if missing:
        raise FileNotFoundError(f"{path(upload)}/{min(missing)}")
    return io.BufferedReader(_Joined(objects, upload, parts), 1 << 16)


def sweep(objects: Objects, upload: str, parts: Sequence[str]) -> None:
    """Remove what killed writers have left of an upload that no request writes to: everything but the named parts."""
    known = {f"{part}.part" for part in parts}
    for name in objects.names(path(upload)):
        if name not in known:
            objects.delete(f"{path(upload)}/{name}")


class _Joined(io.RawIOBase):
    """Parts as one raw file; only one part is open at a time, so an archive of gigabytes is read without a copy."""

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
            raise ValueError(f"seek to {base + offset}, before the start")
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
            raise Corrupt(f"{self._paths[n]} is shorter than when it was stored; upload the capture again")
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
