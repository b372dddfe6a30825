"""Pictures and videos of pattern programs over HTTP, drawn for each request, and the page that plays a program."""

from collections.abc import AsyncIterator
from typing import IO, Annotated

import anyio.to_thread
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse

from services.api.context import OwnerContext
from services.api.http.responses import bytes_response, file_response
from services.api.http.router import Router, in_turn
from services.api.system.pages import HEADERS, WEB
from storage.database.engine import reading
from storage.errors import NotFound
from storage.records import programs
from workflows.interruption import checkpoint
from workflows.programs import video
from workflows.programs.files import pictures, png, zip_program
from workflows.programs.program import Program

router = Router(tags=["programs"])
page = APIRouter(tags=["programs"])


def _read(context: OwnerContext, id: str) -> Program:
    with reading(context.engine) as c:
        return Program.model_validate(programs.get(c, id).program)


Stored = Annotated[Program, Depends(in_turn(_read))]


@router.get(
    "/programs/{id}/patterns/{n}.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The pattern"}},
)
async def get_pattern(context: OwnerContext, program: Stored, n: int, request: Request) -> Response:
    """A pattern as the monitor shows it."""
    if not 0 <= n < program.count:
        raise NotFound(f"this program has the patterns 0 to {program.count - 1}", field="n")

    def draw() -> Response:
        return bytes_response(png(next(pictures(program, n, n + 1))), "image/png")

    return await context.compute(request, context.shares.pictures, draw)


@router.get(
    "/programs/{id}/patterns.zip",
    response_class=StreamingResponse,
    responses={200: {"content": {"application/zip": {}}, "description": "The archive"}},
)
async def get_patterns(context: OwnerContext, program: Stored) -> StreamingResponse:
    """`program.json` and a numbered PNG of each pattern, drawn while they are sent."""
    parts = zip_program(program)

    async def stream() -> AsyncIterator[bytes]:
        while True:
            async with context.shares.pictures.take(context.caller.owner, context.settings.request_seconds):
                part = await anyio.to_thread.run_sync(next, parts, b"")
            if not part:
                return
            yield part

    return StreamingResponse(stream(), media_type="application/zip")


@router.get(
    "/programs/{id}/patterns.mp4",
    response_class=StreamingResponse,
    responses={200: {"content": {"video/mp4": {}}, "description": "The video"}},
)
async def get_film(
    context: OwnerContext,
    program: Stored,
    request: Request,
    rate: Annotated[
        float,
        Query(ge=video.SLOWEST, le=video.FASTEST, allow_inf_nan=False, description="Patterns per second."),
    ] = 2.0,
) -> Response:
    """A video of the lead-in, the patterns in a border, and the lead-out. It is encoded before the answer begins."""

    def write(file: IO[bytes]) -> None:
        video.encode_video(program, file, rate, progress=lambda done, of: checkpoint())

    return await context.compute(request, context.shares.films, lambda: file_response(write, "video/mp4"))


@page.get(
    "/programs/{id}/play",
    response_class=FileResponse,
    responses={200: {"content": {"text/html": {}}, "description": "The page"}},
)
async def get_page(id: str) -> FileResponse:
    """The page that plays a program full screen. The page itself needs no key: it fetches the program, and asks the
    user for a key if that takes one."""
    return FileResponse(WEB / "play" / "play.html", media_type="text/html", headers=HEADERS)
