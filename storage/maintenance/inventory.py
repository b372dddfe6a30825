"""What the store should hold according to the database: for clean-up, verification and backups."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Connection, Table, select

from storage.database.tables import bodies, metadata
from storage.layout import captures, composites, mattes, uploads
from storage.records.jobs import is_retryable

FOLDERS = {
    "captures": ("captures",),
    "mattes": ("mattes",),
    "uploads": ("uploads", "captures"),
    "composites": ("jobs",),
}
"""The top folders of the store, and the tables whose rows have items in each."""
GRACE_SECONDS = 3600.0
"""Seconds for which objects without a row are left alone: their row may be about to be added."""
COLUMNS = {
    "captures": ("id", "state", "problem"),
    "mattes": ("id", "state", "capture"),
    "uploads": ("id",),
    "jobs": ("id", "state", "problem", "kind", "capture", "matte"),
}
"""Tables whose rows have items in the store, and the columns that describe them."""


@dataclass(frozen=True)
class Item:
    """The objects of one row in the store.

    Attributes
    ----------
    kind : str
        An ``archive`` is the uploaded archive of a capture until it is ingested.
    id : str
    state : str
        ``whole``; ``busy``, being written; or ``left`` by a failed job that may be retried.
    folder : str
        Path of its folder in the store.
    family : str
        Id of the capture it was made from, or of an imported matte: items that depend on each other have the same.
    parts : tuple of str
        Names of the parts of an upload under way.
    """

    kind: Literal["capture", "archive", "matte", "upload", "composite"]
    id: str
    state: Literal["whole", "busy", "left"]
    folder: str
    family: str
    parts: tuple[str, ...] = ()


def items(
    connection: Connection,
    tables: Mapping[str, Table] = metadata.tables,
    *,
    only: str | None = None,
    ids: Collection[str] | None = None,
) -> Iterator[Item]:
    """Items according to the database.

    Parameters
    ----------
    tables : mapping of str to Table
        The tables of the database, which may have an earlier revision.
    only : str, optional
        The table whose rows are read; all by default.
    ids : collection of str, optional
        The ids of the rows that are read; all by default.
    """
    for name in [only] if only else COLUMNS:
        table = tables[name]
        query = select(*(table.c[column] for column in COLUMNS[name]))
        if name == "jobs":
            query = query.where(table.c.kind == "composite")
        if ids is not None:
            query = query.where(table.c.id.in_(ids))
        for row in connection.execute(query).mappings():
            yield from items_of_row(connection, tables, name, dict(row))


def known_names(connection: Connection, folder: str, names: Collection[str]) -> set[str]:
    """Those of some names in a top folder that belong to an item, or to a request that may make one of its body."""
    found = {item.folder for table in FOLDERS[folder] for item in items(connection, only=table, ids=names)}
    # A bucket dates an object by when its upload began. A row that has lapsed counts too, as its request may go on.
    coming = connection.scalars(select(bodies.c.id).where(bodies.c.id.in_(names)))
    return {name for name in names if f"{folder}/{name}" in found}.union(coming)


def family_of(table: str, row: Mapping[str, Any]) -> str | None:
    """The family of a row, see `Item`; None for tables without one, such as tiles and links."""
    match table:
        case "captures" | "uploads":
            return str(row["id"])
        case "upload_parts":
            return str(row["upload"])
        case "mattes":
            return str(row["capture"] or row["id"])
        case "jobs":
            return str(row["capture"] or row["matte"] or row["id"])
    return None


def items_of_row(
    connection: Connection, tables: Mapping[str, Table], table: str, row: Mapping[str, Any]
) -> Iterator[Item]:
    """The items of a row; most tables have none.

    Parameters
    ----------
    tables : mapping of str to Table
        The tables of the database, which may have an earlier revision.
    row : mapping
        A row with at least the `COLUMNS` of its table.
    """
    family = family_of(table, row) or ""
    if table == "captures" and (row["state"] != "failed" or is_retryable(row["problem"])):
        id, ready = row["id"], row["state"] == "ready"
        state: Any = {"ready": "whole", "failed": "left"}.get(row["state"], "busy")
        yield Item("capture", id, state, captures.path(id), family)
        if not ready:
            yield Item("archive", id, "whole", uploads.path(id), family)
    elif table == "mattes":
        id = row["id"]
        state = {"ready": "whole", "failed": "left"}.get(row["state"], "busy")
        yield Item("matte", id, state, mattes.path(id), family)
    elif table == "uploads":
        id, parts = row["id"], tables["upload_parts"]
        names = tuple(connection.scalars(select(parts.c.name).where(parts.c.upload == id)))
        yield Item("upload", id, "whole", uploads.path(id), family, names)
    elif table == "jobs" and row["kind"] == "composite":
        kept = row["problem"] is None or is_retryable(row["problem"])
        if kept and row["state"] != "cancelled":
            state = {"succeeded": "whole", "failed": "left"}.get(row["state"], "busy")
            yield Item("composite", row["id"], state, composites.path(row["id"]), family)
