"""Mattes over HTTP: list, read and delete them."""

import re
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

from fastapi import Request, Response
from pydantic import BaseModel, Field
from sqlalchemy import Connection, Row

from services.api.context import Context, ListContext, OwnerContext
from services.api.http.responses import json_response, utc_time
from services.api.http.router import Router
from services.api.http.types import After, Named, PageSize, Pair
from services.api.renaming import CHANGE, rename
from storage.database.engine import reading, writing
from storage.database.rows import page
from storage.database.tables import mattes as table
from storage.errors import Conflict, NotFound
from storage.layout import mattes as stored_mattes
from storage.records import captures, jobs, mattes

router = Router(tags=["mattes"])


class Matte(BaseModel):
    """A matte; an imported one has no capture and no job."""

    id: str
    name: str
    state: mattes.State
    capture: str | None
    job: str | None
    options: dict[str, Any]
    width: int | None = None
    height: int | None = None
    monitor: Pair | None = None
    columns: int | None = None
    rows: int | None = None
    cut_out: bool | None = Field(
        None,
        description="Whether the object was cut out of what the frame sees, so that `fit` and `plate` know where the "
        "monitor is in it.",
    )
    preview: int | None = Field(
        None,
        description="While it is recovered: composites show every so many-th row and column of what is not done yet, "
        "and `live` and `layers` have these only. Null if there is no preview.",
    )
    created_at: datetime
    expires_at: datetime | None

    @classmethod
    def of(cls, row: Row[Any]) -> "Matte":
        figures = {name: value for name, value in (row.figures or {}).items() if name in cls.model_fields}
        if row.state != "recovering":
            figures.pop("preview", None)
        return cls(
            **{name: getattr(row, name) for name in ("id", "name", "state", "capture", "job", "options")},
            **figures,
            created_at=datetime.fromtimestamp(row.created_at, UTC),
            expires_at=utc_time(row.expires_at),
        )

    @classmethod
    def read(cls, connection: Connection, id: str) -> "Matte":
        """A matte by its id; `NotFound` if there is none."""
        return cls.of(mattes.get(connection, id))


class Mattes(BaseModel):
    """A page of mattes, newest first."""

    mattes: list[Matte]


@router.get("/mattes", response_model=Mattes)
async def list_mattes(
    context: ListContext,
    request: Request,
    limit: PageSize = 100,
    after: After = None,
    state: mattes.State | None = None,
    capture: str | None = None,
    name: Named = None,
) -> Response:
    """Mattes, newest first: all, or those of a capture."""

    def make() -> Response:
        with reading(context.engine) as c:
            rows = page(c, table, limit, after, name=name, state=state, capture=capture)
            return json_response(Mattes(mattes=[Matte.of(row) for row in rows]))

    return await context.compute(request, context.shares.lists, make)


@router.get("/mattes/{id}")
def get_matte(context: OwnerContext, id: str) -> Matte:
    """A matte."""
    with reading(context.engine) as c:
        return Matte.read(c, id)


@router.patch("/mattes/{id}", response_model=Matte, openapi_extra=CHANGE)
async def change_matte(context: OwnerContext, id: str, request: Request) -> Response:
    """Rename a matte."""
    return await rename(context, request, id, mattes, lambda c, id: json_response(Matte.read(c, id)))


@router.delete("/mattes/{id}", status_code=204)
def delete_matte(context: OwnerContext, id: str) -> None:
    """Delete a matte."""
    with writing(context.engine) as c:
        mattes.get(c, id)
        if busy := jobs.active_job(c, matte=id):
            raise Conflict(f"job {busy} is using matte {id}; cancel it first, or wait for it")
        mattes.delete(c, id)
    context.cache.forget(id)
    context.objects.delete(stored_mattes.path(id))


def title_of(context: Context, row: Row[Any]) -> str:
    """What people call a matte: its name, or that of its capture as long as that exists."""
    if row.name:
        return str(row.name)
    with suppress(NotFound), reading(context.engine) as c:
        if name := captures.get(c, row.capture or "").name:
            return str(name)
    return f"Matte {row.id[:8]}"


def save_as(id: str, title: str, ending: str) -> dict[str, str]:
    """The header by which a browser saves a file under a matte's title, and a program that reads ASCII under its id."""
    name = quote(re.sub(r"[^\w.-]+", "_", title) + ending)
    return {"Content-Disposition": f"attachment; filename=\"matte-{id}{ending}\"; filename*=UTF-8''{name}"}
