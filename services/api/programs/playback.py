"""Playback of a program over HTTP: its page reports how far it is, and a phone or a camera follows."""

import hashlib
from functools import partial
from typing import Annotated

from fastapi import Depends, Header, Request, Response
from fastapi.responses import StreamingResponse

from services.api.context import OwnerContext
from services.api.http.bodies import json_body, read_json
from services.api.http.router import Router, in_turn
from services.api.jobs.events import MEDIA_TYPE, stream
from services.api.programs.programs import PlaybackState, Program, get_program
from storage.database.engine import writing
from storage.records import programs

router = Router(tags=["programs"])
REQUEST_BYTES = 4 << 10


async def _state(request: Request) -> PlaybackState:
    return await read_json(request, PlaybackState, REQUEST_BYTES)


@router.put(
    "/programs/{id}/showing",
    status_code=204,
    dependencies=[Depends(in_turn(get_program))],  # an unknown program is reported before a bad body
    openapi_extra=json_body(PlaybackState),
)
def put_showing(context: OwnerContext, id: str, state: Annotated[PlaybackState, Depends(_state)]) -> None:
    """Report how far the playback of a program is: its page does so, for clients that follow it."""
    with writing(context.engine) as c:
        programs.set_showing(c, id, state.model_dump(mode="json"))


@router.get(
    "/programs/{id}/events",
    response_class=StreamingResponse,
    responses={200: {"content": {MEDIA_TYPE: {}}, "description": "An event each time that the page reports"}},
)
async def follow_program(
    context: OwnerContext, id: str, last_event_id: Annotated[str | None, Header(max_length=256)] = None
) -> Response:
    """The program, now and each time that its page reports how far it is, as server-sent events."""

    now = partial(get_program, context, id)

    async def read() -> Program:
        return await context.follow(("program", id), now)

    return stream(read, await context.call(now), _event_id, last_event_id)


def _event_id(program: Program) -> str:
    showing = program.model_dump_json(include={"showing"}, exclude={"showing": {"age_seconds"}})
    return hashlib.blake2b(showing.encode(), digest_size=8).hexdigest()
