"""Rows of captures."""

from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from storage.database.rows import find, json_bytes, lifetime
from storage.database.tables import captures


def add(
    connection: Connection, capture: str, job: str, *, seconds: float | None = None, **record: Any
) -> None:
    """Add a capture that is being ingested by a job; it expires after `seconds`, or never if that is None."""
    row = {"id": capture, "state": "ingesting", "job": job, **lifetime(seconds), **record}
    row["row_bytes"] = json_bytes(row["program"])
    connection.execute(insert(captures).values(row))


def get(connection: Connection, capture: str) -> Row[Any]:
    """A capture's row.

    Raises
    ------
    NotFound
        If there is none.
    """
    return find(connection, captures, capture)


def exists(connection: Connection, capture: str) -> bool:
    """Whether a capture exists."""
    return connection.scalar(select(captures.c.id).where(captures.c.id == capture)) is not None


def change(connection: Connection, capture: str, **values: Any) -> None:
    """Change a capture's row."""
    connection.execute(update(captures).where(captures.c.id == capture).values(values))


def delete(connection: Connection, capture: str) -> None:
    """Delete a capture's row."""
    connection.execute(captures.delete().where(captures.c.id == capture))
