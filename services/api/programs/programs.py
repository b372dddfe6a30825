"""Programs over HTTP: a record each, and pictures and videos that are made of it when they are asked for."""

import os
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import ExitStack
from datetime import UTC, datetime
from typing import IO, Annotated, Any, Literal

import anyio.to_thread
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, model_validator
from sqlalchemy import Row

from services.api.context import OwnerContext
from services.api.http.bodies import read_json, schema_of
from services.api.http.responses import FromFile, answered
from services.api.http.types import After, Limit
from services.api.quotas import admit
from services.api.system.pages import HEADERS, WEB
from storage.database.engine import reading, writing
from storage.database.rows import page as page_of
from storage.database.tables import programs as table
from storage.errors import NotFound, OptionError
from storage.records import programs
from workflows.programs import video
from workflows.programs.border import MAX_PATTERNS, Border
from workflows.programs.files import archive, fitted, pictures, png, record
from workflows.programs.parts import Monitor
from workflows.programs.preset_names import PRESETS
from workflows.programs.program import Program as Shown

router = APIRouter(tags=["programs"])
page = APIRouter(tags=["programs"])
REQUEST_BYTES = 64 << 10
MOST_PIXELS = 1 << 24
"""Of a monitor: one picture in colour takes 48 MiB, a few times that while it is made."""
MOST_WORK = 1 << 31
"""Pixels of all patterns of a program: a core encodes some 30 million of them a second."""


class Preset(BaseModel):
    """A program by name, for a monitor of any size."""

    name: str
    description: str


class Presets(BaseModel):
    """Every preset."""

    presets: list[Preset]


class Size(BaseModel):
    """In pixels."""

    model_config = ConfigDict(extra="forbid")
    width: int = Field(ge=1, le=16384)
    height: int = Field(ge=1, le=16384)


class ProgramRequest(BaseModel):
    """A preset or a program, and the screen to show it on."""

    model_config = ConfigDict(extra="forbid")
    preset: str | None = Field(None, description="GET /v1/presets lists them.")
    program: Shown | None = Field(None, description="As in capture.json.")
    monitor: Size | None = Field(
        None, description="The screen's pixels; left out, 1280 x 960 for a preset and the program's own."
    )
    border: bool = Field(
        False, description="Whether `monitor` is to have room for the border that videos and the page draw."
    )

    @model_validator(mode="after")
    def _one_of_them(self) -> "ProgramRequest":
        if (self.preset is None) == (self.program is None):
            raise ValueError("give either a preset or a program")
        return self


class Told(BaseModel):
    """How far the page is that shows a program."""

    model_config = ConfigDict(extra="forbid")
    phase: Literal["countdown", "showing", "shown", "stopped"]
    patterns_per_second: float = Field(ge=0.01, le=120)
    seconds: float = Field(0, ge=0, le=3600, description="Until the first pattern comes.")
    shown: int = Field(0, ge=0, le=MAX_PATTERNS, description="Patterns that have been shown.")
    border: Size | None = Field(
        None,
        description="The display's pixels, once they are known: with it, the film's capture.json is complete.",
    )


class Showing(Told):
    """The same, and when the page told it: pages that are closed or lost tell nothing more."""

    told_at: datetime
    age_seconds: float


class Program(BaseModel):
    """A program; `display` is the screen that its video is made for, if it can have a border."""

    id: str
    patterns: int
    monitor: Size
    display: Size | None
    program: dict[str, Any]
    created_at: datetime
    showing: Showing | None = Field(description="The last time that its page showed it.")

    @classmethod
    def of(cls, row: Row[Any]) -> "Program":
        shown = Shown.model_validate(row.program)
        return cls(
            id=row.id,
            patterns=shown.count,
            monitor=Size(width=shown.monitor.width, height=shown.monitor.height),
            display=_display(shown.monitor),
            program=row.program,
            created_at=datetime.fromtimestamp(row.created_at, UTC),
            showing=_showing(row.showing),
        )


class Programs(BaseModel):
    """A page of programs, newest first."""

    programs: list[Program]


def _display(monitor: Monitor) -> Size | None:
    try:
        border = Border.around(monitor.width, monitor.height)
    except OptionError:
        return None
    return Size(width=border.width, height=border.height)


def _showing(told: dict[str, Any] | None) -> Showing | None:
    if told is None:
        return None
    age = max(time.time() - told["at"], 0.0)
    at = datetime.fromtimestamp(told["at"], UTC)
    return Showing(**{name: told[name] for name in Told.model_fields}, told_at=at, age_seconds=age)


async def _request(request: Request) -> ProgramRequest:
    return await read_json(request, ProgramRequest, REQUEST_BYTES)


@router.get("/presets")
def list_presets() -> Presets:
    """Every preset."""
    return Presets(presets=[Preset(name=name, description=text) for name, text in PRESETS.items()])


@router.post(
    "/programs",
    status_code=201,
    openapi_extra={"requestBody": {"content": {"application/json": {"schema": schema_of(ProgramRequest)}}}},
)
def post_program(
    context: OwnerContext, request: Annotated[ProgramRequest, Depends(_request)], response: Response
) -> Program:
    """Keep a program. Its id follows from what it shows: a repeat makes nothing, with an Idempotency-Key or without."""
    screen = (request.monitor.width, request.monitor.height) if request.monitor else None
    shown = fitted(request.program or request.preset or "", screen, bordered=request.border)
    _see_that_it_is_small(shown)
    kept = record(shown)
    with writing(context.engine) as c:
        if size := programs.added_bytes(c, kept):
            admit(c, context.settings, size=size)
        id = programs.add(c, kept)
        row = programs.get(c, id)
    response.headers["Location"] = f"/v1/programs/{id}"
    return Program.of(row)


@router.get("/programs")
def list_programs(context: OwnerContext, limit: Limit = 100, after: After = None) -> Programs:
    """Programs, newest first."""
    with reading(context.engine) as c:
        return Programs(programs=[Program.of(row) for row in page_of(c, table, limit, after)])


@router.get("/programs/{id}")
def get_program(context: OwnerContext, id: str) -> Program:
    """A program."""
    with reading(context.engine) as c:
        return Program.of(programs.get(c, id))


@router.delete("/programs/{id}", status_code=204)
def delete_program(context: OwnerContext, id: str) -> None:
    """Delete a program; captures of it keep their own."""
    with writing(context.engine) as c:
        programs.get(c, id)
        programs.delete(c, id)


def _shown(context: OwnerContext, id: str) -> Shown:
    with reading(context.engine) as c:
        return Shown.model_validate(programs.get(c, id).program)


Asked = Annotated[Shown, Depends(_shown)]


@router.get("/programs/{id}/program.json")
def get_record(context: OwnerContext, id: str) -> dict[str, Any]:
    """A program as capture.json has it."""
    with reading(context.engine) as c:
        found: dict[str, Any] = programs.get(c, id).program
    return found


@router.get("/programs/{id}/patterns/{n}.png", response_class=Response)
async def get_pattern(context: OwnerContext, shown: Asked, n: int) -> Response:
    """What the monitor shows for a pattern."""
    if not 0 <= n < shown.count:
        raise NotFound(f"this program has the patterns 0 to {shown.count - 1}", field="n")

    def draw() -> Response:
        return answered(png(next(pictures(shown, n, n + 1))), "image/png")

    return await anyio.to_thread.run_sync(draw, limiter=context.pictures)


@router.get("/programs/{id}/patterns.zip", response_class=StreamingResponse)
async def get_patterns(context: OwnerContext, shown: Asked) -> StreamingResponse:
    """`program.json` and a numbered PNG of each pattern, drawn while they are sent."""
    parts = archive(shown)

    async def stream() -> AsyncIterator[bytes]:
        while part := await anyio.to_thread.run_sync(next, parts, b"", limiter=context.pictures):
            yield part

    return StreamingResponse(stream(), media_type="application/zip")


@router.get("/programs/{id}/patterns.mp4", response_class=StreamingResponse)
async def get_film(
    context: OwnerContext,
    shown: Asked,
    rate: Annotated[float, Query(ge=video.SLOWEST, le=video.FASTEST, description="Patterns a second.")] = 2.0,
) -> StreamingResponse:
    """A video of the lead-in, the patterns in a border, and the lead-out; encoded whole before the answer begins."""

    def encode() -> tuple[IO[bytes], int]:
        with ExitStack() as stack:
            file = stack.enter_context(
                tempfile.TemporaryFile()
            )  # of no name: it is gone with whoever holds it
            video.encode(shown, file, rate)
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            stack.pop_all()  # now it is the answer's to close
        return file, size

    file, size = await anyio.to_thread.run_sync(encode, limiter=context.films)
    return FromFile(file, size, "video/mp4")


@page.get("/programs/{id}/play", response_class=FileResponse)
def get_page(id: str) -> FileResponse:
    """A page that shows the program full screen. It holds nothing of it, and knows of none: it fetches what it shows,
    and asks for a key where that takes one."""
    return FileResponse(WEB / "play" / "play.html", media_type="text/html", headers=HEADERS)


def _see_that_it_is_small(shown: Shown) -> None:
    pixels = shown.monitor.width * shown.monitor.height
    for much, what, limit in (
        (shown.count, "patterns", MAX_PATTERNS),
        (pixels, "pixels of the monitor", MOST_PIXELS),
        (pixels * shown.count, "pixels of all patterns together", MOST_WORK),
    ):
        if much > limit:
            raise OptionError(
                f"{much} {what}: the service makes pictures of up to {limit}; ask for fewer, or make them with "
                "`envmatte patterns`",
                limit=limit,
            )
