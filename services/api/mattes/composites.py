"""Composites over HTTP."""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import IO, Annotated, Any, Literal, TypeVar

import anyio.to_thread
import numpy as np
from fastapi import APIRouter, Query, Request, Response
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from starlette.datastructures import Headers

from services.api.context import Context, OwnerContext
from services.api.errors import answer as problem_answer
from services.api.http.bodies import spool_body
from services.api.http.media_types import preferred
from services.api.http.responses import answered, is_known
from services.api.jobs.jobs import Job
from services.api.mattes import clips
from services.runtime.problems import NotAcceptable, NotNeeded, problem_of
from storage.database.engine import reading
from storage.errors import Conflict, Corrupt, OptionError
from storage.records import mattes
from storage.records import tiles as tile_records
from workflows.composite import composite
from workflows.composite.backdrop import Backdrop, backdrop_of
from workflows.composite.depth import Rays, from_one, from_two
from workflows.composite.engine import Window, shrink
from workflows.composite.placement import Placement
from workflows.composite.quantise import encode
from workflows.composite.strips import Strip
from workflows.composite.threads import CORES
from workflows.images import float_formats, integer_formats
from workflows.mattes.options import parse_options
from workflows.mattes.tiles import cut

router = APIRouter(tags=["mattes"])
R = TypeVar("R")
TAKEN = ("image/png", "image/jpeg", "image/tiff", "image/x-exr")
ANSWERS = ("image/png", "image/jpeg", "image/x-exr")
Distance = Annotated[float, Field(ge=1e-6, le=1e6)]
"""In whatever unit; far beyond it rays are no numbers any more."""


class CompositeParams(BaseModel):
    """What of a composite is wanted, and how."""

    model_config = ConfigDict(extra="forbid")
    transfer: Literal["srgb", "linear"] = Field(
        "srgb", description="How the backdrop and an answer of 8 or 16 bits encode light."
    )
    x: int = Field(0, ge=0, description="Of a crop: its first column, in pixels of the matte.")
    y: int = Field(0, ge=0, description="Its first row.")
    width: int | None = Field(None, ge=1, description="Its width; default to the edge.")
    height: int | None = Field(None, ge=1, description="Its height; default to the edge.")
    size: int | None = Field(
        None, ge=1, description="The longer side of the answer, in pixels, if it is to be smaller."
    )
    quality: int = Field(90, ge=1, le=100, description="Of a JPEG.")
    right: float = Field(0, ge=-100, le=100, description="The backdrop's move, in widths of the monitor.")
    down: float = Field(0, ge=-100, le=100, description="The same, in heights.")
    scale: float = Field(1, ge=0.01, le=100, description="By how much the backdrop is larger.")
    angle: float = Field(0, ge=-360, le=360, description="By how much it is turned, in degrees, clockwise.")

    depth: Distance | None = Field(
        None, description="Distance of the backdrop from the object, if it is not the monitor's."
    )
    distance: Distance | None = Field(
        None, description="That of the monitor in the capture, in the same unit."
    )
    camera: Distance | None = Field(None, description="That of the camera from the object.")
    other: str | None = Field(
        None, description="Or, in its place, a matte of the same object before a monitor at another distance."
    )
    other_distance: Distance | None = Field(None, description="That distance.")
    webhook: str | None = Field(
        None, description="Of a clip: URL, https, that is told when its job has ended."
    )

    @model_validator(mode="after")
    def _told(self) -> "CompositeParams":
        given = [
            name
            for name in ("distance", "camera", "other", "other_distance")
            if getattr(self, name) is not None
        ]
        enough = given in (["distance", "camera"], ["distance", "other", "other_distance"])
        if (self.depth is not None) != bool(given) or (given and not enough):
            raise ValueError(
                "a backdrop at another depth takes depth, distance and camera, or depth, distance, other and "
                "other_distance"
            )
        if self.other_distance is not None and self.other_distance == self.distance:
            raise ValueError("the two distances must differ")
        return self

    @property
    def placement(self) -> Placement | None:
        """Where the backdrop stands; None where the monitor stood."""
        wanted = Placement(self.right, self.down, self.scale, self.angle)
        return None if wanted == Placement() else wanted

    def of_a_clip(self) -> dict[str, Any]:
        """The options of a clip's job.

        Raises
        ------
        OptionError
            If what is wanted is only to be had of a still.
        """
        placement = {"right": self.right, "down": self.down, "scale": self.scale, "angle": self.angle}
        for name in self.model_fields_set - placement.keys() - {"transfer", "webhook"}:
            raise OptionError(
                f"{name} is for stills: a clip takes transfer, {', '.join(placement)}", field=name
            )
        return {"transfer": self.transfer, "placement": placement}


@router.post(
    "/mattes/{id}/composite",
    response_class=Response,
    responses={
        200: {
            "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in ANSWERS},
            "description": "The composite",
        },
        202: {"description": "The job that composites a clip", "model": Job},
    },
    openapi_extra={
        "requestBody": {
            "content": {
                kind: {"schema": {"type": "string", "format": "binary"}} for kind in (*TAKEN, "video/*")
            }
        }
    },
)
async def post_composite(
    context: OwnerContext, id: str, request: Request, wanted: Annotated[CompositeParams, Query()]
) -> Response:
    """Put the glass before a backdrop: the body is an image, the answer one of the matte's size.

    A PNG has 8 or 16 bits as the backdrop has, 16 if that is float; what was not recovered is transparent in it, and
    black in a JPEG. An EXR is linear light, and may be negative or above 1. A matte that is still being recovered is
    composited as far as it is: `Envmatte-Recovered` tells the share of its blocks. What the caller has already, by
    `If-None-Match`, is not computed again, but answered with 412.

    A video as the body, `Content-Type: video/*`, is answered with 202 and the job that composites its frames.
    """
    if clips.is_clip(request):
        return await clips.composite_clip(context, request, id, wanted.of_a_clip(), wanted.webhook)
    if wanted.webhook is not None:
        raise OptionError("webhook is for clips: a still is in the answer, and has no job", field="webhook")
    accept = request.headers.get("accept", "*/*")
    kind = preferred(accept, ANSWERS)
    if kind is None:
        raise NotAcceptable(f"composites are answered as {', '.join(ANSWERS)}, not as {accept}")
    seen = await anyio.to_thread.run_sync(_seen, context, id)
    async with spool_body(request, context.settings.backdrop_bytes) as body, context.composites:
        try:
            return await anyio.to_thread.run_sync(_answer, context, seen, body, kind, wanted, request.headers)
        except Corrupt:
            await anyio.to_thread.run_sync(_seen, context, id)  # it may have been deleted meanwhile
            raise


@dataclass(frozen=True)
class Seen:
    """What there is of a matte.

    Attributes
    ----------
    blocks : set of (int, int), optional
        Rows and columns of the blocks that were recovered; None if all were.
    share : float
        Of all blocks.
    """

    id: str
    blocks: frozenset[tuple[int, int]] | None = None
    share: float = 1.0


def _seen(context: Context, id: str) -> Seen:
    with reading(context.engine) as c:
        row = mattes.get(c, id)
        if row.state == "ready":
            return Seen(id)
        done = tile_records.done(c, row.job) if row.state == "recovering" else []
    if not done:
        raise Conflict(f"matte {id} is {row.state}, and nothing of it is there yet; job {row.job} says more")
    matte = context.cache.matte(id)
    tiles = cut(matte, parse_options(row.options).tile or matte.block)
    blocks = frozenset(block for tile in done for block in product(*tiles[tile]))
    return Seen(id, blocks, len(blocks) / (matte.block_rows * matte.block_columns))


def _answer(
    context: Context, seen: Seen, body: IO[bytes], kind: str, wanted: CompositeParams, headers: Headers
) -> Response:
    times: list[str] = []

    def timed(name: str, function: Callable[[], R]) -> R:
        start = time.perf_counter()
        result = function()
        times.append(f"{name};dur={(time.perf_counter() - start) * 1e3:.1f}")
        return result

    data = body.read()
    made_of = f"{seen.id} {sorted(seen.blocks or ())} {kind} {wanted.model_dump_json()} ".encode()
    tag = f'"{hashlib.blake2b(made_of + hashlib.blake2b(data).digest(), digest_size=16).hexdigest()}"'
    told = {"ETag": tag, "Envmatte-Recovered": f"{seen.share:.4f}"}
    if is_known(headers, tag):
        return problem_answer(
            problem_of(NotNeeded(f"the caller has this composite already: {tag}")), {"ETag": tag}
        )
    matte = timed("open", lambda: context.cache.matte(seen.id))
    window = Window.of(matte, wanted.x, wanted.y, wanted.width, wanted.height)
    pixels = timed("decode", lambda: context.decoders.decode(data, wanted.transfer))
    backdrop = backdrop_of(pixels, wanted.transfer)

    def read(row: int, number: int) -> Strip:
        return context.cache.strip(seen.id, row, number, seen.blocks)

    rays = timed("rays", lambda: _rays(context, seen, wanted)) if wanted.depth is not None else None
    picture = timed(
        "composite",
        lambda: composite(matte, backdrop, placement=wanted.placement, rays=rays, window=window, read=read),
    )
    if wanted.size is not None:
        picture = shrink(picture, wanted.size)
    answer = timed("encode", lambda: _encoded(picture, backdrop, kind, wanted))
    return answered(answer, kind, told | {"Server-Timing": ", ".join(times)})


def _rays(context: Context, seen: Seen, wanted: CompositeParams) -> Rays:
    """The rays to a backdrop at the depth that is wanted."""
    if seen.blocks is not None:
        raise Conflict(
            f"matte {seen.id} is still being recovered: a backdrop at another depth takes all of it"
        )
    assert wanted.depth is not None  # as `CompositeParams` has seen to, and the next ones
    assert wanted.distance is not None
    places = context.cache.places(seen.id, CORES)
    if wanted.camera is not None:
        wide, high = context.cache.matte(seen.id).attributes["monitor"]
        return from_one(places, high / wide, wanted.distance, wanted.camera, wanted.depth)
    assert wanted.other is not None
    assert wanted.other_distance is not None
    if _seen(context, wanted.other).blocks is not None:
        raise Conflict(f"matte {wanted.other} is still being recovered")
    others = context.cache.places(wanted.other, CORES)
    if others.shape != places.shape:
        raise OptionError(
            f"matte {wanted.other} has {others.shape[1]} x {others.shape[0]} pixels, {seen.id} {places.shape[1]} x "
            f"{places.shape[0]}: both must be of the same camera at the same place",
            field="other",
        )
    return from_two(places, others, (wanted.distance, wanted.other_distance), wanted.depth)


def _encoded(picture: NDArray[np.float32], backdrop: Backdrop, kind: str, wanted: CompositeParams) -> bytes:
    if kind == "image/x-exr":
        opaque = bool((picture[..., 3] == 1).all())
        return float_formats.encode_exr(
            {"RGB" if opaque else "RGBA": picture[..., :3] if opaque else picture}
        )
    deep = kind == "image/png" and backdrop.pixels.dtype != np.uint8
    codes = encode(picture, wanted.transfer, np.dtype(np.uint16 if deep else np.uint8), CORES)
    if kind == "image/png":
        return integer_formats.encode_png(codes)
    return integer_formats.encode_jpeg(codes[..., :3], wanted.quality)
