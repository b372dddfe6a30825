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
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

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
    Column(
        "misses", Integer, nullable=False, server_default="0"
    ),  # failed attempts at the present single step
    Column("stage_at", Float),  # when the present stage was entered
    Column("moved_at", Float),  # when last something of it got done
    Column("paced_at", Float),  # the pace of tiles is measured from here: when, and how many were done
    Column("paced_done", Integer, nullable=False, server_default="0"),
    Column("trace", String(64)),  # the request's traceparent (W3C)
)

tiles = Table(
    "tiles",
    metadata,
    Column("job", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("tile", Integer, primary_key=True),
    Column("state", String(16), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("seconds", Float),
    Column("losses", Integer, nullable=False, server_default="0"),  # how often its worker died
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
    Column("token", Integer, nullable=False),  # grows by one at each takeover
    Column("holder", String(64)),  # the process that drives
    Column("expires_at", Float, nullable=False),
    Column("beat_at", Float, nullable=False),
    Column("cluster", JSON, nullable=False),  # what the holder last saw: workers, problem
)
"""One row: the lease of the coordinator. Its times are by the database's clock."""

totals = Table(
    "totals",
    metadata,
    Column("kind", String(16), primary_key=True),
    Column("tiles", BigInteger, nullable=False),
    Column("misses", BigInteger, nullable=False),
    Column("losses", BigInteger, nullable=False),
    Column("pixels", BigInteger, nullable=False),
    Column("seconds", Float, nullable=False),
)
"""What has ever been done by each kind of job, also by those that are deleted: for metrics."""

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


class clock(FunctionElement[float]):
    """The database's clock as an SQL expression: seconds since 1970, also within a transaction going on."""

    type = Float()
    inherit_cache = True


@compiles(clock, "sqlite")
def _clock_of_sqlite(element: clock, compiler: SQLCompiler, **options: object) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(clock, "postgresql")
def _clock_of_postgresql(element: clock, compiler: SQLCompiler, **options: object) -> str:
    return "CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS DOUBLE PRECISION)"


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
