"""Links that let anyone see one matte, without a key, until they expire or are deleted.

A link ends with a token of 256 random bits, which is shown once; the database keeps its hash, as of an API key.
"""

import secrets
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, delete, func, insert, select

from storage.database.dialects import clock
from storage.database.rows import lifetime, new_id
from storage.database.tables import links
from storage.errors import Conflict, NotFound
from storage.records.api_keys import hash_of

MOST = 100
"""Links to a matte at once."""


def create(connection: Connection, matte: str, seconds: float) -> tuple[str, Row[Any]]:
    """Create a link to a matte; returns its token, which cannot be read again later, and its row.

    Raises
    ------
    Conflict
        If the matte has as many as it may.
    """
    of_matte = select(func.count()).select_from(links).where(links.c.matte == matte)
    if connection.scalar(of_matte) >= MOST:  # type: ignore[operator]
        raise Conflict(f"matte {matte} has {MOST} links already: delete one first")
    token = secrets.token_urlsafe(32)
    row = {"id": new_id(), "hash": hash_of(token), "matte": matte} | lifetime(seconds)
    return token, connection.execute(insert(links).values(row).returning(links)).one()


def find(connection: Connection, token: str) -> Row[Any]:
    """The row of a link, by its token.

    Raises
    ------
    NotFound
        If there is none, or it has expired.
    """
    query = select(links).where(links.c.hash == hash_of(token), links.c.expires_at > clock())
    row = connection.execute(query).one_or_none()
    if row is None:
        raise NotFound("this link has expired or was deleted: ask the person who sent it for another")
    return row


def list_all(connection: Connection, matte: str) -> Sequence[Row[Any]]:
    """The links to a matte that have not expired, newest first."""
    query = select(links).where(links.c.matte == matte, links.c.expires_at > clock())
    return connection.execute(query.order_by(links.c.created_at.desc())).all()


def remove(connection: Connection, matte: str, link: str) -> None:
    """Delete a link to a matte; it stops working at the end of the transaction.

    Raises
    ------
    NotFound
        If there is none of this id.
    """
    gone = connection.execute(delete(links).where(links.c.matte == matte, links.c.id == link))
    if gone.rowcount == 0:
        raise NotFound(f"matte {matte} has no link {link!r}; GET /v1/mattes/{matte}/links lists its links")


def delete_expired(connection: Connection) -> None:
    """Delete the links that have expired."""
    connection.execute(delete(links).where(links.c.expires_at <= clock()))
