"""Composites over HTTP: stills at once, clips as jobs."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import IO, Annotated, Literal

import numpy as np
from fastapi import Query, Request, Response
from numpy.typing import NDArray
from starlette.datastructures import Headers

from services.api.context import Context, OwnerContext
from services.api.http.bodies import BodyLimit, spool_body
from services.api.http.errors import answer as answer_problem
from services.api.http.idempotency import IdempotencyKey
from services.api.http.media_types import preferred
from services.api.http.responses import MEMORY_BYTES, VERSION, bytes_response, etag_matches, file_response
from services.api.http.router import Router
from services.api.http.server_timing import ServerTiming
from services.api.jobs.jobs import Job
from services.api.mattes import clips
from services.api.mattes.backdrops import decode_backdrop, refuse_form
from services.api.mattes.composite_params import CompositeParams
from services.api.mattes.progress import Progress, progress_of, while_there
from services.runtime.problems import NotAcceptable, NotNeeded, problem_of
from storage.errors import Conflict, OptionError
from storage.layout.mattes import Matte
from storage.records import mattes
from workflows.composite import composite, light_on
from workflows.composite.backdrops.around import expose, put_around
from workflows.composite.backdrops.backdrop import Backdrop
from workflows.composite.backdrops.placement import Placement
from workflows.composite.depth import Rays, from_one, from_two
from workflows.composite.engine import Window, compose, double, shrink
from workflows.composite.interval import contrast_on, half_widths
from workflows.composite.preview import enlarge, put_behind, window_of_preview
from workflows.composite.quantise import encode
from workflows.composite.strips import Strip
from workflows.images import float_formats, integer_formats
from workflows.images.integer_formats import Codes
from workflows.recovery.interval import Interval
from workflows.threads import CORES

router = Router(tags=["mattes"])
Picture = NDArray[np.float32]
"""(height, width, 4): light and alpha."""
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
DOUBLED_BYTES = 96
"""Of a pixel while a picture is made twice as wide and high: twice as wide, and then the whole."""
ENLARGED_BYTES = 50
"""Of a pixel while a preview is enlarged: the light and alpha of its neighbours, and their mean."""
LIGHT_BYTES = 16
"""Of a cell of the monitor: the light of three channels, with the coarser grids."""
AROUND_BYTES = 48
"""Of a pixel of the matte while the backdrop is put around the glass: its light, what it adds, and blurred alpha."""
RAYS_BYTES = 160
"""Of a pixel of the matte while rays to a backdrop at another depth are found."""
INTERVAL_BYTES = 128
"""Of a pixel while its interval is worked out, and of a cell while its contrast is."""


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
    context: OwnerContext,
    id: str,
    request: Request,
    params: Annotated[CompositeParams, Query()],
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Put the glass in front of a backdrop: the body is an image, and the answer is one of the matte's size.

    A PNG has as many bits as the backdrop, 8 or 16, and 16 for a float backdrop. Pixels that were not recovered are
    transparent in a PNG and black in a JPEG. An EXR holds linear light, with values that may be negative or above 1,
    multiplied with alpha.
    If the matte is still being recovered, the composite shows the blocks that are done, elsewhere the preview if there
    is one, and `Envmatte-Recovered` is the share of the blocks. A composite that the caller already has, by
    `If-None-Match`, is not computed again; the answer is 412.

    With `interval`, the answer is how far the true light may be from the composite, for recoveries by a quality.

    If the body is a video, `Content-Type: video/*`, the answer is 202 and the job that composites its frames.
    """
    if clips.is_clip(request):
        options = params.clip_options()
        return await clips.composite_clip(context, request, id, options, params.webhook, idempotency_key)
    if params.webhook is not None:
        raise OptionError("webhook is for clips: a still is in the answer and has no job", field="webhook")
    refuse_form(request)
    accept = request.headers.get("accept", "*/*")
    media_type = preferred(accept, ANSWERS)
    if media_type is None:
        raise NotAcceptable(f"composites are answered as {', '.join(ANSWERS)}, not as {accept}")
    progress = await context.call(progress_of, context, id)
    limit = context.settings.backdrop_bytes
    announced = BodyLimit(limit).check_announced(request) or limit
    turn = context.backdrops.take(context.caller.owner, context.settings.request_seconds, announced)
    async with turn, spool_body(request, limit) as body:

        def answer() -> Response:
            return while_there(
                context,
                progress,
                lambda now: _answer(context, now, body, media_type, params, request.headers),
            )

        memory = await context.call(_bytes_of_composite, context, progress, params, media_type)
        return await context.compute(request, context.composites, answer, memory=memory)


def _bytes_of_composite(
    context: Context, progress: Progress, params: CompositeParams, media_type: str
) -> int:
    """Bytes that a composite takes at most, apart from the strips of the matte and from backdrops.

    The bound of these is ENVMATTE_BACKDROP_BYTES times the composites at once: if they counted at their most here,
    composites of one owner would wait for one another.
    """
    with context.stored(mattes.get, progress.id):
        matte = context.cache.matte(progress.id)
    window = Window.of(matte, params.x, params.y, params.width, params.height)
    bands = _bands(window, matte.block, params, media_type, progress.preview is not None)
    of_band = window.width * max(band.height for band in bands)
    of_band *= INTERVAL_BYTES if params.interval else PICTURE_BYTES
    of_cell = INTERVAL_BYTES if params.interval else LIGHT_BYTES
    of_pixel = SHRUNK_BYTES if params.size is not None else params.enlarge**2 * ANSWER_BYTES[media_type]
    if params.enlarge > 1:
        of_pixel += DOUBLED_BYTES
    of_rays = RAYS_BYTES * matte.width * matte.height if params.depth is not None else 0
    of_frame = AROUND_BYTES * matte.width * matte.height if params.around == "backdrop" else 0
    if progress.preview is not None:
        of_pixel += ENLARGED_BYTES
    of_window = of_pixel * window.width * window.height
    return of_cell * matte.columns * matte.rows + of_band + of_window + of_rays + of_frame


def _answer(
    context: Context,
    progress: Progress,
    body: IO[bytes],
    media_type: str,
    params: CompositeParams,
    headers: Headers,
) -> Response:
    times = ServerTiming()
    body.seek(0)
    inputs = (
        f"{VERSION} {progress.id} {sorted(progress.blocks or ())} {media_type} {params.model_dump_json()} "
    )
    digest = hashlib.blake2b(inputs.encode(), digest_size=16)
    for piece in iter(partial(body.read, MEMORY_BYTES), b""):
        digest.update(piece)
    tag = f'"{digest.hexdigest()}"'
    extra = {"ETag": tag} | progress.headers
    if etag_matches(headers, tag):
        return answer_problem(
            problem_of(NotNeeded(f"the caller already has this composite: {tag}")), {"ETag": tag}
        )
    backdrop = times.take("decode", lambda: decode_backdrop(context.decoders, body, params.transfer))
    is_deep = media_type == "image/png" and backdrop.pixels.dtype != np.uint8
    matte = times.take("open", lambda: context.cache.matte(progress.id))
    window = Window.of(matte, params.x, params.y, params.width, params.height)
    bands = _bands(window, matte.block, params, media_type, progress.preview is not None)
    pictures = _pictures(context, progress, matte, backdrop, params, bands, times)
    del backdrop  # which may be as large as the answer, and which `pictures` forgets as soon as it can
    if media_type == "image/x-exr":
        (picture,) = pictures
        answer = times.take("encode", lambda: bytes_response(_exr(picture), media_type, extra))
    else:
        rows = window.height if len(bands) > 1 else None
        codes = _codes(pictures, rows, is_deep, params, media_type, times)
        answer = times.take("encode", lambda: _packed(codes, media_type, params.quality, extra))
    answer.headers["Server-Timing"] = times.header
    return answer


def _codes(
    pictures: Iterator[Picture],
    rows: int | None,
    is_deep: bool,
    params: CompositeParams,
    media_type: str,
    times: ServerTiming,
) -> Codes:
    """The integers of an answer: of one picture, or of several bands with so many rows together.

    The pictures that they are made of are four times as large.
    """
    dtype: np.dtype[np.unsignedinteger] = np.dtype(np.uint16 if is_deep else np.uint8)
    channels: Literal[3, 4] = 4 if media_type == "image/png" else 3
    codes, done = np.empty(0, dtype), 0
    for picture in pictures:
        band = times.take("codes", partial(encode, picture, params.transfer, dtype, CORES, channels))
        if not done:
            codes = np.empty((rows or len(band), *band.shape[1:]), dtype)
        codes[done : done + len(band)] = band
        done += len(band)
    return codes if (codes[..., 3:] < np.iinfo(dtype).max).any() else codes[..., :3]


def _bands(
    window: Window, block: int, params: CompositeParams, media_type: str, has_preview: bool
) -> list[Window]:
    """The parts of a window that are composited one after the other, so that few pixels take memory at once.

    It is one part if pixels depend on others, and for an EXR, which holds what was composited.
    """
    is_one = (
        media_type == "image/x-exr"
        or has_preview
        or params.depth is not None
        or params.around == "backdrop"
        or params.size is not None
        or params.enlarge > 1
    )
    return [window] if is_one else window.bands(block)


def _pictures(
    context: Context,
    progress: Progress,
    matte: Matte,
    backdrop: Backdrop,
    params: CompositeParams,
    bands: Sequence[Window],
    times: ServerTiming,
) -> Iterator[Picture]:
    """Light and alpha of an answer, by bands from top to bottom."""
    where = params.placement_behind(matte)
    draw = _drawing(context, progress, matte, backdrop, where, params, times)
    steps: dict[str, Callable[[Picture, Window], Picture]] = {}
    if progress.preview is not None:
        steps["preview"] = partial(_put_preview, context, progress, progress.preview, backdrop, where)
    if params.fits_frame:
        steps["expose"] = lambda picture, _: expose(matte, picture)
    if params.around == "backdrop":
        steps["around"] = partial(put_around, matte, backdrop, where)
    if params.size is not None:
        size = params.size
        steps["shrink"] = lambda picture, _: shrink(picture, size)
    if params.enlarge == 2:
        steps["double"] = lambda picture, _: double(picture)
    del backdrop  # which may take as much memory as the answer, and which only some steps need
    for band in bands:
        picture = times.take("composite", partial(draw, band))
        for name, step in steps.items():
            picture = times.take(name, partial(step, picture, band))
        yield picture


def _drawing(
    context: Context,
    progress: Progress,
    matte: Matte,
    backdrop: Backdrop,
    where: Placement | None,
    params: CompositeParams,
    times: ServerTiming,
) -> Callable[[Window], Picture]:
    """What draws a window before a backdrop, or how far the light of its pixels may be from that."""

    def read(row: int, number: int) -> Strip:
        return context.cache.strip(progress.id, row, number, progress.blocks)

    rays = times.take("rays", partial(_rays, context, progress, params)) if params.depth is not None else None
    light = times.take("light", partial(light_on, matte, backdrop, where, CORES))
    if not params.interval:
        return lambda band: compose(matte, light, band, read, CORES, rays)
    interval = _interval(progress, matte)
    contrast = times.take("contrast", partial(contrast_on, matte, light, backdrop, where, CORES))
    return lambda band: half_widths(matte, interval, light, contrast, band, read, CORES)


def _put_preview(
    context: Context,
    progress: Progress,
    spacing: int,
    backdrop: Backdrop,
    where: Placement | None,
    picture: Picture,
    window: Window,
) -> Picture:
    """Show the preview in a picture of a window where blocks of the matte are not done."""
    assert progress.blocks is not None  # else there is no preview
    name = progress.whole_frame
    preview = context.cache.matte(name)
    size = preview.width, preview.height
    part = window_of_preview(window, spacing, *size)
    read = partial(context.cache.strip, name)
    small = composite(preview, backdrop, placement=where, window=part, read=read)
    block = context.cache.matte(progress.id).block
    put_behind(picture, enlarge(small, part, window, spacing, *size), window, progress.blocks, block)
    return picture


def _interval(progress: Progress, matte: Matte) -> Interval:
    """The interval of composites of a matte."""
    if progress.blocks is not None:
        raise Conflict(
            f"matte {progress.id} is still being recovered; its intervals are there when it is done"
        )
    if "interval" not in matte.attributes:
        raise Conflict(
            f"how far composites of matte {progress.id} are from the truth is not known: it was recovered with other "
            "options than a quality, from a capture of an earlier version, from too few pixels with contrast, or from "
            "patterns on fixed grids, which do not tell where in a block the light comes from"
        )
    return Interval(**matte.attributes["interval"])


def _rays(context: Context, progress: Progress, params: CompositeParams) -> Rays:
    """The rays to a backdrop at another depth."""
    if progress.blocks is not None:
        raise Conflict(
            f"matte {progress.id} is still being recovered; a backdrop at another depth needs all of it"
        )
    assert params.depth is not None  # `CompositeParams` checks it, and the two below
    assert params.distance is not None
    places = context.cache.places(progress.id, CORES)
    if params.camera is not None:
        wide, high = context.cache.matte(progress.id).attributes["monitor"]
        return from_one(places, high / wide, params.distance, params.camera, params.depth)
    assert params.other is not None
    assert params.other_distance is not None
    with context.stored(mattes.get_ready, params.other):
        others = context.cache.places(params.other, CORES)
    if others.shape != places.shape:
        raise OptionError(
            f"matte {params.other} has {others.shape[1]} x {others.shape[0]} pixels, {progress.id} {places.shape[1]} x "
            f"{places.shape[0]}: both must be from the same camera in the same place",
            field="other",
        )
    return from_two(places, others, (params.distance, params.other_distance), params.depth)


def _exr(picture: Picture) -> bytes:
    """Encode a picture, whose light is multiplied in place with alpha, as readers of EXR expect it."""
    picture[..., :3] *= picture[..., 3:]
    opaque = bool((picture[..., 3] == 1).all())
    return float_formats.encode_exr("RGB" if opaque else "RGBA", picture)


def _packed(codes: Codes, media_type: str, quality: int, headers: dict[str, str]) -> Response:
    if media_type == "image/png" and codes.nbytes > MEMORY_BYTES:
        return file_response(partial(integer_formats.pack_png, pixels=codes), media_type, headers)
    if media_type == "image/png":
        return bytes_response(integer_formats.encode_png(codes), media_type, headers)
    return bytes_response(integer_formats.encode_jpeg(codes[..., :3], quality), media_type, headers)
