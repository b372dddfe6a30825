"""Idempotency-Key: a repeated POST is answered with what the first one created."""

from collections.abc import Callable
from typing import Annotated, TypeVar

from fastapi import Header
from sqlalchemy import Connection, Engine
from sqlalchemy.exc import IntegrityError

from storage.database.engine import reading, writing
from storage.records.idempotency import add, find

T = TypeVar("T")
Read = Callable[[Connection, str], T]
"""Reads what an id stands for; raises `NotFound` if it has been deleted."""
IdempotencyKey = Annotated[str | None, Header(alias="Idempotency-Key", max_length=256)]


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
        return None if earlier is None else read(c, earlier)


def idempotent(
    engine: Engine, key: str | None, call: str, read: Read[T], create: Callable[[Connection], str]
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

    Raises
    ------
    NotFound
        If an earlier request created it and it has been deleted since.
    """
    try:
        with writing(engine) as c:
            created = find(c, key, call) if key else None
            if created is None:
                created = create(c)
                if key:
                    add(c, key, call, created)
            return read(c, created)
    except IntegrityError:  # a concurrent request with the same key was quicker
        earlier = find_earlier(engine, key, call, read)
        if earlier is None:
            raise
        return earlier
