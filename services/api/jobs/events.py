"""What changes, followed by server-sent events: each time that it has, all of it."""

import hashlib
import time
from collections.abc import AsyncIterator, Callable
from typing import Annotated, TypeVar

import anyio
import anyio.to_thread
from fastapi import APIRouter, Header, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import format_sse_event
from pydantic import BaseModel

from services.api.context import Context, OwnerContext
from services.api.jobs.jobs import Job
from services.runtime.problems import Unauthorized
from storage.database.engine import reading
from storage.errors import NotFound, Unavailable
from storage.records import jobs

router = APIRouter(tags=["jobs"])
MEDIA_TYPE = "text/event-stream"
T = TypeVar("T", bound=BaseModel)
LOOK = 0.5
"""Seconds between two looks at a job."""
ALIVE = 15.0
"""Seconds without an event after which a comment is sent, so that nobody between takes the connection for dead."""
CLOCKS = {"queued_seconds", "run_seconds", "eta_seconds"}
"""What changes though nothing happens."""


@router.get(
    "/jobs/{id}/events",
    response_class=StreamingResponse,
    responses={
        200: {"content": {MEDIA_TYPE: {}}, "description": "An event each time that the job has changed"},
        204: {"description": "It has ended, and the caller has seen it: an `EventSource` asks no more"},
    },
)
async def follow_job(
    context: OwnerContext, id: str, last_event_id: Annotated[str | None, Header(max_length=256)] = None
) -> Response:
    """The job, now and each time that it has changed, until it has ended; every event is all of it.

    With `Last-Event-ID`, which an `EventSource` sends when it comes back, the first event is the first that is new.
    """
    job = await anyio.to_thread.run_sync(_read, context, id)
    if _is_over(job) and _mark(job) == last_event_id:
        return Response(status_code=204)
    return stream(lambda: _read(context, id), job, _mark, last_event_id, _is_over)


def stream(
    read: Callable[[], T],
    found: T,
    mark: Callable[[T], str],
    seen: str | None,
    is_over: Callable[[T], bool] = lambda found: False,
) -> StreamingResponse:
    """Server-sent events of something: an event each time that its mark is another one.

    Parameters
    ----------
    read : callable
        Reads it anew, in a thread.
    found : pydantic.BaseModel
        As it was read just now.
    mark : callable
        The id of the event that it makes.
    seen : str, optional
        The mark that the caller has had.
    is_over : callable
        Whether it will not change any more: then the stream ends.
    """
    return StreamingResponse(
        _events(read, found, mark, seen, is_over),
        media_type=MEDIA_TYPE,
        headers={"Cache-Control": "no-store"},
    )


async def _events(
    read: Callable[[], T], found: T, mark: Callable[[T], str], seen: str | None, is_over: Callable[[T], bool]
) -> AsyncIterator[bytes]:
    sent_at = time.monotonic()
    while True:
        now = mark(found)
        if now != seen:
            yield format_sse_event(data_str=found.model_dump_json(), id=now)
            seen, sent_at = now, time.monotonic()
        elif time.monotonic() - sent_at > ALIVE:
            yield b": nothing new\n\n"
            sent_at = time.monotonic()
        if is_over(found):
            return
        await anyio.sleep(LOOK)
        try:
            found = await anyio.to_thread.run_sync(read)
        except (NotFound, Unauthorized):  # deleted meanwhile, or the caller's key revoked
            return
        except Unavailable:  # the database is away, and comes back
            continue


def _is_over(job: Job) -> bool:
    return job.state not in jobs.ACTIVE


def _read(context: Context, id: str) -> Job:
    context.check_key()
    with reading(context.engine) as c:
        return Job.read(c, id)


def _mark(job: Job) -> str:
    """The id of the event that a job as it is now makes."""
    return hashlib.blake2b(job.model_dump_json(exclude=CLOCKS).encode(), digest_size=8).hexdigest()
