"""Mattes for graphics hardware over HTTP: the web app draws them while the user moves the backdrop."""

from contextlib import suppress

import anyio.to_thread
from fastapi import APIRouter, Request, Response

from services.api.context import OwnerContext
from services.api.http.responses import bytes_response, etag_matches
from storage.database.engine import reading
from storage.errors import Corrupt, NoRoom
from storage.layout import live as stored_live
from storage.records import mattes
from workflows.composite.live import encode
from workflows.composite.threads import CORES

router = APIRouter(tags=["mattes"])


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

    def require_ready() -> None:
        with reading(context.engine) as c:
            mattes.get_ready(c, id)

    def load() -> Response:
        encoded = stored_live.read(context.objects, id, encode.FORMAT)
        if encoded is None:
            try:
                encoded = encode.encode_live(context.cache.matte(id), CORES)
            except Corrupt:
                require_ready()  # it may have been deleted meanwhile
                raise
            # The answer needs no room, and it can be encoded again; or the matte was deleted just now.
            with suppress(NoRoom, FileNotFoundError):
                stored_live.write(context.objects, id, encode.FORMAT, encoded)
        return bytes_response(encoded, "application/octet-stream", tag | {"Content-Encoding": "gzip"})

    await anyio.to_thread.run_sync(require_ready)
    tag = {"ETag": f'"{id}-{encode.FORMAT}"'}  # a matte never changes once it is ready
    if etag_matches(request.headers, tag["ETag"]):
        return Response(status_code=304, headers=tag)
    return await context.compute(request, context.layers, load)
