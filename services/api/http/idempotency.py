"""Idempotency-Key: a repeated POST is answered with what the first one created."""

import time
from collections.abc import Callable
from typing import Annotated, TypeVar

from fastapi import Header
from sqlalchemy import Connection, Engine

from storage.database.engine import reading, writing
from storage.errors import NotFound, Unavailable
from storage.records.idempotency import add, find

T = TypeVar("T")
Read = Callable[[Connection, str], T]
"""Reads what an id stands for; raises `NotFound` if it has been deleted."""
PATIENCE = 10.0
"""Seconds within which a database that is restarted should be back."""
PAUSE = 0.2
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=256,
        # Bodies may be archives of many gigabytes, and a repeat is answered before its body comes.
        description="A name for this request, such as a UUID. Another request with it is answered with what the first "
        "one made, whatever its body: bodies are not compared.",
    ),
]


def find_earlier(engine: Engine, key: str | None, call: str, read: Read[T]) -> T | None:
    """Read what an earlier request with the same key created, None if there was no such request.

    Raises
    ------
    NotFound
        If it has been deleted since.
    """
    if not key:
        return None
    with reading(engine) as c:
        earlier = find(c, key, call)
        return None if earlier is None else _read_created(c, earlier, read)


def idempotent(
    engine: Engine,
    key: str | None,
    call: str,
    read: Read[T],
    create: Callable[[Connection], str],
    new: str | None = None,
) -> T:
    """Create something and remember its key in one transaction, unless an earlier request with the key did.

    Parameters
    ----------
    key : str or None
        The Idempotency-Key of the request; None or empty creates in any case.
    call : str
        Method and path of the route: a key may be used once for each.
    create : callable
        Creates it within the transaction, and returns its id.
    new : str, optional
        The id of what ``create`` creates. With it, a transaction that a restart of the database ends is repeated.

    Raises
    ------
    NotFound
        If an earlier request created it and it has been deleted since.
    Unavailable
        If the database stays away. The transaction may have been committed or not.
    """
    give_up = time.monotonic() + (PATIENCE if new else 0)
    while True:
        try:
            return _once(engine, key, call, read, create, new)
        except Unavailable:
            if time.monotonic() > give_up:
                raise
        time.sleep(PAUSE)


def _once(
    engine: Engine,
    key: str | None,
    call: str,
    read: Read[T],
    create: Callable[[Connection], str],
    new: str | None,
) -> T:
    # All writers wait for each other, so no concurrent request adds the key after it is looked up.
    with writing(engine) as c:
        created = find(c, key, call) if key else None
        if created is None and new and _exists(c, new, read):  # committed, before the connection broke
            created = new
        if created is None:
            created = create(c)
            if key:
                add(c, key, call, created)
        return _read_created(c, created, read)


def _read_created(connection: Connection, id: str, read: Read[T]) -> T:
    try:
        return read(connection, id)
    except NotFound as error:
        raise NotFound(
            "what the first request with this Idempotency-Key created has been deleted; use another key"
        ) from error


def _exists(connection: Connection, id: str, read: Read[T]) -> bool:
    try:
        read(connection, id)
    except NotFound:
        return False
    return True
