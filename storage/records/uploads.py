"""Rows of resumable uploads: their offsets, parts and expiry, by the database's clock."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from storage.database.dialects import clock
from storage.database.rows import lifetime
from storage.database.tables import upload_parts as table
from storage.database.tables import uploads
from storage.errors import Conflict, NotFound
from storage.layout.uploads import Part

MOST = 1000
"""Expired rows that are deleted in one transaction, while other writers wait."""

MAX_PARTS = 10_000
"""Most parts of an upload: keeps its index below a megabyte."""


def add(
    connection: Connection, upload: str, length: int, metadata: str, seconds: float, key: str | None
) -> None:
    """Add an upload of which no bytes have arrived yet.

    Parameters
    ----------
    length : int
        Its bytes in total.
    metadata : str
        The client's ``Upload-Metadata``, as sent.
    seconds : float
        How long it is kept after it was created, or after its last part arrived.
    key : str, optional
        The client's Idempotency-Key; a key has at most one upload.
    """
    row = {"id": upload, "key": key, "offset": 0, "parts": 0, "length": length, "metadata": metadata}
    connection.execute(insert(uploads).values(row | {"moved_at": clock()} | lifetime(seconds)))


def get(connection: Connection, upload: str) -> Row[Any]:
    """An upload's row.

    Raises
    ------
    NotFound
        If there is none, or it has expired. tus would allow to tell the two apart, but that would need a record of
        every expired upload.
    """
    query = select(uploads).where(uploads.c.id == upload, uploads.c.expires_at > clock())
    row = connection.execute(query).one_or_none()
    if row is None:
        raise NotFound(
            f"there is no upload {upload!r}: it has expired, was deleted or became a capture; start a new upload"
        )
    return row


def by_key(connection: Connection, key: str) -> Row[Any] | None:
    """The upload that was created with an Idempotency-Key, if it still exists."""
    return connection.execute(select(uploads).where(uploads.c.key == key)).one_or_none()


def advance(connection: Connection, upload: str, offset: int, parts: Sequence[Part], seconds: float) -> int:
    """Record stored parts; returns the offset after them.

    Raises
    ------
    Conflict
        If the upload is not at ``offset``, because another writer was faster.
    NotFound
        If it does not exist any more.
    """
    starts = list(accumulate((part.size for part in parts), initial=offset))
    result = connection.execute(
        update(uploads)
        .where(uploads.c.id == upload, uploads.c.offset == offset)
        .values(offset=starts[-1], parts=uploads.c.parts + len(parts), expires_at=clock() + seconds)
    )
    if not result.rowcount:
        check_offset(get(connection, upload), offset)
    for start, part in zip(starts, parts, strict=False):
        row = {"upload": upload, "offset": start, "name": part.name, "size": part.size}
        connection.execute(insert(table).values(row))
    return starts[-1]


def check_offset(row: Row[Any], offset: int) -> None:
    """Check that an upload is at an offset.

    Raises
    ------
    Conflict
    """
    if row.offset != offset:
        raise Conflict(
            f"upload {row.id} is at byte {row.offset}, not {offset}; request its offset and continue from there",
            offset=row.offset,
        )


def parts_of(connection: Connection, upload: str) -> list[Part]:
    """The parts of an upload, in order."""
    query = select(table.c.name, table.c.size).where(table.c.upload == upload).order_by(table.c.offset)
    return [Part(name, size) for name, size in connection.execute(query)]


def delete(connection: Connection, upload: str) -> bool:
    """Delete an upload's row; returns false if there was none."""
    return bool(connection.execute(uploads.delete().where(uploads.c.id == upload)).rowcount)


def delete_expired(connection: Connection) -> list[str]:
    """Delete the rows of expired uploads, `MOST` at most; returns their ids."""
    query = select(uploads.c.id).where(uploads.c.expires_at <= clock()).limit(MOST)
    expired = list(connection.scalars(query))
    if expired:
        connection.execute(uploads.delete().where(uploads.c.id.in_(expired)))
    return expired
