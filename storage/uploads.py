"""Uploads under way: a record each, and the bytes that have come, in parts.

In the store, ``uploads/ID/NAME.part``, an object for each stretch of bytes: a bucket can append to none. Which of
them count, and in which order, the database says: a part is stored first and then written down, so that a killed
writer leaves one that nothing refers to, and of two writers at one offset the first to write it down wins. An
archive that is complete gets an index, ``uploads/ID/parts.json``, for workers, who have no database; it keeps its
id and its place as a capture.
"""

import io
import json
import time
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, BinaryIO

from sqlalchemy import Connection, Row, delete, func, insert, select, update

from storage.database import upload_parts as table
from storage.database import uploads
from storage.errors import Conflict, Corrupt, NoRoom, NotFound
from storage.objects import Objects
from storage.owners import of_all

INDEX = "parts.json"
MOST_PARTS = 10_000
"""Parts of one upload: what whoever reads it has to know of it stays below a megabyte."""


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


def add(
    connection: Connection, upload: str, length: int, metadata: str, seconds: float, key: str | None
) -> None:
    """Write down a new upload, of which nothing has come yet.

    Parameters
    ----------
    length : int
        Bytes that it will have.
    metadata : str
        What the client says about it, as it is sent.
    seconds : float
        How long it is kept, from now and again from every part on.
    key : str, optional
        Idempotency-Key of who made it: there is one upload for a key.
    """
    now = time.time()
    row = {"id": upload, "key": key, "offset": 0, "parts": 0, "length": length, "metadata": metadata}
    connection.execute(insert(uploads).values(row | {"created_at": now, "expires_at": now + seconds}))


def get(connection: Connection, upload: str) -> Row[Any]:
    """An upload's row.

    Raises
    ------
    NotFound
        If there is none, or not any more. tus would like to know which, but that would take a record of every upload
        that ever expired.
    """
    query = select(uploads).where(uploads.c.id == upload, uploads.c.expires_at > time.time())
    row = connection.execute(query).one_or_none()
    if row is None:
        raise NotFound(
            f"there is no upload {upload!r}: it has expired, was deleted or became a capture; start a new one"
        )
    return row


def by_key(connection: Connection, key: str) -> Row[Any] | None:
    """The upload that was made with an Idempotency-Key, if it is still there."""
    return connection.execute(select(uploads).where(uploads.c.key == key)).one_or_none()


def advance(connection: Connection, upload: str, offset: int, parts: Sequence[Part], seconds: float) -> int:
    """Write down parts that are stored; returns the offset after them.

    Raises
    ------
    Conflict
        If the upload does not stand at ``offset``: another writer was quicker.
    NotFound
        If it is gone.
    """
    starts = list(accumulate((part.size for part in parts), initial=offset))
    result = connection.execute(
        update(uploads)
        .where(uploads.c.id == upload, uploads.c.offset == offset)
        .values(offset=starts[-1], parts=uploads.c.parts + len(parts), expires_at=time.time() + seconds)
    )
    if not result.rowcount:
        check_offset(get(connection, upload), offset)
    for start, part in zip(starts, parts, strict=False):
        row = {"upload": upload, "offset": start, "name": part.name, "size": part.size}
        connection.execute(insert(table).values(row))
    return starts[-1]


def check_offset(row: Row[Any], offset: int) -> None:
    """See that an upload stands at an offset.

    Raises
    ------
    Conflict
    """
    if row.offset != offset:
        raise Conflict(
            f"upload {row.id} stands at byte {row.offset}, not {offset}; ask for its offset and go on from there",
            offset=row.offset,
        )


def parts_of(connection: Connection, upload: str) -> list[Part]:
    """The parts of an upload, in order."""
    query = select(table.c.name, table.c.size).where(table.c.upload == upload).order_by(table.c.offset)
    return [Part(name, size) for name, size in connection.execute(query)]


def forget(connection: Connection, upload: str) -> bool:
    """Delete an upload's row; false if there was none."""
    return bool(connection.execute(delete(uploads).where(uploads.c.id == upload)).rowcount)


def forget_expired(connection: Connection) -> list[str]:
    """Delete the rows of uploads whose time is over; returns their ids."""
    query = delete(uploads).where(uploads.c.expires_at <= time.time()).returning(uploads.c.id)
    return list(connection.scalars(query))


def remove(objects: Objects, upload: str) -> None:
    """Remove the bytes of an upload whose row is deleted, and of an archive that is ingested."""
    # Whoever writes to it still, and makes a file here meanwhile, finds the row gone and removes what he wrote.
    with suppress(OSError):
        objects.delete(path(upload))


def check_room(connection: Connection, objects: Objects, length: int) -> None:
    """See that the store has room for more bytes, besides those that unfinished uploads are still to bring.

    Raises
    ------
    NoRoom
    """
    free = objects.free()
    if free is None:
        return
    promised = connection.scalar(of_all(select(func.sum(uploads.c.length - uploads.c.offset)))) or 0
    missing = length + int(promised) - free
    if missing > 0:
        raise NoRoom(
            f"the store has no room for {length} bytes: {free} are free, {promised} of them promised to unfinished "
            f"uploads. Delete captures, mattes or uploads, or free {missing} bytes on the disk",
            missing=missing,
        )


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
