"""The id of the installation, which its store has too, see `storage.objects.marker`."""

from sqlalchemy import Connection, Engine, insert, select

from storage.database.engine import reading, writing
from storage.database.rows import new_id
from storage.database.tables import captures, installation, mattes
from storage.errors import StoreUnavailable, WrongStore
from storage.objects import marker
from storage.objects.store import Objects


def find(connection: Connection) -> str | None:
    """The id; None if no service has started with this database yet."""
    found: str | None = connection.scalar(select(installation.c.id))
    return found


def recognise(engine: Engine, objects: Objects, *, mark: bool = True) -> str | None:
    """The id, after checking that the store has it. The first service with a database makes it and marks the store.

    A store that can't be reached may come back, and is not waited for.

    Parameters
    ----------
    mark : bool
        False for a service that does not write to the store before a coordinator has started.

    Returns
    -------
    str or None
        None if there is no id yet, and none is to be made.

    Raises
    ------
    WrongStore
        If the store has another id or none, or is empty while the database has captures or mattes.
    StoreUnavailable
        If it can't be reached to be marked.
    """
    with reading(engine) as c:
        id = find(c)
        holds = id is None and _holds_anything(c)
    if id is None:
        if not mark:
            return None
        # A store that is marked was marked by a start that was interrupted, or its database was restored. Before the
        # transaction, because a bucket that does not answer takes a minute.
        marked = marker.read(objects)
        if marked is None and holds and not objects.names(""):
            raise WrongStore(
                "the store is empty, and the database has captures or mattes: the store's folder may not be mounted, "
                "or its bucket is another one"
            )
        with writing(engine) as c:
            id = find(c)  # another service may have been first
            if id is None:
                id = marked or new_id()
                marker.write(objects, id)
                c.execute(insert(installation).values(id=id))
    objects.installation = id
    try:
        marker.require(objects, id)
    except WrongStore:
        raise
    except StoreUnavailable:
        pass
    return id


def _holds_anything(connection: Connection) -> bool:
    """Whether the store should hold a capture or a matte, of any owner."""
    return any(
        connection.scalar(select(table.c.id).where(table.c.state == "ready").limit(1)) is not None
        for table in (captures, mattes)
    )
