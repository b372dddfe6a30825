"""Server-sent events: a stream that sends a resource whole, now and each time that it changes."""

import hashlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Annotated, TypeVar

from fastapi import Header, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import format_sse_event
from pydantic import BaseModel

from services.api.context import Context, OwnerContext
from services.api.http.router import Router
from services.api.jobs.job import Job
from services.runtime.problems import Unauthorized
from storage.database.engine import reading
from storage.errors import NotFound, Unavailable
from storage.records import jobs

router = Router(tags=["jobs"])
MEDIA_TYPE = "text/event-stream"
T = TypeVar("T", bound=BaseModel)
KEEP_ALIVE = 15.0
"""Seconds without an event after which a comment is sent, so that no proxy closes the connection as idle."""
CLOCKS = {"queued_seconds", "run_seconds", "eta_seconds"}
"""Fields that change with time alone: they cause no event."""


@router.get(
    "/jobs/{id}/events",
    response_class=StreamingResponse,
    responses={
        200: {"content": {MEDIA_TYPE: {}}, "description": "An event each time that the job changes"},
        204: {"description": "The job has ended and the caller has seen it: an `EventSource` stops asking"},
    },
)
async def follow_job(
    context: OwnerContext, id: str, last_event_id: Annotated[str | None, Header(max_length=256)] = None
) -> Response:
    """The job, now and each time that it changes, until it has ended. Every event is the whole job.

    With `Last-Event-ID`, which an `EventSource` sends when it reconnects, the stream starts with the first new event.
    """
    job = await context.call(_read, context, id)
    if _has_ended(job) and _event_id(job) == last_event_id:
        return Response(status_code=204)

    async def read() -> Job:
        return await context.follow(("job", id), partial(_read, context, id))

    return stream(read, job, _event_id, last_event_id, _has_ended)


def stream(
    read: Callable[[], Awaitable[T]],
    current: T,
    event_id: Callable[[T], str],
    last_event_id: str | None,
    has_ended: Callable[[T], bool] = lambda current: False,
) -> StreamingResponse:
    """Send a resource as server-sent events: one each time that its event id changes.

    Parameters
    ----------
    read : callable
        Reads the resource again, in a moment.
    current : pydantic.BaseModel
        The resource as it was read just now.
    event_id : callable
        Returns the id of the event for a state of the resource.
    last_event_id : str, optional
        Id of the last event that the caller has.
    has_ended : callable
        Whether the resource will not change any more; then the stream ends.
    """
    return StreamingResponse(
        _events(read, current, event_id, last_event_id, has_ended),
        media_type=MEDIA_TYPE,
        headers={"Cache-Control": "no-store"},
    )


async def _events(
    read: Callable[[], Awaitable[T]],
    current: T,
    event_id: Callable[[T], str],
    last_event_id: str | None,
    has_ended: Callable[[T], bool],
) -> AsyncIterator[bytes]:
    sent_at = time.monotonic()
    while True:
        id = event_id(current)
        if id != last_event_id:
            yield format_sse_event(data_str=current.model_dump_json(), id=id)
            last_event_id, sent_at = id, time.monotonic()
        elif time.monotonic() - sent_at > KEEP_ALIVE:
            yield b": nothing new\n\n"
            sent_at = time.monotonic()
        if has_ended(current):
            return
        try:
            current = await read()
        except (NotFound, Unauthorized):  # deleted, or the caller's key was revoked
            return
        except Unavailable:  # the database may come back
            continue


def _has_ended(job: Job) -> bool:
    return job.state not in jobs.ACTIVE


def _read(context: Context, id: str) -> Job:
    with reading(context.engine) as c:
        return Job.read(c, id)


def _event_id(job: Job) -> str:
    """The id of the event for a state of a job."""
    return hashlib.blake2b(job.model_dump_json(exclude=CLOCKS).encode(), digest_size=8).hexdigest()
