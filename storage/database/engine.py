"""Opening the database, and its read and write transactions."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, Engine, event
from sqlalchemy.exc import ProgrammingError, SQLAlchemyError

from storage.database import dialects, owners
from storage.database.revision import NEWEST, revision
from storage.errors import InvalidInput, Unavailable


def open_engine(url: str) -> Engine:
    """Open a database and upgrade its schema if needed; several processes may do so at the same time.

    Parameters
    ----------
    url : str
        As SQLAlchemy takes it: ``sqlite:////folder/envmatte.db`` or ``postgresql://user:password@host/database``.

    Raises
    ------
    InvalidInput
        If the URL does not name a SQLite or PostgreSQL database, or its user may not make tables there.
    Conflict
        If a newer envmatte has used the database.
    Unavailable
        If the database cannot be reached.
    NoRoom
        If its disk is full.
    """
    engine = dialects.make_engine(url)
    event.listen(engine, "before_execute", owners.restrict, retval=True)
    try:
        with reading(engine) as connection:
            current = revision(connection) == NEWEST
        if not current:
            from storage.database import migrations  # imports alembic, which few processes need

            with writing(engine) as connection:
                migrations.upgrade(connection)
    except BaseException as error:
        engine.dispose()
        where = dialects.display_url(engine.url)
        if isinstance(error, ProgrammingError) and dialects.is_refused(error):
            raise InvalidInput(
                f"cannot set up the database {where}: {dialects.reason(error)}; let its user own the database"
            ) from error
        if not isinstance(error, Unavailable):
            raise
        why = dialects.reason(error.__cause__)
        raise Unavailable(
            f"cannot open the database {where}: {why}; check that it runs and that its URL is right, and try again"
        ) from error
    return engine


@contextmanager
def reading(engine: Engine) -> Iterator[Connection]:
    """A read-only transaction: all of its queries see the database at one point in time.

    Raises
    ------
    Unavailable
        If the database cannot be reached.
    """
    options = dialects.READ_ONLY[engine.dialect.name]
    with _translate_errors(), engine.connect().execution_options(**options) as connection:
        yield connection


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """A transaction that may write, one at a time: committed at the end, rolled back by an exception.

    Raises
    ------
    NoRoom
        If the disk is full.
    Unavailable
        If the database cannot be reached, or the wait for other writers takes too long. The transaction may have been
        committed or not.
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
    dialects.outage.is_over("the database answers")
