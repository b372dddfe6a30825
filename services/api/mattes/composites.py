"""Composites over HTTP: stills at once, clips as jobs."""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import IO, Annotated, TypeVar

import anyio.to_thread
import numpy as np
from fastapi import APIRouter, Query, Request, Response
from numpy.typing import NDArray
from starlette.datastructures import Headers

from services.api.context import Context, OwnerContext
from services.api.http.bodies import BodyLimit, spool_body
from services.api.http.errors import answer as answer_problem
from services.api.http.media_types import preferred
from services.api.http.responses import bytes_response, etag_matches
from services.api.jobs.jobs import Job
from services.api.mattes import clips
from services.api.mattes.composite_params import CompositeParams
from services.runtime.problems import NotAcceptable, NotNeeded, problem_of
from storage.database.engine import reading
from storage.errors import Conflict, OptionError
from storage.records import mattes
from storage.records import tiles as tile_records
from workflows.composite import composite
from workflows.composite.around import put_around
from workflows.composite.backdrop import Backdrop, backdrop_of
from workflows.composite.depth import Rays, from_one, from_two
from workflows.composite.engine import Window, shrink
from workflows.composite.quantise import encode
from workflows.composite.strips import Strip
from workflows.composite.threads import CORES
from workflows.images import float_formats, integer_formats
from workflows.mattes.options import parse_options
from workflows.mattes.tiles import cut

router = APIRouter(tags=["mattes"])
R = TypeVar("R")
BACKDROPS = (
    "image/png",
    "image/jpeg",
    "image/webp",
    "image/avif",
    "image/gif",
    "image/tiff",
    "image/heic",
    "image/heif",
    "image/x-exr",
    "image/x-adobe-dng",
)
ANSWER_BYTES = {"image/png": 16, "image/jpeg": 10, "image/x-exr": 16}
"""The media types of answers, and what a pixel takes at most in codes and in the encoded file together."""
ANSWERS = tuple(ANSWER_BYTES)
PICTURE_BYTES = 16
"""Of a pixel while it is composited: light and alpha."""
SHRUNK_BYTES = 32
"""Of a pixel while a picture is made smaller, and of the answer."""
LIGHT_BYTES = 16
"""Of a cell of the monitor: the light of three channels, with the coarser grids."""
AROUND_BYTES = 48
"""Of a pixel of the matte while the backdrop is put around the glass: its light, what it adds, and blurred alpha."""
RAYS_BYTES = 160
"""Of a pixel of the matte while rays to a backdrop at another depth are found."""


@router.post(
    "/mattes/{id}/composite",
    response_class=Response,
    responses={
        200: {
            "content": {
                media_type: {"schema": {"type": "string", "format": "binary"}} for media_type in ANSWERS
            },
            "description": "The composite",
        },
        202: {"description": "The job that composites a clip", "model": Job},
    },
    openapi_extra={
        "requestBody": {
            "content": {
                media_type: {"schema": {"type": "string", "format": "binary"}}
                for media_type in (*BACKDROPS, "video/*")
            }
        }
    },
)
async def post_composite(
    context: OwnerContext, id: str, request: Request, params: Annotated[CompositeParams, Query()]
) -> Response:
    """Put the glass in front of a backdrop: the body is an image, and the answer is one of the matte's size.

    A PNG has as many bits as the backdrop, 8 or 16, and 16 for a float backdrop. Pixels that were not recovered are
    transparent in a PNG and black in a JPEG. An EXR holds linear light, with values that may be negative or above 1.
    If the matte is still being recovered, the composite shows the blocks that are done, and `Envmatte-Recovered` is
    their share. A composite that the caller already has, by `If-None-Match`, is not computed again; the answer is 412.

    If the body is a video, `Content-Type: video/*`, the answer is 202 and the job that composites its frames.
    """
    if clips.is_clip(request):
        return await clips.composite_clip(context, request, id, params.clip_options(), params.webhook)
    if params.webhook is not None:
        raise OptionError("webhook is for clips: a still is in the answer and has no job", field="webhook")
    accept = request.headers.get("accept", "*/*")
    media_type = preferred(accept, ANSWERS)
    if media_type is None:
        raise NotAcceptable(f"composites are answered as {', '.join(ANSWERS)}, not as {accept}")
    state = await anyio.to_thread.run_sync(_matte_state, context, id)
    limit = context.settings.backdrop_bytes
    announced = BodyLimit(limit).check_announced(request) or limit
    turn = context.backdrops.take(context.caller.owner, context.settings.request_seconds, announced)
    async with turn, spool_body(request, limit) as body:

        def answer() -> Response:
            with context.stored(mattes.get, id):
                return _answer(context, state, body, media_type, params, request.headers)

        memory = await anyio.to_thread.run_sync(_bytes_of_composite, context, state, params, media_type)
        return await context.compute(request, context.composites, answer, memory=memory)


@dataclass(frozen=True)
class MatteState:
    """How much of a matte is recovered.

    Attributes
    ----------
    blocks : set of (int, int), optional
        Rows and columns of the recovered blocks; None if all are.
    share : float
        Of all blocks, from 0 to 1.
    """

    id: str
    blocks: frozenset[tuple[int, int]] | None = None
    share: float = 1.0


def _matte_state(context: Context, id: str) -> MatteState:
    with context.stored(mattes.get, id) as row:
        if row.state == "ready":
            return MatteState(id)
        with reading(context.engine) as c:
            done = tile_records.done(c, row.job) if row.state == "recovering" else []
        if not done:
            raise Conflict(f"matte {id} is {row.state}, and nothing of it is there yet; see job {row.job}")
        matte = context.cache.matte(id)
        tiles = cut(matte, parse_options(row.options).tile or matte.block)
        blocks = frozenset(block for tile in done for block in product(*tiles[tile]))
        return MatteState(id, blocks, len(blocks) / (matte.block_rows * matte.block_columns))


def _bytes_of_composite(context: Context, state: MatteState, params: CompositeParams, media_type: str) -> int:
    """Bytes that a composite takes at most, apart from the strips of the matte and from backdrops.

    The bound of these is ENVMATTE_BACKDROP_BYTES times the composites at once: if they counted at their most here,
    composites of one owner would wait for one another.
    """
    with context.stored(mattes.get, state.id):
        matte = context.cache.matte(state.id)
    window = Window.of(matte, params.x, params.y, params.width, params.height)
    of_pixel = PICTURE_BYTES + (SHRUNK_BYTES if params.size is not None else ANSWER_BYTES[media_type])
    of_rays = RAYS_BYTES * matte.width * matte.height if params.depth is not None else 0
    of_frame = AROUND_BYTES * matte.width * matte.height if params.around == "backdrop" else 0
    of_window = of_pixel * window.width * window.height
    return LIGHT_BYTES * matte.columns * matte.rows + of_window + of_rays + of_frame


def _answer(
    context: Context,
    state: MatteState,
    body: IO[bytes],
    media_type: str,
    params: CompositeParams,
    headers: Headers,
) -> Response:
    times: list[str] = []

    def timed(name: str, function: Callable[[], R]) -> R:
        start = time.perf_counter()
        result = function()
        times.append(f"{name};dur={(time.perf_counter() - start) * 1e3:.1f}")
        return result

    digest = hashlib.blake2b(body.read()).digest()
    inputs = f"{state.id} {sorted(state.blocks or ())} {media_type} {params.model_dump_json()} ".encode()
    tag = f'"{hashlib.blake2b(inputs + digest, digest_size=16).hexdigest()}"'
    extra = {"ETag": tag, "Envmatte-Recovered": f"{state.share:.4f}"}
    if etag_matches(headers, tag):
        return answer_problem(
            problem_of(NotNeeded(f"the caller already has this composite: {tag}")), {"ETag": tag}
        )
    matte = timed("open", lambda: context.cache.matte(state.id))
    window = Window.of(matte, params.x, params.y, params.width, params.height)
    body.seek(0)
    pixels = timed("decode", lambda: context.decoders.decode(body.read(), params.transfer))
    backdrop = backdrop_of(pixels, params.transfer)

    def read(row: int, number: int) -> Strip:
        return context.cache.strip(state.id, row, number, state.blocks)

    rays = timed("rays", lambda: _rays(context, state, params)) if params.depth is not None else None
    picture = timed(
        "composite",
        lambda: composite(matte, backdrop, placement=params.placement, rays=rays, window=window, read=read),
    )
    if params.around == "backdrop":
        wide, high = matte.attributes["monitor"]
        frame = matte.width, matte.height
        picture = timed(
            "around",
            lambda: put_around(picture, backdrop, window, frame, (wide, high), params.placement, CORES),
        )
    if params.size is not None:
        picture = shrink(picture, params.size)
    answer = timed("encode", lambda: _encoded(picture, backdrop, media_type, params))
    return bytes_response(answer, media_type, extra | {"Server-Timing": ", ".join(times)})


def _rays(context: Context, state: MatteState, params: CompositeParams) -> Rays:
    """The rays to a backdrop at another depth."""
    if state.blocks is not None:
        raise Conflict(
            f"matte {state.id} is still being recovered; a backdrop at another depth needs all of it"
        )
    assert params.depth is not None  # `CompositeParams` checks it, and the two below
    assert params.distance is not None
    places = context.cache.places(state.id, CORES)
    if params.camera is not None:
        wide, high = context.cache.matte(state.id).attributes["monitor"]
        return from_one(places, high / wide, params.distance, params.camera, params.depth)
    assert params.other is not None
    assert params.other_distance is not None
    with context.stored(mattes.get_ready, params.other):
        others = context.cache.places(params.other, CORES)
    if others.shape != places.shape:
        raise OptionError(
            f"matte {params.other} has {others.shape[1]} x {others.shape[0]} pixels, {state.id} {places.shape[1]} x "
            f"{places.shape[0]}: both must be from the same camera in the same place",
            field="other",
        )
    return from_two(places, others, (params.distance, params.other_distance), params.depth)


def _encoded(
    picture: NDArray[np.float32], backdrop: Backdrop, media_type: str, params: CompositeParams
) -> bytes:
    if media_type == "image/x-exr":
        opaque = bool((picture[..., 3] == 1).all())
        return float_formats.encode_exr("RGB" if opaque else "RGBA", picture)
    deep = media_type == "image/png" and backdrop.pixels.dtype != np.uint8
    codes = encode(picture, params.transfer, np.dtype(np.uint16 if deep else np.uint8), CORES)
    if media_type == "image/png":
        return integer_formats.encode_png(codes)
    return integer_formats.encode_jpeg(codes[..., :3], params.quality)
