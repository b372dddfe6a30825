"""Rows of mattes."""

from typing import Any, Literal

from sqlalchemy import Connection, Row, insert, update

from storage.database.rows import find, lifetime
from storage.database.tables import mattes
from storage.errors import Conflict

State = Literal["recovering", "ready", "failed"]


def add(
    connection: Connection,
    matte: str,
    capture: str,
    job: str,
    options: dict[str, Any],
    seconds: float | None = None,
    name: str = "",
) -> None:
    """Add a matte that a job will recover; it expires after `seconds`, or never if that is None."""
    row = {"id": matte, "capture": capture, "job": job, "state": "recovering", "options": options}
    connection.execute(insert(mattes).values(row | {"name": name} | lifetime(seconds)))


def add_imported(
    connection: Connection,
    matte: str,
    options: dict[str, Any],
    figures: dict[str, Any],
    stored: int | None = None,
    seconds: float | None = None,
    name: str = "",
) -> None:
    """Add an imported matte, which is ready and has no capture and no job here."""
    row = {"id": matte, "state": "ready", "options": options, "figures": figures, "stored": stored}
    connection.execute(insert(mattes).values(row | {"name": name} | lifetime(seconds)))


def get(connection: Connection, matte: str) -> Row[Any]:
    """A matte's row.

    Raises
    ------
    NotFound
        If there is none.
    """
    return find(connection, mattes, matte)


def get_ready(connection: Connection, matte: str) -> Row[Any]:
    """The row of a matte that is ready.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it is not ready.
    """
    row = get(connection, matte)
    if row.state != "ready":
        raise Conflict(f"matte {matte} is {row.state}; see job {row.job}")
    return row


def change(connection: Connection, matte: str, **values: Any) -> None:
    """Change a matte's row."""
    connection.execute(update(mattes).where(mattes.c.id == matte).values(values))


def delete(connection: Connection, matte: str) -> None:
    """Delete a matte's row."""
    connection.execute(mattes.delete().where(mattes.c.id == matte))
