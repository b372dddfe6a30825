"""Reports on captures over HTTP."""

from fastapi import APIRouter, Response

from services.api.context import Context, OwnerContext
from services.api.http.responses import answered
from storage.database.engine import reading
from storage.errors import Conflict
from storage.layout.captures import Stack
from storage.records import captures
from workflows.ingest.report.contact_sheet import contact_sheet
from workflows.ingest.report.report import Report, report

router = APIRouter(tags=["captures"])


@router.get("/captures/{id}/report")
def get_report(context: OwnerContext, id: str) -> Report:
    """How a capture turned out, and what to do better."""
    stack = _stack(context, id)
    return report(stack.attributes, stack.frames)


@router.get("/captures/{id}/contact-sheet.png", response_class=Response)
def get_contact_sheet(context: OwnerContext, id: str) -> Response:
    """Some of a capture's frames: what is clipped at white is red, at black blue."""
    return answered(contact_sheet(_stack(context, id)), "image/png")


def _stack(context: Context, id: str) -> Stack:
    with reading(context.engine) as c:
        row = captures.get(c, id)
    if row.state != "ready":
        raise Conflict(f"capture {id} is {row.state}; it can be looked at once it is ready")
    return Stack(context.objects, id)
