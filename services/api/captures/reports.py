"""Reports on captures over HTTP: how the frames turned out."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fastapi import Request, Response

from services.api.context import Context, OwnerContext
from services.api.http.responses import bytes_response, json_response
from services.api.http.router import Router
from storage.errors import Conflict
from storage.layout.captures import Stack
from storage.records import captures
from workflows.ingest.report.contact_sheet import bytes_of_contact_sheet, contact_sheet, thumbnail
from workflows.ingest.report.report import Report, report

router = Router(tags=["captures"])


@router.get("/captures/{id}/report", response_model=Report)
async def get_report(context: OwnerContext, id: str, request: Request) -> Response:
    """The quality of a capture, and how to improve it."""

    def make() -> Response:
        with _stack(context, id) as stack:
            return json_response(report(stack.attributes, stack.frames))

    return await context.compute(request, context.shares.lists, make)


@router.get(
    "/captures/{id}/contact-sheet.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The picture"}},
)
async def get_contact_sheet(context: OwnerContext, id: str, request: Request) -> Response:
    """Some of a capture's frames in one picture: red where they are clipped at white, blue where clipped at black."""
    return await _drawn(context, id, request, contact_sheet)


@router.get(
    "/captures/{id}/thumbnail.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}, "description": "The picture"}},
)
async def get_thumbnail(context: OwnerContext, id: str, request: Request) -> Response:
    """The brightest constant frame of a capture, at most 240 pixels wide and high."""
    return await _drawn(context, id, request, thumbnail)


async def _drawn(context: Context, id: str, request: Request, draw: Callable[[Stack], bytes]) -> Response:
    def measure() -> int:
        with _stack(context, id) as stack:
            return bytes_of_contact_sheet(stack)

    def answer() -> Response:
        with _stack(context, id) as stack:
            return bytes_response(draw(stack), "image/png")

    memory = await context.compute(request, context.shares.lists, measure)
    return await context.compute(request, context.shares.pictures, answer, memory=memory)


@contextmanager
def _stack(context: Context, id: str) -> Iterator[Stack]:
    with context.stored(captures.get, id) as row:
        if row.state != "ready":
            raise Conflict(f"capture {id} is {row.state}; its report is there once it is ready")
        yield Stack(context.objects, id)
