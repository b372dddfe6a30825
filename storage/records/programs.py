"""Programs: their records in the database. All else of a program, its pictures too, follows from its record."""

import hashlib
import json
import time
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from storage.database.rows import find
from storage.database.tables import programs as table


def add(connection: Connection, program: dict[str, Any]) -> str:
    """Write down a program and return its id; the same program has the same id, and is written down once."""
    id = _id(program)
    if added_bytes(connection, program):
        connection.execute(insert(table).values(id=id, program=program, created_at=time.time()))
    return id


def added_bytes(connection: Connection, program: dict[str, Any]) -> int:
    """Bytes that writing down a program takes, as `counts.of_bytes` counts them: none if it is there already."""
    known = connection.scalar(select(table.c.id).where(table.c.id == _id(program))) is not None
    return 0 if known else len(json.dumps(program))


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
    """Remove a program's row."""
    connection.execute(table.delete().where(table.c.id == program))


def set_showing(connection: Connection, program: str, showing: dict[str, Any]) -> None:
    """Write down how far the showing of a program is, and when that was.

    Raises
    ------
    NotFound
        If there is no such program.
    """
    find(connection, table, program)
    told = showing | {"at": time.time()}
    connection.execute(update(table).where(table.c.id == program).values(showing=told))
