"""The rows of a database of any revision as lines of JSON, for backups.

A line is a list of two: the name of a table, and a row as an object. The coordinator's lease and the installation's id
are left out, because they mean nothing to the restored installation. So are the requests under way, and webhook
deliveries, because the original service makes them.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby, islice
from typing import Any, get_args

from sqlalchemy import (
    JSON,
    Boolean,
    Column,
    Connection,
    Engine,
    Float,
    Integer,
    MetaData,
    Table,
    func,
    insert,
    inspect,
    or_,
    select,
)

from storage.database import dialects, migrations
from storage.database.engine import reading
from storage.database.revision import revision
from storage.database.tables import metadata
from storage.errors import Conflict, InvalidInput
from storage.records.captures import State as CaptureState
from storage.records.jobs import Kind
from storage.records.jobs import State as JobState
from storage.records.mattes import State as MatteState
from storage.records.tiles import State as TileState

SKIPPED = ("coordinator", "installation", "deliveries", "bodies")
OF_ROWS = {"links": "matte", "tiles": "job", "log": "job"}
"""Tables whose rows belong to those of another table, and the column that says to which."""
BATCH = 500
"""Rows in memory at a time."""
ID = re.compile("[A-Za-z0-9_-]{1,64}")
"""Ids become names of folders in the store, so none may lead out of it."""
IDS = ("id", "capture", "matte", "job", "upload")
CHOICES = {
    "captures.state": get_args(CaptureState),
    "mattes.state": get_args(MatteState),
    "jobs.kind": get_args(Kind),
    "jobs.state": get_args(JobState),
    "tiles.state": get_args(TileState),
}
"""The values of columns that the code takes to have no others."""
LATEST = 253402300799
"""The end of the year 9999 in seconds since 1970: later times can't be shown."""
Line = tuple[str, Mapping[str, Any]]


def open_without_upgrade(url: str) -> Engine:
    """Open the database of a service without upgrading its schema.

    Raises
    ------
    Conflict
        If there is none, or a newer envmatte has used it.
    InvalidInput, Unavailable
        As for `storage.database.engine.open_engine`.
    """
    dialects.require_existing(url)
    engine = dialects.make_engine(url)
    where = dialects.display_url(engine.url)
    try:
        with reading(engine) as c:
            found = revision(c)
        if found is None:
            raise Conflict(
                f"the database {where} has no tables of envmatte, or those of a very old version; name the service's "
                "database, or start `envmatte serve` with it once"
            )
        migrations.require_known(found, "the database")
    except BaseException:
        engine.dispose()
        raise
    return engine


def tables_of(connection: Connection) -> Mapping[str, Table]:
    """The tables that the database has, by name; a table comes after those that it refers to."""
    found = MetaData()
    there = metadata.tables.keys() & set(inspect(connection).get_table_names())
    found.reflect(connection, only=sorted(there))
    for table in found.tables.values():
        for column in table.columns:
            if isinstance(column.type, JSON):
                column.type.none_as_null = True  # as in `storage.database.tables`
    return {table.name: table for table in found.sorted_tables}


def lines(connection: Connection, tables: Mapping[str, Table]) -> Iterator[Line]:
    """All rows, read in batches within the transaction."""
    for name, table in tables.items():
        if name not in SKIPPED:
            streamed = connection.execution_options(yield_per=BATCH)
            for row in streamed.execute(select(table)).mappings():
                yield name, dict(row)


def lines_of_family(connection: Connection, tables: Mapping[str, Table], family: str) -> Iterator[Line]:
    """The rows of a family, see `storage.maintenance.inventory.Item`."""
    captures, mattes, jobs = (tables[name] for name in ("captures", "mattes", "jobs"))
    uploads, parts = tables["uploads"], tables["upload_parts"]
    of_mattes = or_(mattes.c.capture == family, mattes.c.id == family)
    of_jobs = or_(jobs.c.capture == family, (jobs.c.capture == "") & (jobs.c.matte == family))
    ids = {"matte": select(mattes.c.id).where(of_mattes), "job": select(jobs.c.id).where(of_jobs)}
    for table, which in (
        (captures, captures.c.id == family),
        (mattes, of_mattes),
        (uploads, uploads.c.id == family),
        (parts, parts.c.upload == family),
        (jobs, of_jobs),
        *(
            (tables[name], tables[name].c[column].in_(ids[column]))
            for name, column in OF_ROWS.items()
            if name in tables  # an earlier revision has no links
        ),
    ):
        for row in connection.execute(select(table).where(which)).mappings():
            yield table.name, dict(row)


def to_line(name: str, row: Mapping[str, Any]) -> bytes:
    """A row as a line."""
    return json.dumps([name, dict(row)], separators=(",", ":")).encode() + b"\n"


def counts(connection: Connection, tables: Mapping[str, Table]) -> dict[str, int]:
    """The number of rows of each table that has any; without those that every service has once it was started."""
    found = {
        name: connection.scalar(select(func.count()).select_from(table)) or 0
        for name, table in tables.items()
        if name not in ("coordinator", "installation")
    }
    return {name: count for name, count in found.items() if count}


def insert_lines(connection: Connection, source: Iterable[bytes]) -> int:
    """Insert rows into empty tables of the same revision; returns how many.

    Running jobs are queued; their tiles keep their progress.

    Raises
    ------
    InvalidInput
        If a line is not a row, or does not match the schema.
    """
    tables = tables_of(connection)
    read = 0
    for name, group in groupby(map(_loaded, source), key=lambda line: line[0]):
        if name not in tables or name in SKIPPED:
            raise InvalidInput(f"the backup's ledger has rows of a table {name!r}, which does not exist")
        table = tables[name]
        rows = (row for _, row in group)
        while some := list(islice(rows, BATCH)):
            for row in some:
                if row.keys() != set(table.columns.keys()):
                    raise InvalidInput(f"the backup's ledger has a row of {name} with unexpected columns")
                for column in table.columns:
                    if not _is_valid(column, row[column.name]):
                        raise InvalidInput(
                            f"the backup's ledger has a row of {name} with an invalid {column.name}"
                        )
                if name == "jobs" and row["state"] == "running":
                    row |= {"state": "queued", "stage": "waiting"}
            connection.execute(insert(table), some)
            read += len(some)
    return read


def _is_valid(column: Column[Any], value: Any) -> bool:
    """Whether a column may have a value. SQLite would take any, and the service would stumble over it."""
    name, kind = f"{column.table.name}.{column.name}", column.type
    if value is None:
        return bool(column.nullable)
    if column.name in IDS or name == "upload_parts.name":
        return isinstance(value, str) and bool(ID.fullmatch(value) or (name, value) == ("jobs.capture", ""))
    if name in CHOICES:
        return value in CHOICES[name]
    if isinstance(kind, Boolean):
        return isinstance(value, bool)
    if isinstance(kind, Integer):
        return type(value) is int and abs(value) < 1 << 63
    if isinstance(kind, Float):
        return type(value) in (int, float) and 0 <= value <= LATEST
    return isinstance(kind, JSON) or isinstance(value, str)


def _loaded(line: bytes) -> tuple[str, dict[str, Any]]:
    try:
        name, row = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InvalidInput("the backup's ledger has a line that is not a row") from error
    if not (isinstance(name, str) and isinstance(row, dict)):
        raise InvalidInput("the backup's ledger has a line that is not a row")
    return name, row


def continue_numbering(connection: Connection) -> None:
    """Make new rows continue the numbering of the inserted ones; SQLite does that by itself."""
    if connection.dialect.name != "postgresql":
        return
    for table in metadata.sorted_tables:
        column = table.autoincrement_column
        if column is not None:
            last = connection.scalar(select(func.max(column)))
            sequence = func.pg_get_serial_sequence(table.name, column.name)
            if last is not None:
                connection.execute(select(func.setval(sequence, last)))
