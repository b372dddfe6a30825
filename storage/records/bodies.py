"""Rows of bodies: requests whose bytes are coming in, and how many bytes are reserved for each.

Limits count what is reserved, so that bytes count before they are there, and in every process. A body that belongs to
an upload is its only writer. A request renews its row while it goes on. A row that nobody has renewed for `LAPSE`
seconds counts no more: its process has died, or the database was away or the clock jumped, and a renewal revives it.
Times are by the database's clock, as the clocks of hosts may differ.
"""

from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, case, delete, insert, select, update

from storage.database.dialects import clock
from storage.database.tables import bodies, uploads
from storage.errors import Conflict

RENEW = 10.0
"""Seconds between two renewals."""
LAPSE = 30.0
"""Seconds after which a row counts no more unless it is renewed."""
PATIENCE = 5.0
"""Seconds that a request waits for the writer of its upload to end."""
FORGET = 86400.0
"""Seconds after which it is deleted. A clock may jump by hours."""


def add(connection: Connection, body: str, size: int, length: int) -> None:
    """Reserve bytes for a body that comes as a whole, the first of `length`."""
    connection.execute(insert(bodies).values(_row(body, size) | {"length": length}))


def claim(connection: Connection, body: str, upload: str, size: int) -> bool:
    """Become the writer of an upload and reserve bytes; false, without a change, while another request writes it."""
    connection.execute(delete(bodies).where(bodies.c.upload == upload, ~under_way()))
    if has_writer(connection, upload):
        return False
    connection.execute(insert(bodies).values(_row(body, size) | {"upload": upload}))
    _move(connection, upload)
    return True


def has_writer(connection: Connection, upload: str) -> bool:
    """Whether a request is writing an upload."""
    query = select(bodies.c.id).where(bodies.c.upload == upload, under_way())
    return connection.scalar(query) is not None


def ask_for(connection: Connection, upload: str) -> None:
    """Ask the writer of an upload to leave it to another request, which waits for `PATIENCE`."""
    connection.execute(update(bodies).where(bodies.c.upload == upload).values(wanted_at=clock()))


def _row(body: str, size: int) -> dict[str, Any]:
    return {"id": body, "length": size, "bytes": size, "stored": 0, "renewed_at": clock()}


def is_wanted(connection: Connection, body: str) -> bool:
    """Whether another request waits for the upload of a body.

    Raises
    ------
    Conflict
        If the row is gone: the upload was deleted, or the row has lapsed.
    """
    row = _get(connection, body)
    return row.wanted_at is not None and abs(row.now - row.wanted_at) < PATIENCE


def renew(connection: Connection, body: str, stored: int, more: int = 0) -> None:
    """Keep a body's row from lapsing.

    Parameters
    ----------
    stored : int
        Bytes that are in the store by now.
    more : int
        Bytes to reserve in addition.

    Raises
    ------
    Conflict
        As for `is_wanted`.
    """
    row = _get(connection, body)
    size = row.bytes + more
    values = {"renewed_at": clock(), "stored": stored, "bytes": size, "length": max(size, row.length)}
    connection.execute(update(bodies).where(bodies.c.id == body).values(values))
    if row.upload is not None:
        _move(connection, row.upload)


def _get(connection: Connection, body: str) -> Row[Any]:
    row = connection.execute(select(bodies, clock().label("now")).where(bodies.c.id == body)).one_or_none()
    if row is None:
        raise Conflict("what this request was sending has been deleted, or it took too long; start again")
    return row


def record(connection: Connection, body: str, size: int) -> None:
    """Reserve so many bytes less, which from now on count as stored for the body's upload."""
    values = {"length": bodies.c.length - size, "bytes": bodies.c.bytes - size, "stored": 0}
    connection.execute(update(bodies).where(bodies.c.id == body).values(values))


def _move(connection: Connection, upload: str) -> None:
    """Note that an upload is being written: it does not expire before its writer lapses."""
    now, expiry = clock(), uploads.c.expires_at
    times = {"moved_at": now, "expires_at": case((expiry < now + LAPSE, now + LAPSE), else_=expiry)}
    connection.execute(update(uploads).where(uploads.c.id == upload).values(times))


def release(connection: Connection, body: str) -> None:
    """Release what is reserved for a body."""
    connection.execute(delete(bodies).where(bodies.c.id == body))


def delete_lapsed(connection: Connection, seconds: float = FORGET) -> None:
    """Delete the rows that were not renewed for some time; pass 0 only if no request is under way."""
    connection.execute(delete(bodies).where(bodies.c.renewed_at <= clock() - seconds))


def under_way() -> ColumnElement[bool]:
    """The condition that selects rows that have not lapsed."""
    now = clock()
    return bodies.c.renewed_at.between(now - LAPSE, now + LAPSE)  # later: the clock has gone back since
