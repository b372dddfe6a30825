"""Rows of mattes."""

from typing import Any

from sqlalchemy import Connection, Row, insert, update

from storage.database.rows import find, lifetime
from storage.database.tables import mattes
from storage.errors import Conflict


def add(
    connection: Connection,
    matte: str,
    capture: str,
    job: str,
    options: dict[str, Any],
    seconds: float | None = None,
) -> None:
    """Write down a matte that a job is to recover, and that is kept for some time, or until it is deleted."""
    row = {"id": matte, "capture": capture, "job": job, "state": "recovering", "options": options}
    connection.execute(insert(mattes).values(row | lifetime(seconds)))


def add_imported(
    connection: Connection,
    matte: str,
    options: dict[str, Any],
    figures: dict[str, Any],
    stored: int | None = None,
    seconds: float | None = None,
) -> None:
    """Write down a matte that came in an archive, and is whole: it has no capture and no job here."""
    row = {"id": matte, "state": "ready", "options": options, "figures": figures, "stored": stored}
    connection.execute(insert(mattes).values(row | lifetime(seconds)))


def get(connection: Connection, matte: str) -> Row[Any]:
    """A matte's row; `NotFound` if there is none."""
    return find(connection, mattes, matte)


def get_ready(connection: Connection, matte: str) -> Row[Any]:
    """The row of a matte that is recovered.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it is not ready.
    """
    row = get(connection, matte)
    if row.state != "ready":
        raise Conflict(f"matte {matte} is {row.state}; job {row.job} says more")
    return row


def change(connection: Connection, matte: str, **values: Any) -> None:
    """Change a matte's row."""
    connection.execute(update(mattes).where(mattes.c.id == matte).values(values))


def delete(connection: Connection, matte: str) -> None:
    """Delete a matte's row."""
    connection.execute(mattes.delete().where(mattes.c.id == matte))
