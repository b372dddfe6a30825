"""Composites over HTTP: stills at once, clips as jobs."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import IO, Annotated, Literal

import numpy as np
from fastapi import Query, Request, Response
from starlette.datastructures import Headers

from services.api.context import Context, OwnerContext
from services.api.http.bodies import BodyLimit, spool_body
from services.api.http.errors import problem_response
from services.api.http.idempotency import IdempotencyKey
from services.api.http.media_types import preferred
from services.api.http.responses import MEMORY_BYTES, VERSION, bytes_response, etag_matches, file_response
from services.api.http.router import Router
from services.api.http.server_timing import ServerTiming
from services.api.jobs.job import Job
from services.api.mattes.composites import clips
from services.api.mattes.composites.backdrops import decode_backdrop, refuse_form
from services.api.mattes.composites.drawing import Drawing, Picture
from services.api.mattes.composites.params import CompositeParams
from services.api.mattes.progress import Progress, progress_of, while_there
from services.runtime.problems import NotAcceptable, NotNeeded, problem_of
from storage.errors import OptionError
from storage.records import mattes
from workflows.composite.quantise import encode
from workflows.images import float_formats, integer_formats
from workflows.images.integer_formats import Codes
from workflows.threads import CORES

router = Router(tags=["mattes"])
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
PNG, EXR = "image/png", "image/x-exr"
ANSWER_BYTES = {PNG: 16, "image/jpeg": 10, EXR: 16}
"""The media types of answers, and what a pixel takes at most in codes and in the encoded file together."""
ANSWERS = tuple(ANSWER_BYTES)


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
    turn = context.shares.backdrops.take(context.caller.owner, context.settings.request_seconds, announced)
    async with turn, spool_body(request, limit) as body:
        asked = CompositeRequest(context, params, media_type)

        def answer() -> Response:
            return while_there(context, progress, lambda now: asked.answer(now, body, request.headers))

        memory = await context.call(asked.most_bytes, progress)
        return await context.compute(request, context.shares.composites, answer, memory=memory)


@dataclass(frozen=True)
class CompositeRequest:
    """What a request asks for: a composite before a picture, as a file of some media type."""

    context: Context
    params: CompositeParams
    media_type: str

    def drawing(self, progress: Progress) -> Drawing:
        """The composite of what is there of a matte. An EXR holds all of it at once."""
        return Drawing(self.context, progress, self.params, self.media_type == EXR)

    def most_bytes(self, progress: Progress) -> int:
        """Bytes that the answer takes at most, see `Drawing.most_bytes`."""
        with self.context.stored(mattes.get, progress.id):
            return self.drawing(progress).most_bytes(ANSWER_BYTES[self.media_type])

    def answer(self, progress: Progress, body: IO[bytes], headers: Headers) -> Response:
        """The composite before the picture in ``body``, or that the caller has it already."""
        times = ServerTiming()
        tag = self._tag(progress, body)
        if etag_matches(headers, tag):
            return problem_response(
                problem_of(NotNeeded(f"the caller already has this composite: {tag}")), {"ETag": tag}
            )
        backdrop = times.take(
            "decode", lambda: decode_backdrop(self.context.decoders, body, self.params.transfer)
        )
        is_deep = self.media_type == PNG and backdrop.pixels.dtype != np.uint8
        dtype: np.dtype[np.unsignedinteger] = np.dtype(np.uint16 if is_deep else np.uint8)
        drawing = times.take("open", lambda: self.drawing(progress))
        pictures = drawing.before(backdrop, times)
        del backdrop  # which may be as large as the answer, and which `pictures` forgets as soon as it can
        extra = {"ETag": tag} | progress.headers
        if self.media_type == EXR:
            (picture,) = pictures
            answer = times.take("encode", lambda: bytes_response(_exr(picture), EXR, extra))
        else:
            rows = drawing.window.height if len(drawing.bands) > 1 else None
            codes = self._codes(pictures, rows, dtype, times)
            answer = times.take("encode", lambda: self._packed(codes, extra))
        answer.headers["Server-Timing"] = times.header
        return answer

    def _tag(self, progress: Progress, body: IO[bytes]) -> str:
        """The ETag of the answer: a digest of all that it depends on."""
        given = self.params.model_dump_json()
        inputs = f"{VERSION} {progress.id} {sorted(progress.blocks or ())} {self.media_type} {given} "
        digest = hashlib.blake2b(inputs.encode(), digest_size=16)
        body.seek(0)
        for piece in iter(partial(body.read, MEMORY_BYTES), b""):
            digest.update(piece)
        return f'"{digest.hexdigest()}"'

    def _codes(
        self,
        pictures: Iterator[Picture],
        rows: int | None,
        dtype: np.dtype[np.unsignedinteger],
        times: ServerTiming,
    ) -> Codes:
        """The integers of an answer: of one picture, or of several bands with so many rows together.

        The pictures that they are made of are four times as large.
        """
        channels: Literal[3, 4] = 4 if self.media_type == PNG else 3
        codes, done = np.empty(0, dtype), 0
        for picture in pictures:
            band = times.take("codes", partial(encode, picture, self.params.transfer, dtype, CORES, channels))
            if not done:
                codes = np.empty((rows or len(band), *band.shape[1:]), dtype)
            codes[done : done + len(band)] = band
            done += len(band)
        return codes if (codes[..., 3:] < np.iinfo(dtype).max).any() else codes[..., :3]

    def _packed(self, codes: Codes, headers: dict[str, str]) -> Response:
        if self.media_type == PNG and codes.nbytes > MEMORY_BYTES:
            return file_response(partial(integer_formats.save_png, pixels=codes), PNG, headers)
        if self.media_type == PNG:
            return bytes_response(integer_formats.encode_png(codes), PNG, headers)
        jpeg = integer_formats.encode_jpeg(codes[..., :3], self.params.quality)
        return bytes_response(jpeg, self.media_type, headers)


def _exr(picture: Picture) -> bytes:
    """Encode a picture, whose light is multiplied in place with alpha, as readers of EXR expect it."""
    picture[..., :3] *= picture[..., 3:]
    opaque = bool((picture[..., 3] == 1).all())
    return float_formats.encode_exr("RGB" if opaque else "RGBA", picture)
