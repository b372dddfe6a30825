"""Rows of programs. Everything else about a program, its pictures too, is computed from the row."""

import hashlib
import json
import time
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from storage.database.rows import find, json_bytes
from storage.database.tables import programs as table


def add(connection: Connection, program: dict[str, Any]) -> str:
    """Add a program and return its id; an identical program has the same id and is stored once."""
    id = _id(program)
    if size := added_bytes(connection, program):
        row = {"id": id, "program": program, "created_at": time.time(), "row_bytes": size}
        connection.execute(insert(table).values(row))
    return id


def added_bytes(connection: Connection, program: dict[str, Any]) -> int:
    """Bytes that adding a program would take, as `statistics.stored_bytes` counts them; 0 if it is already stored."""
    known = connection.scalar(select(table.c.id).where(table.c.id == _id(program))) is not None
    return 0 if known else json_bytes(program)


def _id(program: dict[str, Any]) -> str:
    text = json.dumps(program, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def get(connection: Connection, program: str) -> Row[Any]:
    """A program's row.

    Raises
    ------
    NotFound
        If there is none.
    """
    return find(connection, table, program)


def delete(connection: Connection, program: str) -> None:
    """Delete a program's row."""
    connection.execute(table.delete().where(table.c.id == program))


def set_showing(connection: Connection, program: str, showing: dict[str, Any]) -> None:
    """Store the playback progress of a program, with the current time.

    A page that is left reports the end at once, and an earlier report of the same playback may arrive later: it is
    ignored.

    Raises
    ------
    NotFound
        If there is no such program.
    """
    last = find(connection, table, program).showing or {}
    has_ended = last.get("phase") in ("shown", "stopped")
    if has_ended and showing["playback"] and last.get("playback") == showing["playback"]:
        return
    record = showing | {"at": time.time()}
    connection.execute(update(table).where(table.c.id == program).values(showing=record))
