"""Rows of captures."""

from typing import Any, Literal

from sqlalchemy import Connection, Row, Text, cast, insert, select, update

from storage.database.rows import find, json_bytes, lifetime
from storage.database.tables import captures

State = Literal["ingesting", "ready", "failed"]
WITHOUT = ("program",)
"""What is not read with a row: it may have megabytes, and while JSON is parsed all threads wait."""


def add(
    connection: Connection, capture: str, job: str, *, seconds: float | None = None, **record: Any
) -> None:
    """Add a capture that is being ingested by a job; it expires after `seconds`, or never if that is None."""
    row = {"id": capture, "state": "ingesting", "job": job, **lifetime(seconds), **record}
    row["row_bytes"] = json_bytes(row["program"])
    connection.execute(insert(captures).values(row))


def get(connection: Connection, capture: str) -> Row[Any]:
    """A capture's row, without its program.

    Raises
    ------
    NotFound
        If there is none.
    """
    return find(connection, captures, capture, without=WITHOUT)


def program_json(connection: Connection, capture: str) -> str:
    """The program of a capture that exists, as JSON. It may have megabytes."""
    return str(
        connection.scalars(select(cast(captures.c.program, Text)).where(captures.c.id == capture)).one()
    )


def exists(connection: Connection, capture: str) -> bool:
    """Whether a capture exists."""
    return connection.scalar(select(captures.c.id).where(captures.c.id == capture)) is not None


def change(connection: Connection, capture: str, **values: Any) -> None:
    """Change a capture's row."""
    connection.execute(update(captures).where(captures.c.id == capture).values(values))


def delete(connection: Connection, capture: str) -> None:
    """Delete a capture's row."""
    connection.execute(captures.delete().where(captures.c.id == capture))
