"""Who calls, and what he may: by the key that a request brings."""

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

LOOKS = ("GET", "HEAD", "OPTIONS")
"""Methods for which a key of the scope ``read`` is enough."""
bearer = HTTPBearer(auto_error=False, description="An API key, where the service has any.")


@dataclass(frozen=True)
class Caller:
    """Whom a key stands for."""

    owner: str
    scope: str
    known: bool = True
    """Whether there was a key."""

    def may(self, scope: str) -> bool:
        """Whether the key allows what a scope does."""
        return api_keys.SCOPES.index(self.scope) >= api_keys.SCOPES.index(scope)


ADMIN = Caller(DEFAULT, "admin")
"""Who has a key of the settings."""
ANYONE = Caller(DEFAULT, "admin", known=False)
"""Anyone, while a service has no key at all."""


def identify(settings: Settings, engine: Engine, key: str | None) -> Caller:
    """Whom a key stands for, now.

    Raises
    ------
    Unauthorized
        If the service has keys, and this is none of them.
    """
    if key is not None:
        given = [hmac.compare_digest(key.encode(), one.encode()) for one in settings.keys]
        if any(given):
            return ADMIN
    with reading(engine) as c:
        row = api_keys.known(c, key) if key is not None else None
        if row is not None:
            return Caller(row.owner, row.scope)
        if not settings.keys and not api_keys.any_was_made(c):
            return ANYONE
    raise Unauthorized("send a key of this service: `Authorization: Bearer KEY`")


def see_that_it_may(caller: Caller, request: Request) -> None:
    """See that a key is enough for a method, whatever the route.

    Raises
    ------
    Forbidden
    """
    demand(caller, "read" if request.method in LOOKS else "write")


def demand(caller: Caller, scope: str) -> None:
    """See that a key allows what a scope does.

    Raises
    ------
    Forbidden
    """
    if not caller.may(scope):
        raise Forbidden(
            f"this takes a key of the scope {scope}, and yours has {caller.scope}; whoever runs the service makes one "
            f"with `envmatte keys make NAME --scope {scope}`",
            scope=scope,
        )


def is_open(settings: Settings, engine: Engine) -> bool:
    """Whether there is no key, so that anyone may do everything."""
    if settings.keys:
        return False
    with reading(engine) as c:
        return not api_keys.any_was_made(c)


def see_that_it_is_closed(settings: Settings, engine: Engine) -> None:
    """See that a service without a key listens on loopback alone.

    Raises
    ------
    InvalidInput
    """
    if is_loopback(settings.host) or not is_open(settings, engine):
        return
    raise InvalidInput(
        f"asked to listen on {settings.host} without a key, where anyone on the network could use the service: make "
        "one with `envmatte keys make NAME`, set ENVMATTE_KEYS to one or more keys, separated by commas, or listen on "
        "127.0.0.1"
    )
