"""Rows of tables that have ids: new ids, lookup by id, and pages."""

import json
import secrets
from collections.abc import Container, Iterator
from typing import Any

from sqlalchemy import Column, Connection, Row, Table, select

from storage.database.dialects import clock
from storage.errors import NotFound

ROW = 1000
"""Bytes that a row of a capture, matte, job or upload takes, with what an attempt at a job logs."""

PAUSE = 200
"""Bytes that the two lines take that are logged when a job pauses and continues."""


def new_id() -> str:
    """A random, URL-safe id that cannot be guessed."""
    return secrets.token_hex(10)


def lifetime(seconds: float | None) -> dict[str, Any]:
    """``created_at`` and ``expires_at`` of a row created now; it never expires if `seconds` is None.

    By the database's clock: another machine than the one that creates the row deletes it.
    """
    now = clock()
    return {"created_at": now, "expires_at": None if seconds is None else now + seconds}


def json_bytes(document: Any) -> int:
    """Bytes that a document takes in a row: users choose how large some are, so they count as stored."""
    return len(json.dumps(document))


def find(connection: Connection, table: Table, id: str, without: Container[str] = ()) -> Row[Any]:
    """The row of a capture, a job or a matte.

    Parameters
    ----------
    without : container of str
        Columns that are not read.

    Raises
    ------
    NotFound
        If there is none.
    """
    row = connection.execute(select(*_columns(table, without)).where(table.c.id == id)).one_or_none()
    if row is None:
        one = table.name.removesuffix("s")
        raise NotFound(f"there is no {one} {id!r}; GET /v1/{table.name} lists them")
    return row


def page(
    connection: Connection,
    table: Table,
    limit: int,
    after: str | None,
    without: Container[str] = (),
    name: str | None = None,
    **equal: str | None,
) -> Iterator[Row[Any]]:
    """One page of a table's rows, newest first; the table has the columns ``id`` and ``number``.

    Parameters
    ----------
    after : str, optional
        The id of the last row of the previous page.
    without : container of str
        Columns that are not read.
    name : str, optional
        What is in the name of the rows, in upper or lower case.
    **equal : str or None
        Values that columns must have; None matches any value.

    Raises
    ------
    NotFound
        If there is no row with the id ``after``.
    """
    query = select(*_columns(table, without)).order_by(table.c.number.desc()).limit(limit)
    for column, value in equal.items():
        if value is not None:
            query = query.where(table.c[column] == value)
    if name:
        query = query.where(table.c.name.icontains(name, autoescape=True))
    if after is not None:
        number = connection.scalar(select(table.c.number).where(table.c.id == after))
        if number is None:
            raise NotFound(
                f"there is no {after!r} to continue after; omit `after` to start with the newest",
                field="after",
            )
        query = query.where(table.c.number < number)
    # Few rows are in memory at a time: a program takes up to a megabyte once it is read.
    return iter(connection.execute(query.execution_options(yield_per=20)))


def _columns(table: Table, without: Container[str]) -> list[Column[Any]]:
    return [column for column in table.c if column.name not in without]
