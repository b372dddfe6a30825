"""The id of the installation, which its store has too, see `storage.objects.marker`."""

from sqlalchemy import Connection, Engine, insert, inspect, select

from storage.database.engine import reading, writing
from storage.database.rows import new_id
from storage.database.tables import captures, installation, mattes
from storage.errors import StoreUnavailable, WrongStore
from storage.maintenance import inventory
from storage.objects import marker
from storage.objects.store import Objects, folder_of

ENOUGH = 1000
"""Names of things in the store that are looked up, at most."""


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
        If the store has another id or none. If there is no id yet: if the store is empty while the database has
        captures or mattes, or has only things that the database does not know.
    StoreUnavailable
        If there is no id yet and it can't be reached.
    """
    with reading(engine) as c:
        id = find(c)
        holds = id is None and _holds_anything(c)
    if id is None:
        _require_known(engine, objects)
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


def open_store(engine: Engine, url: str) -> Objects:
    """The store that has the id of its database, which may have the schema of an earlier version.

    Raises
    ------
    WrongStore
        If it has another one or none. Its folder is not made.
    StoreUnavailable
    """
    with reading(engine) as c:
        id = find(c) if inspect(c).has_table(installation.name) else None
    folder = folder_of(url)
    if id is not None and folder is not None and not folder.is_dir():
        raise marker.wrong_store()
    objects = Objects(url)
    if id is not None:
        marker.require(objects, id)
    return objects


def _require_known(engine: Engine, objects: Objects) -> None:
    """Check that a store with anything in it has something of this database: what it does not know would be removed."""
    found = False
    for folder in inventory.FOLDERS:
        names = objects.names(folder)[:ENOUGH]
        with reading(engine) as c:
            if inventory.known_names(c, folder, names):
                return
        found |= names not in ([], ["zarr.json"])
    if found:
        raise WrongStore(
            "the store has captures, mattes or uploads, and the database knows none of them: name the database that "
            "they belong to, or an empty folder or bucket. Run an interrupted `envmatte restore` again. To start "
            "afresh, remove what is in the store"
        )


def _holds_anything(connection: Connection) -> bool:
    """Whether the store should hold a capture or a matte, of any owner."""
    return any(
        connection.scalar(select(table.c.id).where(table.c.state == "ready").limit(1)) is not None
        for table in (captures, mattes)
    )
