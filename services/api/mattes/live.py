"""Mattes for graphics hardware over HTTP: the web app draws them while the user moves the backdrop."""

from contextlib import suppress

import anyio.to_thread
from fastapi import APIRouter, Request, Response

from services.api.context import OwnerContext
from services.api.http.responses import bytes_response, etag_matches
from storage.errors import NoRoom
from storage.layout import live as stored_live
from storage.layout.mattes import Matte
from storage.records import mattes
from workflows.composite.live import encode
from workflows.composite.threads import CORES

router = APIRouter(tags=["mattes"])
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
    """The matte for a graphics card: a few look-ups per pixel in mip-mapped textures, with S, rho and alpha.

    It is computed for the first request and kept in the store.
    """

    def open_matte() -> Matte:
        with context.stored(mattes.get_ready, id):
            return context.cache.matte(id)

    def load() -> Response:
        encoded = stored_live.read(context.objects, id, encode.FORMAT)
        if encoded is None:
            with context.stored(mattes.get_ready, id):
                encoded = encode.encode_live(matte, CORES)
            # The answer needs no room, and it can be encoded again; or the matte was deleted just now.
            with suppress(NoRoom, FileNotFoundError):
                stored_live.write(context.objects, id, encode.FORMAT, encoded)
        return bytes_response(encoded, "application/octet-stream", tag | {"Content-Encoding": "gzip"})

    matte = await anyio.to_thread.run_sync(open_matte)
    tag = {"ETag": f'"{id}-{encode.FORMAT}"'}  # a matte never changes once it is ready
    if etag_matches(request.headers, tag["ETag"]):
        return Response(status_code=304, headers=tag)
    memory = encode.bytes_of_live(matte) + CORES * BLOCK_BYTES
    return await context.compute(request, context.layers, load, memory=memory)
