"""The engine that opens a database, and its transactions."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import SQLAlchemyError

from storage.database import dialects, owners
from storage.errors import Unavailable


def open_engine(url: str) -> Engine:
    """Open a database, and bring its schema up to date; any number of processes may do so at once.

    Parameters
    ----------
    url : str
        As SQLAlchemy takes it: ``sqlite:////folder/envmatte.db`` or ``postgresql://user:password@host/database``.

    Raises
    ------
    InvalidInput
        If it is no such URL.
    Conflict
        If a newer envmatte has used the database.
    Unavailable
        If the database can't be reached.
    NoRoom
        If its disk is full.
    """
    from storage.database import (
        migrations,  # with alembic, whose import takes a time that no worker should spend
    )

    engine = dialects.make_engine(url)
    event.listen(engine, "before_execute", owners.restrict, retval=True)
    try:
        with reading(engine) as connection:
            current = migrations.revision(connection) == migrations.newest()
        if not current:
            with writing(engine) as connection:
                migrations.upgrade(connection)
    except BaseException as error:
        engine.dispose()
        if not isinstance(error, Unavailable):
            raise
        raise Unavailable(
            f"cannot open the database {dialects.display_url(engine.url)}: {dialects.reason(error.__cause__)}; "
            "check that it runs and that its URL is right, and try again"
        ) from error
    return engine


@contextmanager
def reading(engine: Engine) -> Iterator[Connection]:
    """A transaction that only reads: all of it sees the database as it was at one time.

    Raises
    ------
    Unavailable
        If the database can't be reached.
    """
    with (
        _translate_errors(),
        engine.connect().execution_options(**dialects.READ_ONLY[engine.dialect.name]) as connection,
    ):
        yield connection


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """A transaction that may write, one at a time: committed at the end, rolled back by an exception.

    Raises
    ------
    NoRoom
        If the disk is full.
    Unavailable
        If the database can't be reached, or others write for too long. Whether it was committed is not known then.
    """
    with (
        _translate_errors(),
        engine.connect().execution_options(writes=True) as connection,
        connection.begin(),
    ):
        yield connection


@contextmanager
def _translate_errors() -> Iterator[None]:
    try:
        yield
    except SQLAlchemyError as error:
        translated = dialects.translate(error)
        if translated is None:
            raise
        raise translated from error
