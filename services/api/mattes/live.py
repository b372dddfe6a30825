"""Mattes for graphics hardware over HTTP, which the web app draws while a hand moves the backdrop."""

from contextlib import suppress

import anyio.to_thread
from fastapi import APIRouter, Request, Response

from services.api.context import OwnerContext
from services.api.http.responses import answered, is_known
from storage.database.engine import reading
from storage.errors import Corrupt, NoRoom
from storage.layout import live as kept
from storage.records import mattes
from workflows.composite.live import encode
from workflows.composite.threads import CORES

router = APIRouter(tags=["mattes"])


@router.get(
    "/mattes/{id}/live",
    response_class=Response,
    responses={
        200: {"content": {"application/octet-stream": {}}, "description": "The matte, as gzip encodes it"}
    },
)
async def get_live(context: OwnerContext, id: str, request: Request) -> Response:
    """The matte as a few look-ups a pixel in mip-mapped textures, with S, rho and alpha: what a graphics card draws the
    glass with before any backdrop. It is made when it is first asked for, and kept."""

    def is_ready() -> None:
        with reading(context.engine) as c:
            mattes.get_ready(c, id)

    def find() -> Response:
        made = kept.read(context.objects, id, encode.FORMAT)
        if made is None:
            try:
                made = encode.encode_live(context.cache.matte(id), CORES)
            except Corrupt:
                is_ready()  # it may have been deleted meanwhile
                raise
            with suppress(NoRoom):  # it is there for this caller, and can be made again
                kept.write(context.objects, id, encode.FORMAT, made)
        return answered(made, "application/octet-stream", tag | {"Content-Encoding": "gzip"})

    await anyio.to_thread.run_sync(is_ready)
    tag = {"ETag": f'"{id}-{encode.FORMAT}"'}  # a matte never changes once it is ready
    if is_known(request.headers, tag["ETag"]):
        return Response(status_code=304, headers=tag)
    return await anyio.to_thread.run_sync(find, limiter=context.layers)
