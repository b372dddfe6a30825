"""The id of the installation, which its store has too, see `storage.objects.marker`."""

from sqlalchemy import Connection, Engine, insert, select

from storage.database.engine import reading, writing
from storage.database.rows import new_id
from storage.database.tables import installation
from storage.errors import StoreUnavailable, WrongStore
from storage.objects import marker
from storage.objects.store import Objects


def find(connection: Connection) -> str | None:
    """The id; None if no service has started with this database yet."""
    found: str | None = connection.scalar(select(installation.c.id))
    return found


def recognise(engine: Engine, objects: Objects) -> str:
    """The id, after checking that the store has it. The first service with a database makes it and marks the store.

    A store that can't be reached may come back, and is not waited for.

    Raises
    ------
    WrongStore
        If the store has another id or none.
    StoreUnavailable
        If it can't be reached to be marked.
    """
    with reading(engine) as c:
        id = find(c)
    if id is None:
        # A store that is marked was marked by a start that was interrupted, or its database was restored. Before the
        # transaction, because a bucket that does not answer takes a minute.
        marked = marker.read(objects)
        with writing(engine) as c:
            id = find(c)  # another service may have been first
            if id is None:
                id = marked or new_id()
                marker.write(objects, id)
                c.execute(insert(installation).values(id=id))
    try:
        marker.require(objects, id)
    except WrongStore:
        raise
    except StoreUnavailable:
        pass
    return id
