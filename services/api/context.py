"""What every request handler needs: the settings, the database as the caller may see it, and the store."""

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import IO, Annotated

from anyio import CapacityLimiter
from fastapi import Depends, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.security import HTTPAuthorizationCredentials
from pydantic import Field
from sqlalchemy import Engine
from starlette.datastructures import Headers
from starlette.types import Receive, Scope, Send

from services.api.access import ADMIN, Caller, bearer, demand, identify, see_that_it_may
from services.api.browsers import see_that_no_site_asks
from services.decoding import Decoders
from services.settings import Settings
from storage.errors import Unavailable
from storage.objects import Objects
from storage.owners import NOBODY, bound
from workflows.composite.cache import Cache
from workflows.composite.threads import CORES

HELD = 1 << 18
"""Bytes of an answer that are kept in memory while it is taken, and that are read of a file at once."""
LOOK = 1.0
"""Seconds between two looks at the key of whoever downloads."""
WEB = Path(__file__).parents[1] / "web"
"""The browser's files."""


@dataclass(frozen=True)
class Context:
    """Built once with the app, and for each request bound to whoever calls, see `Needs`."""

    settings: Settings
    engine: Engine
    """Of the database; of a request, over which no more can be seen than is the caller's, see `storage.owners`."""
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


def answered(data: bytes, media_type: str, headers: dict[str, str] | None = None) -> Response:
    """An answer, a large one from a temporary file: any number may be taken slowly. Not for the loop's thread."""
    if len(data) <= HELD:
        return Response(data, headers=headers, media_type=media_type)
    with ExitStack() as stack:
        file = stack.enter_context(tempfile.TemporaryFile())
        file.write(data)
        file.seek(0)
        stack.pop_all()  # now it is the answer's to close
    return FromFile(file, len(data), media_type, headers)


class FromFile(StreamingResponse):
    """The bytes of a file, which is closed whatever becomes of the connection."""

    def __init__(
        self, file: IO[bytes], size: int, media_type: str, headers: dict[str, str] | None = None
    ) -> None:
        length = {"Content-Length": str(size)}
        super().__init__(
            iter(partial(file.read, HELD), b""), headers=(headers or {}) | length, media_type=media_type
        )
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()


def time_of(seconds: float | None) -> datetime | None:
    """A time of the database as answers have it."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def is_known(headers: Headers, tag: str) -> bool:
    """Whether the caller has what a tag stands for (If-None-Match, RFC 9110, sect. 13.1.2)."""
    return tag in [one.strip() for one in headers.get("if-none-match", "").split(",")]
