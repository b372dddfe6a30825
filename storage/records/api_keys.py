"""API keys: who may use the service, for which owner, and for what.

A key is 256 random bits, shown once; what is kept is its SHA-256. Slow, salted hashes are for passwords, which can be
guessed: these bits can't, whoever has the database and as many tries as he likes, and a plain hash can be looked up by
an index, at every request.
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
"""What a key allows, each also what the ones before it do: to look; to make and delete; to see the whole service."""
PREFIX = "envmatte_"
"""By which people, and scanners for leaked secrets, know a key when they see one."""
MAX_LENGTH = 64
"""Characters of an owner's name."""


def create(connection: Connection, name: str, owner: str, scope: str) -> str:
    """Make a key, and return it: it can't be had again.

    Raises
    ------
    InvalidInput
        If the name or the owner is empty or too long.
    Conflict
        If there is a key of this name that is not revoked.
    """
    for what, text in (("name", name), ("owner", owner)):
        if not (text.strip() == text and 0 < len(text) <= MAX_LENGTH and text.isprintable()):
            raise InvalidInput(
                f"{what} {text!r}: give it 1 to {MAX_LENGTH} characters, none of them blank at an end"
            )
    if _active(connection, name) is not None:
        raise Conflict(f"there is a key {name!r} already: revoke it first, or take another name")
    key = PREFIX + secrets.token_urlsafe(32)
    row = {"name": name, "hash": _hash(key), "owner": owner, "scope": scope, "created_at": time.time()}
    connection.execute(insert(keys).values(row))
    return key


def find(connection: Connection, key: str) -> Row[Any] | None:
    """The row of a key, if there is one that is not revoked."""
    query = select(keys).where(keys.c.hash == _hash(key), keys.c.revoked_at.is_(None))
    return connection.execute(query).one_or_none()


def any_created(connection: Connection) -> bool:
    """Whether there ever was a key: with the last one revoked a service must not be open again."""
    return connection.scalar(select(keys.c.number).limit(1)) is not None


def list_all(connection: Connection) -> Sequence[Row[Any]]:
    """All keys, oldest first, those that are revoked among them."""
    return connection.execute(select(keys).order_by(keys.c.number)).all()


def revoke(connection: Connection, name: str) -> None:
    """Revoke a key: from the end of the transaction on it is as good as none.

    Raises
    ------
    NotFound
        If there is none of this name, or it is revoked already.
    """
    row = _active(connection, name)
    if row is None:
        raise NotFound(f"there is no key {name!r} that is in use; `envmatte keys list` lists them")
    connection.execute(update(keys).where(keys.c.number == row.number).values(revoked_at=time.time()))


def _active(connection: Connection, name: str) -> Row[Any] | None:
    query = select(keys).where(keys.c.name == name, keys.c.revoked_at.is_(None))
    return connection.execute(query).one_or_none()


def _hash(key: str) -> str:
    return hashlib.sha256(key.encode(errors="surrogateescape")).hexdigest()
