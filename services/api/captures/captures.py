"""Captures over HTTP."""

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import anyio.to_thread
from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Connection, Row

from services.api.context import Context, OwnerContext
from services.api.http.bodies import read_json, schema_of, store_body, upload_limit
from services.api.http.idempotency import IdempotencyKey, find_earlier, idempotent
from services.api.http.media_types import JSON, ZIP, media_type_of
from services.api.http.responses import answered, time_of
from services.api.http.types import After, Limit
from services.api.quotas import admit, admit_upload
from services.runtime import tracing
from services.runtime.problems import WrongMediaType
from services.webhooks.sender import check_webhook
from storage.database.engine import reading, writing
from storage.database.rows import new_id, page
from storage.database.tables import captures as table
from storage.errors import CaptureError, Conflict, NotFound
from storage.layout import captures as stored_captures
from storage.layout import uploads as stored_uploads
from storage.layout.captures import Stack
from storage.layout.uploads import Part
from storage.records import captures, jobs, uploads
from workflows.images.integer_formats import encode_png
from workflows.ingest.archive import CaptureArchive

router = APIRouter(tags=["captures"])
CALL = "POST /v1/captures"
FROM_UPLOAD_BYTES = 1 << 16
ONLY = "all"
"""The one part of an archive that is sent as one body."""


class Capture(BaseModel):
    """A capture."""

    id: str
    name: str
    state: Literal["ingesting", "ready", "failed"]
    job: str
    width: int | None
    height: int | None
    frames: int
    program: dict[str, Any]
    bytes: int
    report: str | None
    problem: dict[str, Any] | None
    created_at: datetime
    expires_at: datetime | None

    @classmethod
    def of(cls, row: Row[Any]) -> "Capture":
        return cls(
            **{
                name: getattr(row, name)
                for name in cls.model_fields
                if name not in ("created_at", "expires_at", "report")
            },
            report=f"/v1/captures/{row.id}/report" if row.state == "ready" else None,
            created_at=datetime.fromtimestamp(row.created_at, UTC),
            expires_at=time_of(row.expires_at),
        )


class Captures(BaseModel):
    """A page of captures, newest first."""

    captures: list[Capture]


class FromUpload(BaseModel):
    """A finished resumable upload to make a capture from."""

    model_config = ConfigDict(extra="forbid")
    upload: str
    name: str = Field("", max_length=200)
    webhook: str | None = Field(None, description="URL, https, that is told when the capture is ingested.")


@router.post(
    "/captures",
    status_code=201,
    openapi_extra={
        "requestBody": {
            "content": {
                ZIP: {"schema": {"type": "string", "format": "binary"}},
                JSON: {"schema": schema_of(FromUpload)},
            }
        }
    },
)
async def upload(
    context: OwnerContext,
    request: Request,
    response: Response,
    name: Annotated[str, Query(max_length=200, description="A name for people.")] = "",
    webhook: Annotated[str | None, Query(description="URL, https, that is told when it is ingested.")] = None,
    idempotency_key: IdempotencyKey = None,
) -> Capture:
    """Make a capture: the body is its ZIP, format envmatte-capture/1, or names the upload that has brought it.

    `name` and `webhook` of the query are for a ZIP; JSON has its own.
    """
    media_type = media_type_of(request)
    if media_type == JSON:
        wanted = await read_json(request, FromUpload, FROM_UPLOAD_BYTES)
        row = await anyio.to_thread.run_sync(
            _from_upload, context, wanted, idempotency_key, limiter=context.captures
        )
    elif media_type == ZIP:
        row = await _from_body(context, request, name, idempotency_key, webhook)
    else:
        raise WrongMediaType(
            f"send the ZIP of a capture as {ZIP}, not as {media_type or 'nothing'}, or the id of a finished upload "
            f"as {JSON}"
        )
    response.headers["Location"] = f"/v1/captures/{row.id}"
    return Capture.of(row)


@router.get("/captures")
def list_captures(
    context: OwnerContext,
    limit: Limit = 100,
    after: After = None,
    state: Literal["ingesting", "ready", "failed"] | None = None,
) -> Captures:
    """Captures, newest first."""
    with reading(context.engine) as c:
        return Captures(captures=[Capture.of(row) for row in page(c, table, limit, after, state=state)])


@router.get("/captures/{id}")
def get_capture(context: OwnerContext, id: str) -> Capture:
    """A capture."""
    with reading(context.engine) as c:
        return Capture.of(captures.get(c, id))


@router.delete("/captures/{id}", status_code=204)
def delete_capture(context: OwnerContext, id: str) -> None:
    """Delete a capture and its frames; mattes that were recovered from it stay."""
    with writing(context.engine) as c:
        captures.get(c, id)
        busy = [row.id for row in jobs.active(c) if row.capture == id]
        if busy:
            raise Conflict(f"job {busy[0]} works on capture {id}; cancel it first, or wait for it")
        captures.delete(c, id)
    context.objects.delete(stored_captures.path(id))
    stored_uploads.remove(context.objects, id)


@router.get("/captures/{id}/frames/{n}.png", response_class=Response)
def get_frame(context: OwnerContext, id: str, n: int) -> Response:
    """A frame as it was stored."""
    with reading(context.engine) as c:
        row = captures.get(c, id)
    if row.state != "ready":
        raise Conflict(f"capture {id} is {row.state}; its frames can be seen once it is ready")
    if not 0 <= n < row.frames:
        raise NotFound(f"capture {id} has the frames 0 to {row.frames - 1}", field="n")
    frame = Stack(context.objects, id).read(frames=slice(n, n + 1))[0]
    return answered(encode_png(frame), "image/png")


async def _from_body(
    context: Context, request: Request, name: str, key: str | None, webhook: str | None
) -> Row[Any]:
    """Stream the archive into the store; what is cut off, too large or refused leaves nothing."""
    await anyio.to_thread.run_sync(check_webhook, webhook, context.settings)  # which looks its host up
    limit = upload_limit(context.settings)
    length = limit.check_announced(request)
    earlier = await anyio.to_thread.run_sync(_find_earlier, context, key)
    if earlier is not None:
        return earlier
    await anyio.to_thread.run_sync(_admit, context, length)
    capture = new_id()
    try:
        size = await store_body(request, context.objects, stored_uploads.part_path(capture, ONLY), limit)
        given = context, capture, [Part(ONLY, size)], name, key, False, webhook
        row = await anyio.to_thread.run_sync(_register, *given, limiter=context.captures)
    except Exception:
        # Not when cancelled, where `_register` may still be at work: the next start sweeps then.
        await anyio.to_thread.run_sync(stored_uploads.remove, context.objects, capture)
        raise
    if row.id != capture:  # a repeat with the same key was quicker
        await anyio.to_thread.run_sync(stored_uploads.remove, context.objects, capture)
    return row


def _from_upload(context: Context, wanted: FromUpload, key: str | None) -> Row[Any]:
    """Make a capture from a finished upload, under the same id; a repeat answers with it."""
    upload = wanted.upload
    check_webhook(wanted.webhook, context.settings)
    earlier = _find_earlier(context, key)
    if earlier is not None:
        return earlier
    with reading(context.engine) as c:
        if captures.exists(c, upload):
            return captures.get(c, upload)
        row = uploads.get(c, upload)
        parts = uploads.parts_of(c, upload)
    if row.offset < row.length:
        raise Conflict(
            f"{row.offset} of the {row.length} bytes of upload {upload} have come; send the rest first",
            offset=row.offset,
        )
    try:
        return _register(context, upload, parts, wanted.name, key, True, wanted.webhook)
    except (CaptureError, NotFound, FileNotFoundError) as error:
        with writing(context.engine) as c:
            if captures.exists(c, upload):  # a repeat was quicker
                return captures.get(c, upload)
            uploads.get(c, upload)
            if isinstance(error, CaptureError):  # it would be refused again
                uploads.delete(c, upload)
        if isinstance(error, CaptureError):
            stored_uploads.remove(context.objects, upload)
        raise


def _find_earlier(context: Context, key: str | None) -> Row[Any] | None:
    return find_earlier(context.engine, key, CALL, captures.get)


def _admit(context: Context, length: int) -> None:
    with reading(context.engine) as c:
        admit_upload(c, context.settings, context.objects, length, captures=1, jobs=1)


def _register(
    context: Context,
    capture: str,
    parts: list[Part],
    name: str,
    key: str | None,
    resumable: bool,
    webhook: str | None = None,
) -> Row[Any]:
    """Check an archive that is complete, and write it down as a capture with its ingest job."""
    context.check_key()
    stored_uploads.seal(context.objects, capture, parts)
    with stored_uploads.read(context.objects, capture) as file:
        manifest = CaptureArchive(file, context.settings.limits).manifest

    def create(c: Connection) -> str:
        if resumable and not uploads.delete(c, capture):
            raise NotFound(f"upload {capture} is gone")
        size = sum(part.size for part in parts)
        admit(c, context.settings, captures=1, jobs=1, size=size)
        job = jobs.add(c, "ingest", capture, {}, trace=tracing.asked_by(), webhook=webhook)
        captures.add(
            c,
            capture,
            job,
            name=name or manifest.name,
            seconds=context.settings.capture_seconds,
            bytes=size,
            frames=len(manifest.frames) or manifest.program.count,
            program=manifest.program.model_dump(mode="json"),
        )
        return capture

    return idempotent(context.engine, key, CALL, captures.get, create)
