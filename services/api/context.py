"""What request handlers work with: settings, database and store, bound to the owner of the request's key."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

from anyio import CapacityLimiter
from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials
from sqlalchemy import Engine

from services.api.auth import ADMIN, Caller, bearer, check_method, identify, require_scope
from services.api.http.browser_security import require_own_site
from services.decoding.pool import Decoders
from services.settings import Settings
from storage.database.owners import NOBODY, for_owner
from storage.errors import Unavailable
from storage.objects.store import Objects
from workflows.composite.cache import Cache
from workflows.composite.threads import CORES

KEY_CHECK = 1.0
"""Seconds between two checks of a caller's key during a download."""


@dataclass(frozen=True)
class Context:
    """The parts of the service that handlers use: built once with the app, and bound to the caller for each request."""

    settings: Settings
    engine: Engine
    """Of the database. A request's own shows only what its caller may see, see `storage.database.owners`."""
    objects: Objects
    cache: Cache
    """Strips of mattes."""
    decoders: Decoders
    """Processes that decode uploaded pictures."""
    pictures: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(4))
    """Pictures of programs drawn at once. Like the limiters below, it bounds the memory that they take."""
    films: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    """Videos of programs encoded at once."""
    composites: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(CORES + 1))
    """Composites computed at once: one more than there are cores."""
    captures: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    """Capture archives checked at once; one may take 200 MB."""
    imports: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    """Archives of mattes unpacked at once."""
    layers: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    """Layers of mattes encoded at once."""
    caller: Caller = ADMIN
    check_key: Callable[[], object] = lambda: None
    """Checks again that the caller's key is valid, as `auth.identify` does: for requests that take long."""

    def while_allowed(self, pieces: Iterable[bytes]) -> Iterator[bytes]:
        """The pieces of a download, as long as the caller's key is valid.

        Raises
        ------
        Unauthorized
            Within about a second after the key was revoked.
        """
        checked_at = time.monotonic()
        for piece in pieces:
            if time.monotonic() - checked_at > KEY_CHECK:
                with suppress(Unavailable):  # the database may come back
                    self.check_key()
                checked_at = time.monotonic()
            yield piece


Key = Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]


def _service_context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


def authorized(request: Request, given: Key) -> Context:
    """The context of a request, bound to the owner of its key; the key must allow the request's method.

    Raises
    ------
    Unauthorized, Forbidden, ForeignSite
    """
    context = _service_context(request)
    key = given.credentials if given else None
    caller = identify(context.settings, context.engine, key)
    if not caller.known:
        require_own_site(request)
    check_method(caller, request)
    check_key = partial(identify, context.settings, context.engine, key)
    return replace(
        context, engine=for_owner(context.engine, caller.owner), caller=caller, check_key=check_key
    )


OwnerContext = Annotated[Context, Depends(authorized)]
"""For routes that take any key: sees what belongs to the key's owner."""


def _for_admins(request: Request, context: OwnerContext) -> Context:
    require_scope(context.caller, "admin")
    return _service_context(request)


AdminContext = Annotated[Context, Depends(_for_admins)]
"""For routes that take an admin's key: sees what belongs to any owner."""


def _for_anyone(request: Request) -> Context:
    context = _service_context(request)
    return replace(context, engine=for_owner(context.engine, NOBODY))


AnonymousContext = Annotated[Context, Depends(_for_anyone)]
"""For routes that take no key: sees nothing that belongs to an owner."""
