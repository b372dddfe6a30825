"""Rows of tables that have ids: new ids, lookups, pages."""

import secrets
import time
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, Table, select

from storage.errors import NotFound


def new_id() -> str:
    """An opaque, URL-safe id that can't be guessed."""
    return secrets.token_hex(10)


def lifetime(seconds: float | None) -> dict[str, float | None]:
    """The times of a row that is made now, and kept for so long, or until it is deleted."""
    now = time.time()
    return {"created_at": now, "expires_at": None if seconds is None else now + seconds}


def find(connection: Connection, table: Table, id: str) -> Row[Any]:
    """The row of a capture, a job or a matte.

    Raises
    ------
    NotFound
        If there is none.
    """
    row = connection.execute(select(table).where(table.c.id == id)).one_or_none()
    if row is None:
        one = table.name.removesuffix("s")
        raise NotFound(f"there is no {one} {id!r}; GET /v1/{table.name} lists those there are")
    return row


def page(
    connection: Connection, table: Table, limit: int, after: str | None, **equal: str | None
) -> Sequence[Row[Any]]:
    """Rows of a table with ids and numbers, newest first.

    Parameters
    ----------
    after : str, optional
        The id of the last row of the page before.
    **equal : str or None
        Columns that must have a value; None asks for any.

    Raises
    ------
    NotFound
        If there is no row ``after``.
    """
    query = select(table).order_by(table.c.number.desc()).limit(limit)
    for column, value in equal.items():
        if value is not None:
            query = query.where(table.c[column] == value)
    if after is not None:
        number = connection.scalar(select(table.c.number).where(table.c.id == after))
        if number is None:
            raise NotFound(
                f"there is no {after!r} to go on after; leave `after` out to start again", field="after"
            )
        query = query.where(table.c.number < number)
    return connection.execute(query).all()
