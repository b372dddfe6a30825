"""Captures over HTTP: list, read and delete them."""

from datetime import UTC, datetime
from typing import Any, Literal

from fastapi import APIRouter, Response
from pydantic import BaseModel
from sqlalchemy import Row

from services.api.context import OwnerContext
from services.api.http.responses import bytes_response, utc_time
from services.api.http.types import After, Limit
from storage.database.engine import reading, writing
from storage.database.rows import page
from storage.database.tables import captures as table
from storage.errors import Conflict, NotFound
from storage.layout import captures as stored_captures
from storage.layout import uploads as stored_uploads
from storage.layout.captures import Stack
from storage.records import captures, jobs
from workflows.images.integer_formats import encode_png

router = APIRouter(tags=["captures"])


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
            expires_at=utc_time(row.expires_at),
        )


class Captures(BaseModel):
    """A page of captures, newest first."""

    captures: list[Capture]


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
            raise Conflict(f"job {busy[0]} is using capture {id}; cancel it first, or wait for it")
        captures.delete(c, id)
    context.objects.delete(stored_captures.path(id))
    stored_uploads.remove(context.objects, id)


@router.get("/captures/{id}/frames/{n}.png", response_class=Response)
def get_frame(context: OwnerContext, id: str, n: int) -> Response:
    """A frame as it was stored."""
    with reading(context.engine) as c:
        row = captures.get(c, id)
    if row.state != "ready":
        raise Conflict(f"capture {id} is {row.state}; its frames can be read once it is ready")
    if not 0 <= n < row.frames:
        raise NotFound(f"capture {id} has the frames 0 to {row.frames - 1}", field="n")
    frame = Stack(context.objects, id).read(frames=slice(n, n + 1))[0]
    return bytes_response(encode_png(frame), "image/png")
