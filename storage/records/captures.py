"""Rows of captures."""

from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from storage.database.rows import find, lifetime
from storage.database.tables import captures


def add(
    connection: Connection, capture: str, job: str, *, seconds: float | None = None, **record: Any
) -> None:
    """Write down a new capture, whose ingest job is queued, and that is kept for some time, or until it is deleted."""
    row = {"id": capture, "state": "ingesting", "job": job, **lifetime(seconds), **record}
    connection.execute(insert(captures).values(row))


def get(connection: Connection, capture: str) -> Row[Any]:
    """A capture's row; `NotFound` if there is none."""
    return find(connection, captures, capture)


def exists(connection: Connection, capture: str) -> bool:
    """Whether there is a capture."""
    return connection.scalar(select(captures.c.id).where(captures.c.id == capture)) is not None


def change(connection: Connection, capture: str, **values: Any) -> None:
    """Change a capture's row."""
    connection.execute(update(captures).where(captures.c.id == capture).values(values))


def delete(connection: Connection, capture: str) -> None:
    """Delete a capture's row."""
    connection.execute(captures.delete().where(captures.c.id == capture))
