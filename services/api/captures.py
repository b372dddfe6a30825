"""Captures over HTTP."""

from collections.abc import AsyncIterator
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import anyio.to_thread
from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import BaseModel
from sqlalchemy import Row
from sqlalchemy.exc import IntegrityError

from services.api.context import After, Context, Limit, Needs
from services.api.errors import TooLarge, WrongMediaType
from storage import captures, jobs
from storage.captures import Stack
from storage.database import captures as table
from storage.database import new_id, page, writing
from storage.errors import CaptureError, Conflict, NotFound
from workflows.images import encode_png
from workflows.ingest.bundle import Bundle, Manifest

router = APIRouter(tags=["captures"])
CALL = "POST /v1/captures"


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
    problem: dict[str, Any] | None
    created_at: datetime
    expires_at: datetime | None

    @classmethod
    def of(cls, row: Row[Any]) -> "Capture":
        return cls(
            **{
                name: getattr(row, name)
                for name in cls.model_fields
                if name not in ("created_at", "expires_at")
            },
            created_at=datetime.fromtimestamp(row.created_at, UTC),
            expires_at=None,
        )


class Captures(BaseModel):
    """A page of captures, newest first."""

    captures: list[Capture]


Key = Annotated[str | None, Header(alias="Idempotency-Key", max_length=256)]


@router.post(
    "/captures",
    status_code=201,
    openapi_extra={
        "requestBody": {"content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}}}
    },
)
async def upload(
    context: Needs,
    request: Request,
    response: Response,
    name: Annotated[str, Query(max_length=200, description="A name for people.")] = "",
    idempotency_key: Key = None,
) -> Capture:
    """Upload a capture: the body is its ZIP, format envmatte-capture/1."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != "application/zip":
        raise WrongMediaType(
            f"send the ZIP of a capture as application/zip, not as {media_type or 'nothing'}"
        )
    limit = context.settings.upload_bytes
    if int(request.headers.get("content-length", 0)) > limit:
        raise _too_large(limit)
    row = await anyio.to_thread.run_sync(_made, context, idempotency_key)
    if row is None:
        capture = new_id()
        size = await _receive(context, capture, request.stream(), limit)
        row = await anyio.to_thread.run_sync(_register, context, capture, size, name, idempotency_key)
    response.headers["Location"] = f"/v1/captures/{row.id}"
    return Capture.of(row)


@router.get("/captures")
def list_captures(
    context: Needs,
    limit: Limit = 100,
    after: After = None,
    state: Literal["ingesting", "ready", "failed"] | None = None,
) -> Captures:
    """Captures, newest first."""
    with context.engine.connect() as c:
        return Captures(captures=[Capture.of(row) for row in page(c, table, limit, after, state=state)])


@router.get("/captures/{id}")
def get_capture(context: Needs, id: str) -> Capture:
    """A capture."""
    with context.engine.connect() as c:
        return Capture.of(captures.get(c, id))


@router.delete("/captures/{id}", status_code=204)
def delete_capture(context: Needs, id: str) -> None:
    """Delete a capture and its frames; mattes that were recovered from it stay."""
    with writing(context.engine) as c:
        captures.get(c, id)
        busy = [row.id for row in jobs.active(c) if row.capture == id]
        if busy:
            raise Conflict(f"job {busy[0]} works on capture {id}; cancel it first, or wait for it")
        captures.forget(c, id)
    context.objects.delete(captures.path(id))
    context.objects.delete(captures.upload_path(id))


@router.get("/captures/{id}/frames/{n}.png", response_class=Response)
def get_frame(context: Needs, id: str, n: int) -> Response:
    """A frame as it was stored."""
    with context.engine.connect() as c:
        row = captures.get(c, id)
    if row.state != "ready":
        raise Conflict(f"capture {id} is {row.state}; its frames can be seen once it is ready")
    if not 0 <= n < row.frames:
        raise NotFound(f"capture {id} has the frames 0 to {row.frames - 1}", field="n")
    frame = Stack(context.objects, id).read(frames=slice(n, n + 1))[0]
    return Response(encode_png(frame), media_type="image/png")


async def _receive(context: Context, capture: str, body: AsyncIterator[bytes], limit: int) -> int:
    """Stream a body into the store; what is cut off or too large leaves nothing."""
    size = 0
    async with context.objects.write(captures.upload_path(capture)) as file:
        async for part in body:
            size += len(part)
            if size > limit:
                raise _too_large(limit)
            await file.write(part)
    return size


def _made(context: Context, key: str | None) -> Row[Any] | None:
    with context.engine.connect() as c:
        made = jobs.made_by(c, key, CALL) if key else None
        return captures.get(c, made) if made else None


def _register(context: Context, capture: str, size: int, name: str, key: str | None) -> Row[Any]:
    """Check an uploaded archive, and write it down with its ingest job; what is refused is deleted."""
    path = captures.upload_path(capture)
    try:
        manifest = _manifest(context, path)
        with writing(context.engine) as c:
            job = jobs.add(c, "ingest", capture, {})
            captures.add(
                c,
                capture,
                job,
                name=name or manifest.name,
                bytes=size,
                frames=len(manifest.frames),
                program=manifest.program.model_dump(mode="json"),
            )
            if key:
                jobs.remember(c, key, CALL, capture)
            return captures.get(c, capture)
    except IntegrityError:  # a repeat with the same key was quicker
        context.objects.delete(path)
        row = _made(context, key)
        if row is None:
            raise
        return row
    except BaseException:
        context.objects.delete(path)
        raise


def _manifest(context: Context, path: str) -> Manifest:
    try:
        with context.objects.read(path) as file:
            return Bundle(file, context.settings.limits).manifest
    except FileNotFoundError as error:
        raise CaptureError("the body is empty: send the ZIP of a capture") from error


def _too_large(limit: int) -> TooLarge:
    return TooLarge(
        f"an archive may have {limit} bytes; split the capture or raise ENVMATTE_UPLOAD_BYTES", limit=limit
    )
