"""What every request handler needs: the settings, the database and the store."""

import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Annotated, Any, TypeVar

import anyio.to_thread
from anyio import CapacityLimiter
from fastapi import Depends, Query, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from sqlalchemy import Engine
from starlette.datastructures import Headers

from services.api.errors import TooLarge
from services.settings import Settings
from storage.objects import Objects
from workflows.composite.cache import Cache
from workflows.composite.threads import CORES

SPOOLED = 1 << 20
"""Bytes of a body that are kept in memory while it comes."""
WEB = Path(__file__).parents[1] / "web"
"""The browser's files."""
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class Context:
    """Built once with the app."""

    settings: Settings
    engine: Engine
    objects: Objects
    cache: Cache
    """Blocks of mattes."""
    pictures: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(4))
    """Pictures of programs that are drawn at once, which bounds what they take."""
    films: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    """Videos of programs that are encoded at once."""
    composites: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(CORES + 1))
    """Composites that are made at once, which bounds what they take: one more than there are cores."""
    imports: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    """Archives of mattes that are unpacked at once."""
    layers: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))
    """Layers of mattes that are encoded at once."""


def _context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


Needs = Annotated[Context, Depends(_context)]
Limit = Annotated[int, Query(ge=1, le=1000, description="The most items to list.")]
After = Annotated[str | None, Query(description="The id of the last item of the page before.")]


async def read_body(request: Request, limit: int) -> bytes:
    """The body of a request, read whole.

    Raises
    ------
    TooLarge
        As soon as more than ``limit`` bytes have come.
    """
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > limit:
            raise _too_large(limit)
    return bytes(body)


@asynccontextmanager
async def spool_body(request: Request, limit: int) -> AsyncIterator[IO[bytes]]:
    """The body of a request in a temporary file, in memory while it is small: any number may come in slowly.

    Raises
    ------
    TooLarge
        As soon as more than ``limit`` bytes have come.
    """
    with tempfile.SpooledTemporaryFile(SPOOLED) as file:
        size = 0
        async for part in request.stream():
            size += len(part)
            if size > limit:
                raise _too_large(limit)
            if size > SPOOLED:
                await anyio.to_thread.run_sync(file.write, part)
            else:
                file.write(part)
        file.seek(0)
        yield file


def is_known(headers: Headers, tag: str) -> bool:
    """Whether the caller has what a tag stands for (If-None-Match, RFC 9110, sect. 13.1.2)."""
    return tag in [one.strip() for one in headers.get("if-none-match", "").split(",")]


def _too_large(limit: int) -> TooLarge:
    return TooLarge(f"the body of this request may have {limit} bytes; send a smaller one", limit=limit)


async def read_json(request: Request, model: type[Model], limit: int) -> Model:
    """The JSON of a request, not read whole before its size is known, as a framework would."""
    try:
        return model.model_validate_json(await read_body(request, limit))
    except ValidationError as error:
        found = [detail | {"loc": ("body", *detail["loc"])} for detail in error.errors(include_url=False)]
        raise RequestValidationError(found) from error


PROBLEM: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "A problem (RFC 9457)",
        "content": {
            "application/problem+json": {
                "schema": {
                    "type": "object",
                    "required": ["type", "title", "status", "detail"],
                    "properties": {
                        "type": {"type": "string", "format": "uri"},
                        "title": {"type": "string"},
                        "status": {"type": "integer"},
                        "detail": {"type": "string"},
                        "entry": {"type": "string"},
                        "field": {"type": "string"},
                        "limit": {"type": "number"},
                    },
                }
            }
        },
    }
}
