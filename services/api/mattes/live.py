"""Mattes for graphics hardware over HTTP: for the web app, and as a page that draws the glass without a service."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from fastapi import Request, Response
from sqlalchemy import Row

from services.api.context import Context, OwnerContext
from services.api.http.responses import bytes_response, etag_matches
from services.api.http.router import Router
from services.api.mattes.live_page import make_page
from services.api.mattes.mattes import save_as, title_of
from services.api.mattes.progress import Progress, open_whole_frame, while_there
from storage.errors import NoRoom
from storage.layout import live as stored_live
from storage.layout.mattes import Matte
from storage.records import mattes
from workflows.composite.live import encode
from workflows.threads import CORES

router = Router(tags=["mattes"])
BLOCK_BYTES = 16 << 20
"""What a thread takes for the block that it encodes."""


@router.get(
    "/mattes/{id}/live",
    response_class=Response,
    responses={
        200: {"content": {"application/octet-stream": {}}, "description": "The matte, compressed by gzip"}
    },
)
async def get_live(context: OwnerContext, id: str, request: Request) -> Response:
    """The matte for a graphics card: a few lookups per pixel in mip-mapped textures, with S, rho and alpha.

    It is computed for the first request and kept in the store. If the matte is still being recovered, it is that of its
    preview, and `Envmatte-Recovered` is the share of the matte that is recovered.
    """

    def load(now: Progress) -> Response:
        if now.blocks is None:
            encoded = _encoded(context, id, context.cache.matte(id))
        else:
            encoded = encode.encode_live(
                context.cache.matte(now.whole_frame), CORES, whole=context.cache.matte(id)
            )
        headers = _headers(now) | {"Content-Encoding": "gzip"}
        return bytes_response(encoded, "application/octet-stream", headers)

    progress, matte = await context.call(open_whole_frame, context, id)
    headers = _headers(progress)
    if etag_matches(request.headers, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    work = partial(while_there, context, progress, load)
    return await context.compute(request, context.shares.layers, work, memory=_bytes_of(matte))


@router.get(
    "/mattes/{id}/live.html",
    response_class=Response,
    responses={200: {"content": {"text/html": {}}, "description": "The page"}},
)
async def get_live_page(context: OwnerContext, id: str, request: Request) -> Response:
    """The matte as a web page in one file: it draws the glass by itself, from a disk or any web server, offline too.

    The page loads nothing, and another page can show it in an `iframe`. Anyone with the file has the matte as
    `GET /v1/mattes/{id}/live` sends it.
    """

    # Saved and not shown: here it would be a page of the service.
    return await live_page(context, id, request, lambda title: save_as(id, title, ".html"))


async def live_page(
    context: Context, id: str, request: Request, headers: Callable[[str], dict[str, str]]
) -> Response:
    """The answer with the page of a matte; its headers may depend on the matte's title."""

    def load() -> Response:
        title = title_of(context, row)
        page = make_page(title, row.figures["monitor"], _encoded(context, id, matte))
        return bytes_response(page, "text/html", headers(title))

    row, matte = await context.call(_open, context, id)
    return await context.compute(request, context.shares.layers, load, memory=_bytes_of(matte))


def _headers(progress: Progress) -> dict[str, str]:
    # Neither a matte that is ready nor a preview ever changes.
    return progress.headers | {"ETag": f'"{progress.whole_frame}-{encode.FORMAT}"'}


def _open(context: Context, id: str) -> tuple[Row[Any], Matte]:
    """A matte that is ready, and its row."""
    with context.stored(mattes.get_ready, id) as row:
        return row, context.cache.matte(id)


def _bytes_of(matte: Matte) -> int:
    """Bytes that encoding a matte takes at most."""
    return encode.bytes_of_live(matte) + CORES * BLOCK_BYTES


def _encoded(context: Context, id: str, matte: Matte) -> bytes:
    """A matte as `workflows.composite.live.encode` encodes it."""
    encoded = stored_live.read(context.objects, id, encode.FORMAT)
    if encoded is None:
        with context.stored(mattes.get, id):
            encoded = encode.encode_live(matte, CORES)
        # The answer needs no room, and it can be encoded again; or the matte was deleted just now.
        with suppress(NoRoom, FileNotFoundError):
            stored_live.write(context.objects, id, encode.FORMAT, encoded)
    return encoded
