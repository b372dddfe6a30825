"""Who calls and what they may do, by the key that a request brings."""

import hmac
from dataclasses import dataclass

from fastapi import Request
from fastapi.security import HTTPBearer
from sqlalchemy import Engine

from services.runtime.addresses import is_loopback
from services.runtime.problems import Forbidden, Unauthorized
from services.settings import Settings
from storage.database.engine import reading
from storage.database.owners import DEFAULT
from storage.errors import InvalidInput
from storage.records import api_keys

READ_METHODS = ("GET", "HEAD", "OPTIONS")
"""Methods that a key of the scope ``read`` allows."""
bearer = HTTPBearer(auto_error=False, description="An API key, if the service has any.")


@dataclass(frozen=True)
class Caller:
    """The owner and the scope of a key."""

    owner: str
    scope: str
    known: bool = True
    """Whether there was a key."""
    number: int | None = None
    """The key's number in the database, if it is there."""

    def may(self, scope: str) -> bool:
        """Whether the key allows what a scope allows."""
        return api_keys.SCOPES.index(self.scope) >= api_keys.SCOPES.index(scope)


ADMIN = Caller(DEFAULT, "admin")
"""The caller with a key of the settings."""
ANYONE = Caller(DEFAULT, "admin", known=False)
"""Every caller of a service without keys."""
STRANGER = Caller("", "read", known=False)
"""Every caller of a route without keys: they share one turn, and own nothing."""


def identify(settings: Settings, engine: Engine, key: str | None) -> Caller:
    """Look up the caller that a key belongs to.

    Raises
    ------
    Unauthorized
        If the service has keys, and this is none of them.
    """
    if key is not None:
        # All of them are compared, so that the time it takes says nothing.
        matches = [hmac.compare_digest(key.encode(), own.encode()) for own in settings.keys]
        if any(matches):
            return ADMIN
    with reading(engine) as c:
        row = api_keys.find(c, key) if key is not None else None
        if row is not None:
            return Caller(row.owner, row.scope, number=row.number)
        if not settings.keys and not api_keys.any_created(c):
            return ANYONE
    if key is None:
        raise Unauthorized(
            "send a key of this service: `Authorization: Bearer KEY`; the command line takes `--key`"
        )
    raise Unauthorized(
        "this service does not know the key, or it was revoked; `envmatte keys make NAME` makes one"
    )


def check_method(caller: Caller, request: Request) -> None:
    """Check that a caller's scope allows the method of a request, whatever the route.

    Raises
    ------
    Forbidden
    """
    require_scope(caller, "read" if request.method in READ_METHODS else "write")


def require_scope(caller: Caller, scope: str) -> None:
    """Check that a caller's key allows what a scope allows.

    Raises
    ------
    Forbidden
    """
    if not caller.may(scope):
        raise Forbidden(
            f"this needs a key of the scope {scope}, and yours has {caller.scope}; an administrator of the service "
            f"can make one with `envmatte keys make NAME --scope {scope}`",
            scope=scope,
        )


def is_open(settings: Settings, engine: Engine) -> bool:
    """Whether the service has no key, so that anyone may do everything."""
    if settings.keys:
        return False
    with reading(engine) as c:
        return not api_keys.any_created(c)


def require_keys_unless_loopback(settings: Settings, engine: Engine) -> None:
    """Check that a service without keys listens on loopback only.

    Raises
    ------
    InvalidInput
    """
    if is_loopback(settings.host) or not is_open(settings, engine):
        return
    raise InvalidInput(
        f"the service has no key, and on {settings.host} anyone on the network could use it: make a key with "
        "`envmatte keys make NAME`, set ENVMATTE_KEYS to one or more keys, separated by commas, or listen on 127.0.0.1"
    )
