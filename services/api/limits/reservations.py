"""Room for bodies: reserved against the limits before their bytes are written, in the database that all APIs share."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

import anyio.to_thread

from services.api.context import Context
from services.api.limits.quotas import NewData, admit_bytes, admit_upload
from storage.database.engine import reading, writing
from storage.errors import NEARLY_FULL, Conflict, NoRoom, Unavailable
from storage.objects import marker
from storage.records import bodies

STEP = 8 << 20
"""Bytes that a body reserves at a time: a commit for each. What it merely announces keeps others out less long."""

QUIET = 2.0
"""Seconds without bytes after which a body leaves its upload to another request."""


class Reservation:
    """What is reserved for one body, while it comes.

    Parameters
    ----------
    id : str
        Of its row.
    size : int
        Bytes that are reserved already.
    limit : int
        Most bytes that the body may have.
    check_every : float
        Seconds between two looks at the row, also while nothing comes.
    """

    def __init__(self, context: Context, id: str, size: int, limit: int, check_every: float) -> None:
        self.id = id
        self._context = context
        self._size, self._limit = size, limit
        self._check_every = check_every
        self._come = self._looked_at = self._recorded = 0
        self._renewed_at = self._came_at = time.monotonic()

    async def watch(self, pieces: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """The pieces of the body, as long as there is room for them.

        Raises
        ------
        NoRoom
            In place of a piece that a limit or the disk has no room for.
        Conflict
            If the upload was deleted, or if nothing comes and another request wants to continue the upload: a
            client that has reconnected need not wait until its broken connection is given up.
        """
        coming: asyncio.Future[bytes | None] | None = None
        checked_at = time.monotonic()
        try:
            while True:
                coming = coming or asyncio.ensure_future(_next(pieces))
                await asyncio.wait({coming}, timeout=self._check_every)
                if time.monotonic() - checked_at >= self._check_every:
                    await self._context.call(self._check)
                    checked_at = time.monotonic()
                if not coming.done():
                    continue
                piece, coming = coming.result(), None
                if piece is None:
                    return
                self._come += len(piece)
                self._came_at = time.monotonic()
                if self._come > self._size:
                    await self._context.call(self._grow)
                if self._come - self._looked_at >= STEP:
                    await anyio.to_thread.run_sync(self._look_at_disk)
                yield piece
        finally:
            if coming is not None:
                coming.cancel()

    def recorded(self, size: int) -> None:
        """Count bytes no more that were recorded as stored by `bodies.record`."""
        self._recorded += size

    def release(self) -> None:
        """Release what is reserved; if the database is away, the row lapses."""
        with suppress(Unavailable, NoRoom), writing(self._context.engine) as c:
            bodies.release(c, self.id)

    def _check(self) -> None:
        """Renew the row where that is due, and look whether the body may go on."""
        with suppress(Unavailable):  # the database may come back
            if time.monotonic() - self._renewed_at >= bodies.RENEW:
                self._renew()
            with reading(self._context.engine) as c:
                wanted = bodies.is_wanted(c, self.id)
            if wanted and time.monotonic() - self._came_at > QUIET:
                raise Conflict("another request continues this upload; request its offset")

    def _renew(self, more: int = 0) -> None:
        with writing(self._context.engine) as c:
            bodies.renew(c, self.id, self._come - self._recorded, more)
            if more:
                admit_bytes(c, self._context.settings, self._context.objects)
        self._renewed_at = time.monotonic()
        self._size += more

    def _grow(self) -> None:
        lacking = self._come - self._size
        try:
            self._renew(max(min(STEP, self._limit - self._size), lacking))
        except NoRoom:  # for a whole step
            self._renew(lacking)

    def _look_at_disk(self) -> None:
        self._looked_at = self._come
        marker.require_mounted(self._context.objects)
        spare = self._context.objects.spare_bytes()
        if spare is not None and spare < 0:  # something else has filled it
            raise NoRoom(NEARLY_FULL)


async def _next(pieces: AsyncIterator[bytes]) -> bytes | None:
    return await anext(pieces, None)


@asynccontextmanager
async def reserved(
    context: Context,
    id: str,
    wanted: NewData,
    limit: int,
    remove: Callable[[], object] | None = None,
) -> AsyncIterator[Reservation]:
    """Reserve room for the body of a request, until the block ends.

    Parameters
    ----------
    id : str
        Of what the body becomes. The transaction that adds it releases the reservation, so that its bytes count once.
    wanted : NewData
        Its size is that which the request announces, 0 if it announces none.
    limit : int
        Most bytes that it may have.
    remove : callable, optional
        Removes what the block has stored, if it fails.

    Raises
    ------
    NoRoom, TooMany
    """

    def reserve() -> None:
        with writing(context.engine) as c:
            admit_upload(c, context.settings, context.objects, wanted)
            bodies.add(c, id, min(wanted.size, STEP), wanted.size)

    await context.call(reserve)
    first, most = min(wanted.size, STEP), wanted.size or limit
    reservation = Reservation(context, id, first, most, check_every=bodies.RENEW)
    try:
        yield reservation
    except Unavailable:  # its row may be there; a sweep removes what has none
        raise
    except Exception:  # not when cancelled: a thread may still be at work on it
        if remove is not None:
            await anyio.to_thread.run_sync(remove)
        raise
    finally:
        await anyio.to_thread.run_sync(reservation.release)
