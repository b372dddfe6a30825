"""What request handlers work with: settings, database and store, bound to the owner of the request's key."""

import asyncio
import time
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, TypeVar, TypeVarTuple, Unpack

import anyio.to_thread
from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials
from sqlalchemy import Connection, Engine

from services.api.auth import STRANGER, Caller, bearer, check_method, identify, require_scope
from services.api.http.browser_security import require_own_site
from services.api.http.responses import FileStreamResponse
from services.api.http.shared_reads import SharedReads
from services.api.work import RequestShares, Shares, run
from services.decoding.pool import Decoders
from services.settings import Settings
from storage.database.engine import reading
from storage.database.owners import for_owner
from storage.errors import Corrupt, InvalidInput, TooMany, Unavailable
from storage.objects.store import Objects
from workflows.composite.cache import Cache

T = TypeVar("T")
R = TypeVar("R")
Args = TypeVarTuple("Args")
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
    shares: RequestShares
    shared_reads: SharedReads = field(default_factory=SharedReads)
    """Reads what streams of events follow."""
    caller: Caller = STRANGER
    check_key: Callable[[], object] = lambda: None
    """Checks again that the caller's key is valid, as `auth.identify` does: for requests that take long."""

    async def call(self, work: Callable[[Unpack[Args]], T], *args: *Args) -> T:
        """Do short work of a request in a thread, in its owner's turn.

        Raises
        ------
        TooMany
            If its turn does not come within ENVMATTE_REQUEST_SECONDS.
        """
        async with self.shares.calls.take(self.caller.owner, self.settings.request_seconds):
            return await anyio.to_thread.run_sync(work, *args)

    async def compute(
        self,
        request: Request,
        shares: Shares,
        work: Callable[[], T],
        amount: int = 1,
        *,
        memory: int = 0,
        seconds: float | None = None,
    ) -> T:
        """Do the work of a request in a thread, see `services.api.work.run`.

        Parameters
        ----------
        shares : Shares
            Of what the work takes an amount.
        memory : int
            Bytes that it takes besides. More than an owner's share counts as all of it: it is done, one at a time.
        seconds : float, optional
            How long it may take; by default ENVMATTE_REQUEST_SECONDS.

        Raises
        ------
        TooMany
            If too many bytes of the owner's earlier answers have not been read, and as of `services.api.work.run`.
        """
        owner = self.caller.owner
        needed = [(self.shares.answers, 1), (shares, amount)]
        if memory:
            needed.append((self.shares.memory, min(memory, self.shares.memory.each)))

        def begin() -> T:
            if self.shares.answers.exceeded(owner):  # by answers that began before this one's turn
                raise TooMany(
                    "earlier answers have not been read yet; read those, or send this request again later"
                )
            return work()

        result = await run(request, owner, seconds or self.settings.request_seconds, needed, begin)
        if isinstance(result, FileStreamResponse):
            result.release = self.shares.answers.keep(owner, result.size)
        return result

    @contextmanager
    def stored(self, get: Callable[[Connection, str], R], id: str) -> Iterator[R]:
        """Look a row up, for a block that reads what is stored of it.

        The block may find things missing because it was deleted meanwhile: it is looked up again before they count as
        damaged.

        Raises
        ------
        NotFound
            If there is no such row, or it was deleted during the block.
        """
        with reading(self.engine) as c:
            row = get(c, id)
        try:
            yield row
        except (Corrupt, FileNotFoundError):
            with reading(self.engine) as c:
                get(c, id)
            raise

    async def follow(self, what: Hashable, read: Callable[[], T]) -> T:
        """Read something of the owner's again, in a moment, together with what other requests follow.

        Parameters
        ----------
        what : hashable
            What ``read`` reads.

        Raises
        ------
        Unauthorized
            If the key was revoked.
        """
        _, found = await asyncio.gather(
            self.shared_reads.read(self.caller.owner, self.caller, self.check_key),
            self.shared_reads.read(self.caller.owner, what, read),
        )
        return found

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

PublicContext = Annotated[Context, Depends(_service_context)]
"""For routes without a key, which must check otherwise what a request may see: sees what belongs to any owner."""


def _for_lists(request: Request, context: OwnerContext) -> Context:
    """A filter that is misspelt would list all, and what follows may delete all."""
    known = {one.alias for one in request.scope["route"].dependant.query_params}
    for name in request.query_params:
        if name not in known:
            raise InvalidInput(f"{name}: this list takes {', '.join(sorted(known))}", field=name)
    return context


ListContext = Annotated[Context, Depends(_for_lists)]
"""For lists: the same, and refuses parameters that the list does not have."""


def _for_admins(request: Request, context: OwnerContext) -> Context:
    require_scope(context.caller, "admin")
    return replace(_service_context(request), caller=context.caller)


AdminContext = Annotated[Context, Depends(_for_admins)]
"""For routes that take an admin's key: sees what belongs to any owner."""
