"""Composites of clips over HTTP: a job composites the frames, and its video can be downloaded."""

import re
from collections.abc import Iterator
from functools import partial
from typing import Any, BinaryIO

import anyio.to_thread
from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from sqlalchemy import Connection

from services.api.context import Context, OwnerContext
from services.api.http.bodies import store_body, upload_limit
from services.api.http.errors import problem_response
from services.api.http.idempotency import find_earlier, idempotent
from services.api.http.media_types import JSON, media_type_of
from services.api.http.router import Router
from services.api.jobs.job import Job
from services.api.limits.quotas import NewData, admit
from services.api.limits.reservations import reserved
from services.runtime import tracing
from services.runtime.problems import BadRange, problem_of
from services.webhooks.sender import check_webhook
from storage.database.engine import reading
from storage.database.rows import new_id
from storage.errors import Conflict, Corrupt
from storage.layout import composites
from storage.records import bodies, jobs, mattes

router = Router(tags=["jobs"])
PIECE = 1 << 20
"""Bytes of a video that are read from the store at once."""
RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


def is_clip(request: Request) -> bool:
    """Whether the body of a request is a clip, not a picture."""
    return media_type_of(request).startswith("video/")


async def composite_clip(
    context: Context,
    request: Request,
    matte: str,
    options: dict[str, Any],
    webhook: str | None,
    key: str | None,
) -> Response:
    """Stream a clip, the body of a request, into the store, and queue the job that composites it.

    Parameters
    ----------
    options : dict
        ``transfer``, ``around``, ``fit``, and ``placement`` as `Placement` takes it.
    webhook : str, optional
        URL that is notified when the job has ended.
    key : str, optional
        The Idempotency-Key.

    Raises
    ------
    TooLarge
        Before the first byte if the request announces its length, else as soon as more than ENVMATTE_UPLOAD_BYTES
        have come.
    NoRoom
        If the store has no room for it.
    Conflict
        If the matte is not ready.
    OptionError
        If the URL can't be a webhook.
    """
    check_webhook(webhook, context.settings)
    limit = upload_limit(context.settings, "a clip")
    length = limit.check_announced(request)
    job = await context.call(find_earlier, context.engine, key, _call(matte), Job.read)
    if job is None:
        await context.call(_require_ready, context, matte)
        id, most = new_id(), context.settings.upload_bytes
        remove = partial(context.objects.delete, composites.path(id))
        async with reserved(context, id, NewData(jobs=1, size=length), most, remove) as reservation:
            pieces = reservation.watch(limit.stream(request))
            size = await store_body(pieces, context.objects, composites.clip_path(id))
            job = await context.call(_queue, context, id, matte, options, key, size, webhook)
        if job.id != id:  # a concurrent request with the same key was quicker
            await anyio.to_thread.run_sync(remove)
    headers = {"Location": f"/v1/jobs/{job.id}"}
    return Response(job.model_dump_json(), 202, headers, media_type=JSON)


@router.get(
    "/jobs/{id}/video.mp4",
    response_class=Response,
    responses={
        200: {"content": {"video/mp4": {}}, "description": "The video"},
        206: {"content": {"video/mp4": {}}, "description": "The part that `Range` asks for"},
    },
)
def get_video(context: OwnerContext, id: str, request: Request) -> Response:
    """The video of a composite job: H.264 in MP4, with the frame times of the clip, without sound."""
    with context.stored(jobs.get, id) as row:
        if row.kind != "composite" or row.state != "succeeded":
            raise Conflict(
                f"job {id} is {row.state} and has no video; a composite of a clip has one once it has succeeded"
            )
        try:
            file = context.objects.read(composites.video_path(id))
        except FileNotFoundError as error:
            raise Corrupt(f"the video of job {id} is not in the store; composite the clip again") from error
    size = file.seek(0, 2)
    start, end = _span(request.headers.get("range", ""), size)
    if start >= size:
        file.close()
        problem = problem_of(BadRange(f"the video of job {id} has {size} bytes, and none of these"))
        return problem_response(problem, {"Content-Range": f"bytes */{size}"})
    headers = {"Accept-Ranges": "bytes", "Content-Length": str(end - start)}
    part = end - start < size
    if part:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    file.seek(start)
    pieces = context.while_allowed(_pieces(file, end - start))
    return StreamingResponse(pieces, 206 if part else 200, headers, media_type="video/mp4")


def _require_ready(context: Context, matte: str) -> None:
    """Check, before a clip is sent, that its matte is ready."""
    with reading(context.engine) as c:
        mattes.get_ready(c, matte)


def _queue(
    context: Context,
    job: str,
    matte: str,
    options: dict[str, Any],
    key: str | None,
    size: int,
    webhook: str | None,
) -> Job:
    """Add the job for a stored clip; returns it, or the job of a concurrent request with the same key."""
    context.check_key()

    def create(c: Connection) -> str:
        row = mattes.get_ready(c, matte)
        bodies.release(c, job)
        admit(c, context.settings, NewData(jobs=1, size=size))
        jobs.add(
            c,
            "composite",
            row.capture or "",
            options,
            matte,
            trace=tracing.current_traceparent(),
            job=job,
            stored=size,
            webhook=webhook,
        )
        return job

    return idempotent(context.engine, key, _call(matte), Job.read, create, job)


def _call(matte: str) -> str:
    """What an Idempotency-Key belongs to: one clip may be composited with several mattes."""
    return f"POST /v1/mattes/{matte}/composite"


def _span(text: str, size: int) -> tuple[int, int]:
    """The bytes that a Range header asks for (RFC 9110, sect. 14.2): the first, and one past the last.

    A server may ignore a Range: one that is malformed, has several parts or goes beyond 10**18 gives all bytes. One
    without any byte of the video gives a start at or past its end.
    """
    found = RANGE.fullmatch(text.strip())
    if found is None or not any(found.groups()):
        return 0, size
    first, last = found.groups()
    if not first:
        return (max(size - int(last), 0), size) if int(last) else (size, size)
    end = min(int(last) + 1, size) if last else size
    return (0, size) if last and int(last) < int(first) else (int(first), end)


def _pieces(file: BinaryIO, size: int) -> Iterator[bytes]:
    with file:
        while size and (data := file.read(min(PIECE, size))):
            size -= len(data)
            yield data
