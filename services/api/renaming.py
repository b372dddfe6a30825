"""Renaming what has a name for people: captures and mattes."""

from collections.abc import Callable
from typing import Any, Protocol

from fastapi import Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Connection, Row

from services.api.context import Context
from services.api.http.bodies import json_body, read_json
from storage.database.engine import reading, writing
from workflows.untrusted.validation import Name

CHANGE_BYTES = 1 << 12


class Change(BaseModel):
    """What to change."""

    model_config = ConfigDict(extra="forbid", str_strip_whitespace=True)
    name: Name = Field(min_length=1, description="A name for people.")


CHANGE = json_body(Change)
"""For the ``openapi_extra`` of a route."""


class Records(Protocol):
    """A module of `storage.records` with rows that have a name."""

    def get(self, connection: Connection, id: str, /) -> Row[Any]:
        """A row; `NotFound` if there is none."""

    def change(self, connection: Connection, id: str, /, *, name: str) -> None:
        """Change a row."""


async def rename(
    context: Context,
    request: Request,
    id: str,
    records: Records,
    respond: Callable[[Connection, str], Response],
) -> Response:
    """Rename something, and answer as ``respond`` does with its id then.

    Raises
    ------
    NotFound
        If it does not exist, which is looked up before the body is read.
    """

    def require() -> None:
        with reading(context.engine) as c:
            records.get(c, id)

    def make() -> Response:
        with writing(context.engine) as c:
            records.get(c, id)  # it may have been deleted meanwhile
            records.change(c, id, name=change.name)
            return respond(c, id)

    await context.call(require)
    change = await read_json(request, Change, CHANGE_BYTES)
    return await context.compute(request, context.shares.lists, make)
