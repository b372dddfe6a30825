"""A job followed by server-sent events: each time it has changed, all of it."""

import hashlib
import time
from collections.abc import AsyncIterator
from typing import Annotated

import anyio
import anyio.to_thread
from fastapi import APIRouter, Header, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import format_sse_event

from services.api.context import Context, Needs
from services.api.errors import Unauthorized
from services.api.jobs import Job
from storage import jobs
from storage.database import reading
from storage.errors import NotFound, Unavailable

router = APIRouter(tags=["jobs"])
MEDIA_TYPE = "text/event-stream"
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
    context: Needs, id: str, last_event_id: Annotated[str | None, Header(max_length=256)] = None
) -> Response:
    """The job, now and each time that it has changed, until it has ended; every event is all of it.

    With `Last-Event-ID`, which an `EventSource` sends when it comes back, the first event is the first that is new.
    """
    job = await anyio.to_thread.run_sync(_read, context, id)
    if job.state not in jobs.ACTIVE and _mark(job) == last_event_id:
        return Response(status_code=204)
    events = _events(context, job, last_event_id)
    return StreamingResponse(events, media_type=MEDIA_TYPE, headers={"Cache-Control": "no-store"})


async def _events(context: Context, job: Job, seen: str | None) -> AsyncIterator[bytes]:
    sent_at = time.monotonic()
    while True:
        mark = _mark(job)
        if mark != seen:
            yield format_sse_event(data_str=job.model_dump_json(), id=mark)
            seen, sent_at = mark, time.monotonic()
        elif time.monotonic() - sent_at > ALIVE:
            yield b": nothing new\n\n"
            sent_at = time.monotonic()
        if job.state not in jobs.ACTIVE:
            return
        await anyio.sleep(LOOK)
        try:
            job = await anyio.to_thread.run_sync(_read, context, job.id)
        except (NotFound, Unauthorized):  # deleted meanwhile, or the caller's key revoked
            return
        except Unavailable:  # the database is away, and comes back
            continue


def _read(context: Context, id: str) -> Job:
    context.check()
    with reading(context.engine) as c:
        return Job.of(c, jobs.get(c, id))


def _mark(job: Job) -> str:
    """The id of the event that a job as it is now makes."""
    return hashlib.blake2b(job.model_dump_json(exclude=CLOCKS).encode(), digest_size=8).hexdigest()
