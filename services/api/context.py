"""What every request handler needs: the settings, the database as the caller may see it, and the store."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

from anyio import CapacityLimiter
from fastapi import Depends, Query, Request
from fastapi.security import HTTPAuthorizationCredentials
from pydantic import Field
from sqlalchemy import Engine

from services.api.auth import ADMIN, Caller, bearer, demand, identify, see_that_it_may
from services.api.http.browser_security import see_that_no_site_asks
from services.decoding.pool import Decoders
from services.settings import Settings
from storage.database.owners import NOBODY, bound
from storage.errors import Unavailable
from storage.objects.store import Objects
from workflows.composite.cache import Cache
from workflows.composite.threads import CORES

LOOK = 1.0
"""Seconds between two looks at the key of whoever downloads."""
WEB = Path(__file__).parents[1] / "web"
"""The browser's files."""


@dataclass(frozen=True)
class Context:
    """Built once with the app, and for each request bound to whoever calls, see `Needs`."""

    settings: Settings
    engine: Engine
    """Of the database. A request's own shows what belongs to the caller, see `storage.database.owners`."""
    objects: Objects
    cache: Cache
    """Strips of mattes."""
    decoders: Decoders
    """What decodes what strangers send."""
    pictures: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(4))
    """Pictures of programs that are drawn at once, which bounds what they take."""
    films: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    """Videos of programs that are encoded at once."""
    composites: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(CORES + 1))
    """Composites that are made at once, which bounds what they take: one more than there are cores."""
    bundles: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    """Bundles whose records are read at once, for one may take 200 MB."""
    imports: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    """Archives of mattes that are unpacked at once."""
    layers: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    """Layers of mattes that are encoded at once."""
    caller: Caller = ADMIN
    check: Callable[[], object] = lambda: None
    """Look at the caller's key once more, as `access.identify` does: for what goes on long after its first look."""

    def while_allowed(self, pieces: Iterable[bytes]) -> Iterator[bytes]:
        """Pieces of an answer, as long as the caller's key is good.

        Raises
        ------
        Unauthorized
            Within a second's pieces of its end.
        """
        looked_at = time.monotonic()
        for piece in pieces:
            if time.monotonic() - looked_at > LOOK:
                with suppress(Unavailable):  # the database is away, and comes back
                    self.check()
                looked_at = time.monotonic()
            yield piece


Key = Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]


def _unbound(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


def authorized(request: Request, given: Key) -> Context:
    """The context of a request whose key allows its method, bound to the owner of the key.

    Raises
    ------
    Unauthorized, Forbidden, ForeignSite
    """
    context = _unbound(request)
    key = given.credentials if given else None
    caller = identify(context.settings, context.engine, key)
    if not caller.known:
        see_that_no_site_asks(request)
    see_that_it_may(caller, request)
    check = partial(identify, context.settings, context.engine, key)
    return replace(context, engine=bound(context.engine, caller.owner), caller=caller, check=check)


Needs = Annotated[Context, Depends(authorized)]
"""For whoever has a key: what is his."""


def _whole(request: Request, context: Needs) -> Context:
    demand(context.caller, "admin")
    return _unbound(request)


Whole = Annotated[Context, Depends(_whole)]
"""For admins: the service, with what is anyone's."""


def _keyless(request: Request) -> Context:
    context = _unbound(request)
    return replace(context, engine=bound(context.engine, NOBODY))


Keyless = Annotated[Context, Depends(_keyless)]
"""For anyone: what is nobody's."""
# Lists, and not tuples, whose schema few generators of clients know.
Pair = Annotated[list[int], Field(min_length=2, max_length=2)]
Colour = Annotated[list[float], Field(min_length=3, max_length=3)]
Limit = Annotated[int, Query(ge=1, le=1000, description="The most items to list.")]
After = Annotated[str | None, Query(description="The id of the last item of the page before.")]
