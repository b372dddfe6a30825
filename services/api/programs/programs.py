"""Pattern programs over HTTP: create, list, read and delete them."""

import time
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self

from fastapi import Depends, Request, Response
from pydantic import BaseModel, ConfigDict, Field, model_validator
from sqlalchemy import Row

from services.api.context import ListContext, OwnerContext
from services.api.http.bodies import json_body, read_json
from services.api.http.responses import json_response
from services.api.http.router import Router
from services.api.http.types import After, PageSize
from services.api.limits.quotas import NewData, admit
from storage.database.engine import reading, writing
from storage.database.rows import page
from storage.database.tables import programs as table
from storage.errors import OptionError
from storage.records import programs
from workflows.programs.border import MAX_NUMBERED, Border
from workflows.programs.files import fit_to_screen, program_json
from workflows.programs.parts import Monitor
from workflows.programs.preset_names import PRESETS
from workflows.programs.program import Program as PatternProgram

router = Router(tags=["programs"])
REQUEST_BYTES = 64 << 10
MAX_PIXELS = 1 << 24
"""Of a monitor. A picture in colour then takes 48 MiB, and a few times that while it is drawn."""
MAX_TOTAL_PIXELS = 1 << 31
"""Of all patterns of a program together. One core encodes about 30 million pixels per second."""


class Preset(BaseModel):
    """A program with a name, for a monitor of any size."""

    name: str
    description: str


class Presets(BaseModel):
    """All presets."""

    presets: list[Preset]


class Size(BaseModel):
    """A size in pixels."""

    model_config = ConfigDict(extra="forbid")
    width: int = Field(ge=1, le=16384)
    height: int = Field(ge=1, le=16384)


class ProgramRequest(BaseModel):
    """A preset or a program, and the screen that will show it."""

    model_config = ConfigDict(extra="forbid")
    preset: str | None = Field(None, description="GET /v1/presets lists them.")
    program: PatternProgram | None = Field(None, description="As in capture.json.")
    monitor: Size | None = Field(
        None, description="The screen's pixels. Default: 1280 x 960 for a preset, else the program's own."
    )
    border: bool = Field(
        False,
        description="Whether `monitor` includes the border that videos and the page draw around the patterns.",
    )

    @model_validator(mode="after")
    def _preset_or_program(self) -> "ProgramRequest":
        if (self.preset is None) == (self.program is None):
            raise ValueError("give either a preset or a program")
        return self


class PlaybackState(BaseModel):
    """How far the page that plays a program is."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    playback: str | None = Field(
        None,
        max_length=64,
        description="A name for this playback, for example a UUID: what arrives after its end is ignored.",
    )
    phase: Literal["countdown", "showing", "shown", "stopped"]
    patterns_per_second: float = Field(ge=0.01, le=120)
    seconds: float = Field(0, ge=0, le=3600, description="Until the first pattern.")
    shown: int = Field(0, ge=0, le=MAX_NUMBERED, description="Number of patterns that have been shown.")
    border: Size | None = Field(
        None,
        description="The display's pixels, once they are known: they complete the capture.json of a film.",
    )


class Showing(PlaybackState):
    """The last state that the page reported, and when; a page that was closed reports nothing more."""

    told_at: datetime
    age_seconds: float


class ListedProgram(BaseModel):
    """A program as lists have it. `display` is the screen that its video is made for; null if there is no room for a
    border."""

    id: str
    patterns: int
    monitor: Size
    display: Size | None
    created_at: datetime
    showing: Showing | None = Field(description="The last playback by its page.")

    @classmethod
    def of(cls, row: Row[Any], **more: Any) -> Self:
        program = PatternProgram.model_validate(row.program)
        return cls(
            id=row.id,
            patterns=program.count,
            monitor=Size(width=program.monitor.width, height=program.monitor.height),
            display=_display(program.monitor),
            created_at=datetime.fromtimestamp(row.created_at, UTC),
            showing=_showing(row.showing),
            **more,
        )


class Program(ListedProgram):
    """A program, with its parts as in capture.json."""

    program: dict[str, Any]

    @classmethod
    def of(cls, row: Row[Any], **more: Any) -> Self:
        return super().of(row, program=row.program, **more)


class Programs(BaseModel):
    """A page of programs, newest first."""

    programs: list[ListedProgram]


def _display(monitor: Monitor) -> Size | None:
    try:
        border = Border.around(monitor.width, monitor.height)
    except OptionError:
        return None
    return Size(width=border.width, height=border.height)


def _showing(state: dict[str, Any] | None) -> Showing | None:
    if state is None:
        return None
    age = max(time.time() - state["at"], 0.0)
    at = datetime.fromtimestamp(state["at"], UTC)
    return Showing.model_validate(
        {name: value for name, value in state.items() if name != "at"} | {"told_at": at, "age_seconds": age}
    )


async def _request(request: Request) -> ProgramRequest:
    return await read_json(request, ProgramRequest, REQUEST_BYTES)


@router.get("/presets")
def list_presets(context: OwnerContext) -> Presets:
    """All presets."""
    return Presets(presets=[Preset(name=name, description=text) for name, text in PRESETS.items()])


@router.post(
    "/programs",
    status_code=201,
    openapi_extra=json_body(ProgramRequest),
)
def post_program(
    context: OwnerContext, request: Annotated[ProgramRequest, Depends(_request)], response: Response
) -> Program:
    """Store a program. Its id is a hash of what it shows, so a repeated request creates nothing, with or without an
    Idempotency-Key."""
    screen = (request.monitor.width, request.monitor.height) if request.monitor else None
    program = fit_to_screen(request.program or request.preset or "", screen, bordered=request.border)
    _check_size(program)
    kept = program_json(program)
    with writing(context.engine) as c:
        if size := programs.added_bytes(c, kept):
            admit(c, context.settings, NewData(size=size))
        id = programs.add(c, kept)
        row = programs.get(c, id)
    response.headers["Location"] = f"/v1/programs/{id}"
    return Program.of(row)


@router.get("/programs", response_model=Programs)
async def list_programs(
    context: ListContext, request: Request, limit: PageSize = 100, after: After = None
) -> Response:
    """Programs, newest first, without their parts."""

    def make() -> Response:
        with reading(context.engine) as c:
            rows = page(c, table, limit, after)
            return json_response(Programs(programs=[ListedProgram.of(row) for row in rows]))

    return await context.compute(request, context.shares.lists, make)


@router.get("/programs/{id}")
def get_program(context: OwnerContext, id: str) -> Program:
    """A program."""
    with reading(context.engine) as c:
        return Program.of(programs.get(c, id))


@router.delete("/programs/{id}", status_code=204)
def delete_program(context: OwnerContext, id: str) -> None:
    """Delete a program. Captures made with it keep their own copy."""
    with writing(context.engine) as c:
        programs.get(c, id)
        programs.delete(c, id)


@router.get("/programs/{id}/program.json")
def get_record(context: OwnerContext, id: str) -> dict[str, Any]:
    """A program as in capture.json."""
    with reading(context.engine) as c:
        found: dict[str, Any] = programs.get(c, id).program
    return found


def _check_size(program: PatternProgram) -> None:
    pixels = program.monitor.width * program.monitor.height
    for value, what, limit in (
        (program.count, "patterns", MAX_NUMBERED),
        (pixels, "pixels of the monitor", MAX_PIXELS),
        (pixels * program.count, "pixels of all patterns together", MAX_TOTAL_PIXELS),
    ):
        if value > limit:
            raise OptionError(
                f"{value} {what}: the service draws up to {limit}; ask for fewer, or use `envmatte patterns`",
                limit=limit,
            )
