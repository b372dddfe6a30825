"""API keys: who may use the service, for which owner, and with which scope.

A key is 256 random bits and is shown once; the database keeps its SHA-256. Slow, salted hashes protect passwords, which
can be guessed. Random keys cannot, even with a copy of the database, and a plain hash can be looked up by an index for
every request.
"""

import hashlib
import secrets
import time
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from storage.database.tables import keys
from storage.errors import Conflict, InvalidInput, NotFound

SCOPES = ("read", "write", "admin")
"""What a key allows: to read; also to create and delete; also to see the whole service."""
PREFIX = "envmatte_"
"""Lets people, and scanners for leaked secrets, recognise a key."""
MAX_LENGTH = 64
"""Most characters of a key's name and of an owner."""


def create(connection: Connection, name: str, owner: str, scope: str) -> str:
    """Create a key and return it; it cannot be read again later.

    Raises
    ------
    InvalidInput
        If the name or the owner is empty or too long.
    Conflict
        If an active key has this name.
    """
    for what, text in (("name", name), ("owner", owner)):
        if not (text.strip() == text and 0 < len(text) <= MAX_LENGTH and text.isprintable()):
            raise InvalidInput(
                f"{what} {text!r} must have 1 to {MAX_LENGTH} characters, all printable and none blank at either end"
            )
    if _active(connection, name) is not None:
        raise Conflict(f"there is already a key {name!r}; revoke it first, or use another name")
    key = PREFIX + secrets.token_urlsafe(32)
    row = {"name": name, "hash": hash_of(key), "owner": owner, "scope": scope, "created_at": time.time()}
    connection.execute(insert(keys).values(row))
    return key


def find(connection: Connection, key: str) -> Row[Any] | None:
    """The row of an active key, if there is one."""
    query = select(keys).where(keys.c.hash == hash_of(key), keys.c.revoked_at.is_(None))
    return connection.execute(query).one_or_none()


def any_created(connection: Connection) -> bool:
    """Whether a key was ever created: a service must not become open again when its last key is revoked."""
    return connection.scalar(select(keys.c.number).limit(1)) is not None


def list_all(connection: Connection) -> Sequence[Row[Any]]:
    """All keys, oldest first, including revoked ones."""
    return connection.execute(select(keys).order_by(keys.c.number)).all()


def revoke(connection: Connection, name: str) -> None:
    """Revoke a key; it stops working at the end of the transaction.

    Raises
    ------
    NotFound
        If no active key has this name.
    """
    row = _active(connection, name)
    if row is None:
        raise NotFound(f"there is no active key {name!r}; `envmatte keys list` lists all keys")
    connection.execute(update(keys).where(keys.c.number == row.number).values(revoked_at=time.time()))


def _active(connection: Connection, name: str) -> Row[Any] | None:
    query = select(keys).where(keys.c.name == name, keys.c.revoked_at.is_(None))
    return connection.execute(query).one_or_none()


def hash_of(key: str) -> str:
    """What the database keeps of a secret."""
    return hashlib.sha256(key.encode(errors="surrogateescape")).hexdigest()
