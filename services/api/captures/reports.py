"""Reports on captures over HTTP: how the frames turned out."""

from fastapi import APIRouter, Response

from services.api.context import Context, OwnerContext
from services.api.http.responses import bytes_response
from storage.database.engine import reading
from storage.errors import Conflict
from storage.layout.captures import Stack
from storage.records import captures
from workflows.ingest.report.contact_sheet import contact_sheet
from workflows.ingest.report.report import Report, report

router = APIRouter(tags=["captures"])


@router.get("/captures/{id}/report")
def get_report(context: OwnerContext, id: str) -> Report:
    """The quality of a capture, and how to improve it."""
    stack = _stack(context, id)
    return report(stack.attributes, stack.frames)


@router.get("/captures/{id}/contact-sheet.png", response_class=Response)
def get_contact_sheet(context: OwnerContext, id: str) -> Response:
    """Some of a capture's frames in one picture: red where they are clipped at white, blue where clipped at black."""
    return bytes_response(contact_sheet(_stack(context, id)), "image/png")


def _stack(context: Context, id: str) -> Stack:
    with reading(context.engine) as c:
        row = captures.get(c, id)
    if row.state != "ready":
        raise Conflict(f"capture {id} is {row.state}; its report is there once it is ready")
    return Stack(context.objects, id)
