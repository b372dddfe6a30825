"""Mattes and composites over HTTP."""

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, TypeVar

import anyio.to_thread
import numpy as np
from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel
from sqlalchemy import Row

from services.api.context import After, Context, Limit, Needs, read_body
from services.api.errors import NotAcceptable
from storage import jobs, mattes
from storage.database import mattes as table
from storage.database import page, reading, writing
from storage.errors import Conflict
from workflows import images
from workflows.composite import composite, confidence
from workflows.tone import from_light, to_light

router = APIRouter(tags=["mattes"])
R = TypeVar("R")
TAKEN = ("image/png", "image/jpeg", "image/tiff")


class Matte(BaseModel):
    """A matte."""

    id: str
    state: Literal["recovering", "ready", "failed"]
    capture: str
    job: str
    options: dict[str, Any]
    width: int | None = None
    height: int | None = None
    monitor: tuple[int, int] | None = None
    columns: int | None = None
    rows: int | None = None
    created_at: datetime

    @classmethod
    def of(cls, row: Row[Any]) -> "Matte":
        figures = {name: value for name, value in (row.figures or {}).items() if name in cls.model_fields}
        return cls(
            **{name: getattr(row, name) for name in ("id", "state", "capture", "job", "options")},
            **figures,
            created_at=datetime.fromtimestamp(row.created_at, UTC),
        )


class Mattes(BaseModel):
    """A page of mattes, newest first."""

    mattes: list[Matte]


@router.get("/mattes")
def list_mattes(
    context: Needs,
    limit: Limit = 100,
    after: After = None,
    state: Literal["recovering", "ready", "failed"] | None = None,
) -> Mattes:
    """Mattes, newest first."""
    with reading(context.engine) as c:
        return Mattes(mattes=[Matte.of(row) for row in page(c, table, limit, after, state=state)])


@router.get("/mattes/{id}")
def get_matte(context: Needs, id: str) -> Matte:
    """A matte."""
    with reading(context.engine) as c:
        return Matte.of(mattes.get(c, id))


@router.delete("/mattes/{id}", status_code=204)
def delete_matte(context: Needs, id: str) -> None:
    """Delete a matte."""
    with writing(context.engine) as c:
        row = mattes.get(c, id)
        if any(job.id == row.job for job in jobs.active(c)):
            raise Conflict(f"job {row.job} is recovering matte {id}; cancel it first")
        mattes.forget(c, id)
    context.objects.delete(mattes.path(id))


@router.post(
    "/mattes/{id}/composite",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The composite"}},
    openapi_extra={
        "requestBody": {
            "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in TAKEN}
        }
    },
)
async def post_composite(
    context: Needs,
    id: str,
    request: Request,
    transfer: Annotated[
        Literal["srgb", "linear"], Query(description="How the backdrop and the answer are encoded.")
    ] = "srgb",
) -> Response:
    """Put the glass before a backdrop: the body is an image, the answer a PNG of the matte's size.

    It has 8 or 16 bits as the backdrop has.
    Pixels that the capture's mask left out are transparent.
    """
    accept = request.headers.get("accept", "*/*")
    if not any(kind in accept for kind in ("*/*", "image/*", "image/png")):
        raise NotAcceptable(f"composites are answered as image/png, not as {accept}")
    row = await anyio.to_thread.run_sync(_ready, context, id)
    body = await read_body(request, context.settings.backdrop_bytes)
    picture, timing = await anyio.to_thread.run_sync(_composite, context, row.id, body, transfer)
    return Response(picture, media_type="image/png", headers={"Server-Timing": timing})


@router.get(
    "/mattes/{id}/layers/confidence.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The layer"}},
)
def get_confidence(context: Needs, id: str) -> Response:
    """How far to trust the matte, pixel by pixel: 0, not at all or not recovered, to 1, in 16 bits.

    It is 1 / (1 + e / 0.01), e the error to expect of a composite there, as a share of the camera's full scale.
    """
    layer = confidence(mattes.Matte(context.objects, _ready(context, id).id))
    answer = images.to_integers(layer[..., np.newaxis], np.dtype(np.uint16))
    return Response(images.encode_png(answer), media_type="image/png")


def _ready(context: Context, id: str) -> Row[Any]:
    with reading(context.engine) as c:
        row = mattes.get(c, id)
    if row.state != "ready":
        raise Conflict(f"matte {id} is {row.state}; job {row.job} says more")
    return row


def _composite(
    context: Context, id: str, body: bytes, transfer: Literal["srgb", "linear"]
) -> tuple[bytes, str]:
    times: list[str] = []

    def timed(name: str, function: Callable[[], R]) -> R:
        start = time.perf_counter()
        result = function()
        times.append(f"{name};dur={(time.perf_counter() - start) * 1e3:.1f}")
        return result

    pixels = timed("decode", lambda: images.decode(body, memory=context.settings.backdrop_bytes))
    matte = timed("open", lambda: mattes.Matte(context.objects, id))
    picture = timed("composite", lambda: composite(matte, to_light(images.to_unit(pixels), transfer)))
    picture[..., :3] = from_light(np.clip(picture[..., :3], 0, 1), transfer)
    opaque = bool(np.all(picture[..., 3] == 1))
    answer = images.to_integers(picture[..., :3] if opaque else picture, pixels.dtype)
    return timed("encode", lambda: images.encode_png(answer)), ", ".join(times)
