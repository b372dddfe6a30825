"""Rows of uploads under way: their offsets, parts and expiry."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Row, func, insert, select, update

from storage.database.owners import across_owners
from storage.database.tables import upload_parts as table
from storage.database.tables import uploads
from storage.errors import Conflict, NoRoom, NotFound
from storage.layout.uploads import Part

if TYPE_CHECKING:
    from storage.objects.store import Objects

MAX_PARTS = 10_000
"""Parts of one upload: what whoever reads it has to know of it stays below a megabyte."""


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


def delete(connection: Connection, upload: str) -> bool:
    """Delete an upload's row; false if there was none."""
    return bool(connection.execute(uploads.delete().where(uploads.c.id == upload)).rowcount)


def delete_expired(connection: Connection) -> list[str]:
    """Delete the rows of uploads whose time is over; returns their ids."""
    query = uploads.delete().where(uploads.c.expires_at <= time.time()).returning(uploads.c.id)
    return list(connection.scalars(query))


def check_room(connection: Connection, objects: Objects, length: int) -> None:
    """See that the store has room for more bytes, besides those that unfinished uploads are still to bring.

    Raises
    ------
    NoRoom
    """
    free = objects.free_bytes()
    if free is None:
        return
    promised = connection.scalar(across_owners(select(func.sum(uploads.c.length - uploads.c.offset)))) or 0
    missing = length + int(promised) - free
    if missing > 0:
        raise NoRoom(
            f"the store has no room for {length} bytes: {free} are free, {promised} of them promised to unfinished "
            f"uploads. Delete captures, mattes or uploads, or free {missing} bytes on the disk",
            missing=missing,
        )
