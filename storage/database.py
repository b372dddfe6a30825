"""The database: its tables, and the engine that opens it."""

import secrets
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Column,
    Connection,
    Engine,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    Row,
    String,
    Table,
    Text,
    create_engine,
    event,
    select,
)
from sqlalchemy.exc import OperationalError

from storage.errors import DISK_FULL, NoRoom, NotFound

metadata = MetaData()

captures = Table(
    "captures",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("name", Text, nullable=False),
    Column("state", String(16), nullable=False),
    Column("job", String(32), nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("width", Integer),
    Column("height", Integer),
    Column("frames", Integer, nullable=False),
    Column("program", JSON, nullable=False),
    Column("problem", JSON(none_as_null=True)),
    Column("created_at", Float, nullable=False),
)

mattes = Table(
    "mattes",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("capture", String(32), nullable=False),
    Column("job", String(32), nullable=False),
    Column("state", String(16), nullable=False),
    Column("options", JSON, nullable=False),
    Column("figures", JSON(none_as_null=True)),
    Column("created_at", Float, nullable=False),
)

programs = Table(
    "programs",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("program", JSON, nullable=False),
    Column("created_at", Float, nullable=False),
)

jobs = Table(
    "jobs",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("kind", String(16), nullable=False),
    Column("state", String(16), nullable=False, index=True),
    Column("stage", String(16), nullable=False),
    Column("capture", String(32), nullable=False),
    Column("matte", String(32)),
    Column("options", JSON, nullable=False),
    Column("plan", JSON(none_as_null=True)),
    Column("total", Integer, nullable=False, default=0),
    Column("done", Integer, nullable=False, default=0),
    Column("failed", Integer, nullable=False, default=0),
    Column("pixels", BigInteger, nullable=False, default=0),
    Column("problem", JSON(none_as_null=True)),
    Column("created_at", Float, nullable=False),
    Column("started_at", Float),
    Column("finished_at", Float),
)

tiles = Table(
    "tiles",
    metadata,
    Column("job", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("tile", Integer, primary_key=True),
    Column("state", String(16), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("seconds", Float),
    Index("tiles_by_state", "job", "state"),
)

log = Table(
    "log",
    metadata,
    Column("line", Integer, primary_key=True, autoincrement=True),
    Column("job", ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("at", Float, nullable=False),
    Column("text", Text, nullable=False),
)

coordinator = Table(
    "coordinator",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("beat_at", Float, nullable=False),
    Column("workers", Integer, nullable=False),
    Column("threads", Integer, nullable=False),
)
"""One row: the coordinator's last sign of life, and the cluster as it saw it."""

uploads = Table(
    "uploads",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("key", String(256), unique=True),
    Column("offset", BigInteger, nullable=False),
    Column("length", BigInteger, nullable=False),
    Column("parts", Integer, nullable=False),
    Column("metadata", Text, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float, nullable=False, index=True),
)

upload_parts = Table(
    "upload_parts",
    metadata,
    Column("upload", ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True),
    Column("offset", BigInteger, primary_key=True),
    Column("name", String(32), nullable=False),
    Column("size", BigInteger, nullable=False),
)

made = Table(
    "made",
    metadata,
    Column("key", String(256), primary_key=True),
    Column("call", String(64), primary_key=True),
    Column("id", String(32), nullable=False),
)
"""What a POST with an Idempotency-Key made, so that a repeat answers with the same."""


def open_engine(url: str) -> Engine:
    """Open the database, and make the tables that are missing.

    Parameters
    ----------
    url : str
        As SQLAlchemy takes it, e.g. ``sqlite:////folder/envmatte.db``.
    """
    engine = create_engine(url)
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _on_connect)
        event.listen(engine, "begin", _on_begin)
    metadata.create_all(engine)
    return engine


def new_id() -> str:
    """An opaque, URL-safe id that can't be guessed."""
    return secrets.token_hex(10)


def find(connection: Connection, table: Table, id: str) -> Row[Any]:
    """The row of a capture, a job or a matte.

    Raises
    ------
    NotFound
        If there is none.
    """
    row = connection.execute(select(table).where(table.c.id == id)).one_or_none()
    if row is None:
        one = table.name.removesuffix("s")
        raise NotFound(f"there is no {one} {id!r}; GET /v1/{table.name} lists those there are")
    return row


def page(
    connection: Connection, table: Table, limit: int, after: str | None, **equal: str | None
) -> Sequence[Row[Any]]:
    """Rows of a table with ids and numbers, newest first.

    Parameters
    ----------
    after : str, optional
        The id of the last row of the page before.
    **equal : str or None
        Columns that must have a value; None asks for any.

    Raises
    ------
    NotFound
        If there is no row ``after``.
    """
    query = select(table).order_by(table.c.number.desc()).limit(limit)
    for column, value in equal.items():
        if value is not None:
            query = query.where(table.c[column] == value)
    if after is not None:
        number = connection.scalar(select(table.c.number).where(table.c.id == after))
        if number is None:
            raise NotFound(
                f"there is no {after!r} to go on after; leave `after` out to start again", field="after"
            )
        query = query.where(table.c.number < number)
    return connection.execute(query).all()


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """A transaction that may write: committed at the end, rolled back by an exception.

    Raises
    ------
    NoRoom
        If the disk is full.
    """
    try:
        with engine.connect().execution_options(writes=True) as connection, connection.begin():
            yield connection
    except OperationalError as error:
        if getattr(error.orig, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL:
            raise NoRoom(DISK_FULL) from error
        raise


def _on_connect(connection: object, record: object) -> None:
    connection.isolation_level = None  # type: ignore[attr-defined]  # BEGIN is ours, see _on_begin
    cursor = connection.cursor()  # type: ignore[attr-defined]
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "busy_timeout=10000", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _on_begin(connection: Connection) -> None:
    # A transaction that reads before it writes must hold the lock from the start, or SQLite refuses the
    # write at once whenever another writer came in between, without waiting for busy_timeout.
    immediate = connection.get_execution_options().get("writes", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
