"""Differences between SQLite and PostgreSQL: connecting, beginning a transaction, and the meaning of errors."""

import logging
import sqlite3
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic_core import from_json
from sqlalchemy import URL, Connection, Engine, Float, create_engine, event, make_url
from sqlalchemy.exc import (
    ArgumentError,
    DataError,
    DBAPIError,
    InterfaceError,
    OperationalError,
    SQLAlchemyError,
)
from sqlalchemy.exc import TimeoutError as NoConnectionFree
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from storage.errors import DISK_FULL, Conflict, EnvmatteError, InvalidInput, NoRoom, Unavailable
from storage.outage import Outage

outage = Outage(logging.getLogger(__name__), quiet=5)
"""Of the database of this process, whose errors are logged here and nowhere else: what they say is not for callers."""

WRITE_LOCK = int.from_bytes(b"envmatte")
"""Number of the PostgreSQL advisory lock that every writing transaction holds."""

CONNECTION: dict[str, Any] = {
    "connect_timeout": 10,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 2,
    "tcp_user_timeout": 20_000,
}
"""Connection settings of libpq, unless the URL sets them: a connection that is cut silently fails after about 20 s."""

TIMEOUTS = {
    "lock_timeout": "20s",
    "idle_in_transaction_session_timeout": "10s",  # for a process that freezes while it holds the write lock
    "statement_timeout": "60s",
}

BUSY_TIMEOUT = 10
"""Seconds that SQLite waits for a lock before it fails."""

READ_ONLY: dict[str, dict[str, Any]] = {
    "sqlite": {},
    "postgresql": {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True},
}
"""Options of a connection whose queries all see the same snapshot, as SQLite's always do."""

_SQLITE_UNAVAILABLE = {
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_PROTOCOL,
}
# A session ended for being idle in a transaction; a server that has become a read-only standby.
_POSTGRESQL_UNAVAILABLE = {"25P03", "25006"}


def parse_url(url: str) -> URL:
    """The URL of a database, as SQLAlchemy takes it.

    Raises
    ------
    ValueError
        If it is not that of a SQLite file or a PostgreSQL database; says what it must be.
    """
    try:
        parsed = make_url(url)
        name = parsed.get_backend_name()
    except (ArgumentError, ValueError):
        name = ""
    # SQLite would make a database in memory, or wherever the process was started.
    if name == "sqlite" and not Path(parsed.database or "").is_absolute():
        raise ValueError("must name its file from the root on, with four slashes: sqlite:////FILE")
    if name not in ("sqlite", "postgresql"):  # without showing the URL, which may hold a password
        raise ValueError("must be postgresql://USER:PASSWORD@HOST/NAME or sqlite:////FILE")
    return parsed


def make_engine(url: str) -> Engine:
    """An engine for a URL, configured for its kind of database; it connects on first use.

    Raises
    ------
    InvalidInput
        If the URL is none that `parse_url` takes.
    """
    try:
        parsed = parse_url(url)
    except ValueError as error:
        raise InvalidInput(f"the database's URL {error}") from error
    # Programs may be large: `json.loads` takes three times as long, in which no other thread runs.
    if parsed.get_backend_name() == "sqlite":
        engine = create_engine(parsed, json_deserializer=from_json)
        event.listen(engine, "connect", _set_up_sqlite)
        event.listen(engine, "connect", _make_private)
    else:
        engine = create_engine(
            parsed.set(drivername="postgresql+psycopg"),
            json_deserializer=from_json,
            pool_pre_ping=True,
            isolation_level="READ COMMITTED",
            connect_args={name: value for name, value in CONNECTION.items() if name not in parsed.query},
        )
        event.listen(engine, "connect", _set_up_postgresql)
    event.listen(engine, "begin", _begin)
    return engine


def _set_up_sqlite(connection: Any, record: object) -> None:
    connection.isolation_level = None  # _begin issues BEGIN itself
    cursor = connection.cursor()
    # FULL: a commit returns once its data survives a power cut.
    for pragma in (f"busy_timeout={BUSY_TIMEOUT * 1000}", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    deadline = time.monotonic() + BUSY_TIMEOUT
    while True:
        try:
            cursor.execute("PRAGMA journal_mode=WAL")
            break
        except sqlite3.OperationalError as error:
            # If several connections switch a new file to WAL at once, SQLite refuses all but one without waiting.
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > deadline:
                raise
            time.sleep(0.01)
    cursor.close()


def _make_private(connection: Any, record: object) -> None:
    """Take others' rights to the files of a SQLite database: they hold hashes of keys and the URLs of webhooks.

    SQLite gives the write-ahead log the rights of the database, but an old one may lie there.
    """
    file = connection.execute("PRAGMA database_list").fetchone()[2]
    for path in (Path(file + end) for end in ("", "-wal", "-shm") if file):
        with suppress(FileNotFoundError, PermissionError):  # it is another user's
            mode = path.stat().st_mode
            if mode & 0o077:
                path.chmod(mode & 0o7700)


def _set_up_postgresql(connection: Any, record: object) -> None:
    with connection.cursor() as cursor:
        cursor.execute("; ".join(f"SET {name} = '{value}'" for name, value in TIMEOUTS.items()))
    connection.commit()


def _begin(connection: Connection) -> None:
    # A transaction that reads before it writes must hold the lock from the start. If another writer came in between,
    # SQLite would refuse the write immediately, without waiting for busy_timeout, and PostgreSQL would overwrite it.
    writes = connection.get_execution_options().get("writes", False)
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
    elif writes:
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({WRITE_LOCK})")


def translate(error: SQLAlchemyError) -> EnvmatteError | None:
    """The error of `storage.errors` that a database error stands for; None if it is a programming error."""
    if isinstance(error, NoConnectionFree):
        outage.goes_on("all database connections are in use: %s", reason(error))
        return Unavailable("all database connections are in use; try again in a few seconds")
    if not isinstance(error, DBAPIError):
        return None
    if isinstance(error, DataError):  # a NUL in a text, or a text that is too long; SQLite would accept both
        return InvalidInput(f"the database cannot store this value: {reason(error)}")
    if isinstance(error.orig, sqlite3.Error):
        code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF  # the low byte is the primary code
        full, unavailable = code == sqlite3.SQLITE_FULL, code in _SQLITE_UNAVAILABLE
    else:
        state = getattr(error.orig, "sqlstate", None)
        full = state == "53100"
        unavailable = (
            isinstance(error, (OperationalError, InterfaceError))
            or error.connection_invalidated
            or state in _POSTGRESQL_UNAVAILABLE
        )
    if full:
        return NoRoom(DISK_FULL)
    if unavailable:
        outage.goes_on("the database cannot be reached: %s", reason(error))
        return Unavailable("the database cannot be reached or is busy; try again in a few seconds")
    return None


def is_refused(error: DBAPIError) -> bool:
    """Whether PostgreSQL refuses a statement because its user lacks the right."""
    return getattr(error.orig, "sqlstate", None) == "42501"


def reason(error: BaseException | None) -> str:
    """The first line of a driver's error message, which contains no password."""
    message = str(error.orig if isinstance(error, DBAPIError) else error)
    return message.partition("\n")[0]


def require_existing(url: str) -> None:
    """Check that a database is there, since to open one of SQLite creates it.

    Raises
    ------
    Conflict
        If it is of SQLite and has no file.
    """
    engine = make_engine(url)
    file = engine.url.database
    if engine.dialect.name == "sqlite" and not (file and Path(file).is_file()):
        raise Conflict(
            f"there is no database {display_url(engine.url)}; name the service's database with --data or --database"
        )


def display_url(url: URL) -> str:
    """A URL for people to read: without its password and its options, which may contain one."""
    return url.set(query={}).render_as_string(hide_password=True)


class clock(FunctionElement[float]):
    """The database's clock as an SQL expression: seconds since 1970, the same throughout a statement."""

    type = Float()
    inherit_cache = True


@compiles(clock, "sqlite")
def _clock_of_sqlite(element: clock, compiler: SQLCompiler, **options: object) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(clock, "postgresql")
def _clock_of_postgresql(element: clock, compiler: SQLCompiler, **options: object) -> str:
    return "CAST(EXTRACT(EPOCH FROM statement_timestamp()) AS DOUBLE PRECISION)"
