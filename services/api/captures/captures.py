"""Captures over HTTP: list, read and delete them."""

import json
from datetime import UTC, datetime
from typing import Any, Self

from fastapi import Request, Response
from pydantic import BaseModel, Field
from sqlalchemy import Connection, Row

from services.api.context import ListContext, OwnerContext
from services.api.http.responses import bytes_response, json_response, utc_time
from services.api.http.router import Router
from services.api.http.types import After, Named, PageSize
from services.api.jobs.eta import seconds_to_recover
from services.api.renaming import CHANGE, rename
from storage.database.engine import reading, writing
from storage.database.rows import page
from storage.database.tables import captures as table
from storage.errors import Conflict, NotFound
from storage.layout import captures as stored_captures
from storage.layout import uploads as stored_uploads
from storage.layout.captures import Stack
from storage.records import captures, jobs
from workflows.images.integer_formats import encode_png

router = Router(tags=["captures"])
PROGRAM_BYTES = 64 << 20
"""What the largest program that a capture may have takes in memory."""


class ListedCapture(BaseModel):
    """A capture as lists have it."""

    id: str
    name: str
    state: captures.State
    job: str
    width: int | None
    height: int | None
    frames: int
    bytes: int
    report: str | None
    problem: dict[str, Any] | None
    created_at: datetime
    expires_at: datetime | None

    @classmethod
    def of(cls, row: Row[Any]) -> Self:
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


class Capture(ListedCapture):
    """A capture. Its program may be large."""

    program: dict[str, Any]
    recovery_seconds: dict[str, float] | None = Field(
        description="How long a recovery will take on the workers that there are now, by `quality`, from a trial on "
        "some pixels; null until it is measured, without workers, and once the ingest job is deleted."
    )


def capture_response(connection: Connection, id: str) -> Response:
    """A `Capture` by its id as a response; `NotFound` if there is none. Don't call it in the event loop.

    Its program is passed on as it is stored: while JSON of megabytes is parsed or written, all threads wait.
    """
    row = captures.get(connection, id)
    known = ListedCapture.of(row).model_dump(mode="json")
    known["recovery_seconds"] = seconds_to_recover(connection, row)
    document = f'{json.dumps(known)[:-1]}, "program": {captures.program_json(connection, id)}}}'
    return bytes_response(document.encode(), "application/json")


class Captures(BaseModel):
    """A page of captures, newest first."""

    captures: list[ListedCapture]


@router.get("/captures", response_model=Captures)
async def list_captures(
    context: ListContext,
    request: Request,
    limit: PageSize = 100,
    after: After = None,
    state: captures.State | None = None,
    name: Named = None,
) -> Response:
    """Captures, newest first, without their programs."""

    def make() -> Response:
        with reading(context.engine) as c:
            rows = page(c, table, limit, after, without=captures.WITHOUT, name=name, state=state)
            return json_response(Captures(captures=[ListedCapture.of(row) for row in rows]))

    return await context.compute(request, context.shares.lists, make)


@router.get("/captures/{id}", response_model=Capture)
async def get_capture(context: OwnerContext, id: str, request: Request) -> Response:
    """A capture."""

    def make() -> Response:
        with reading(context.engine) as c:
            return capture_response(c, id)

    return await context.compute(request, context.shares.lists, make)


@router.patch("/captures/{id}", response_model=Capture, openapi_extra=CHANGE)
async def change_capture(context: OwnerContext, id: str, request: Request) -> Response:
    """Rename a capture."""
    return await rename(context, request, id, captures, capture_response)


@router.delete("/captures/{id}", status_code=204)
def delete_capture(context: OwnerContext, id: str) -> None:
    """Delete a capture and its frames; mattes that were recovered from it stay."""
    with writing(context.engine) as c:
        captures.get(c, id)
        if busy := jobs.active_job(c, capture=id):
            raise Conflict(f"job {busy} is using capture {id}; cancel it first, or wait for it")
        captures.delete(c, id)
    context.objects.delete(stored_captures.path(id))
    stored_uploads.remove(context.objects, id)


@router.get(
    "/captures/{id}/frames/{n}.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The frame"}},
)
async def get_frame(context: OwnerContext, id: str, n: int, request: Request) -> Response:
    """A frame as it was stored."""

    def measure() -> tuple[Stack, int]:
        with context.stored(captures.get, id) as row:
            if row.state != "ready":
                raise Conflict(f"capture {id} is {row.state}; its frames can be read once it is ready")
            if not 0 <= n < row.frames:
                raise NotFound(f"capture {id} has the frames 0 to {row.frames - 1}", field="n")
            stack = Stack(context.objects, id)
            return stack, int(stack.height * stack.width * stack.channels * stack.dtype.itemsize)

    def encode() -> Response:
        with context.stored(captures.get, id):
            return bytes_response(encode_png(stack.read(frames=slice(n, n + 1))[0]), "image/png")

    stack, size = await context.compute(request, context.shares.lists, measure)
    # The frame, and a PNG that is as large if the frame is noise.
    return await context.compute(request, context.shares.memory, encode, max(2 * size, PROGRAM_BYTES))
