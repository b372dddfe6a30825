"""How far the page is that shows a program: it tells it here, and a phone or a camera follows."""

import hashlib
from typing import Annotated

import anyio.to_thread
from fastapi import APIRouter, Depends, Header, Request, Response
from fastapi.responses import StreamingResponse

from services.api.context import OwnerContext
from services.api.http.bodies import read_json, schema_of
from services.api.jobs.events import stream
from services.api.programs.programs import Program, Told, get_program
from storage.database.engine import writing
from storage.records import programs

router = APIRouter(tags=["programs"])
TOLD_BYTES = 4 << 10


async def _told(request: Request) -> Told:
    return await read_json(request, Told, TOLD_BYTES)


@router.put(
    "/programs/{id}/showing",
    status_code=204,
    dependencies=[Depends(get_program)],  # one that is unknown is told before what is wrong with the body
    openapi_extra={"requestBody": {"content": {"application/json": {"schema": schema_of(Told)}}}},
)
def put_showing(context: OwnerContext, id: str, told: Annotated[Told, Depends(_told)]) -> None:
    """Tell how far the showing of a program is: its page does, for whoever follows it elsewhere."""
    with writing(context.engine) as c:
        programs.set_showing(c, id, told.model_dump(mode="json"))


@router.get("/programs/{id}/events", response_class=StreamingResponse)
async def follow_program(
    context: OwnerContext, id: str, last_event_id: Annotated[str | None, Header(max_length=256)] = None
) -> Response:
    """The program, now and each time that its page has told how far it is, as server-sent events."""

    def read() -> Program:
        context.check_key()
        return get_program(context, id)

    return stream(read, await anyio.to_thread.run_sync(read), _mark, last_event_id)


def _mark(program: Program) -> str:
    told = program.model_dump_json(include={"showing"}, exclude={"showing": {"age_seconds"}})
    return hashlib.blake2b(told.encode(), digest_size=8).hexdigest()
