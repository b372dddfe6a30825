"""Bodies of requests: streamed, and refused as soon as they are larger than they may be."""

import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

import anyio.to_thread
from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from services.api.http.media_types import JSON
from services.runtime.problems import TooLarge
from services.settings import Settings
from storage.disks import require_reserve
from storage.layout.uploads import Part, part_path
from storage.objects.store import Objects

SPOOLED = 1 << 20
"""Bytes of a body that are kept in memory; a larger one is written to a temporary file."""
ONLY_PART = "all"
Model = TypeVar("Model", bound=BaseModel)


class BodyLimit:
    """How many bytes a body may have, and how a larger one is refused.

    Parameters
    ----------
    limit : int
        In bytes.
    detail : str, optional
        What to say of a larger body.
    name : str, optional
        Setting that the limit comes from: the problem then has it, and the bytes that were too many.
    """

    def __init__(self, limit: int, detail: str | None = None, name: str | None = None) -> None:
        self._limit = limit
        self._detail = detail or f"the body of this request may have {limit} bytes; send a smaller one"
        self._name = name

    def check(self, size: int) -> None:
        """Check a number of bytes.

        Raises
        ------
        TooLarge
        """
        if size > self._limit:
            fields: dict[str, str | int] = {"name": self._name, "value": size} if self._name else {}
            raise TooLarge(self._detail, limit=self._limit, **fields)

    def check_announced(self, request: Request, start: int = 0) -> int:
        """Check the bytes that a request announces (Content-Length); returns them, 0 if it announces none.

        Parameters
        ----------
        start : int
            Bytes that came before this body and count as well.

        Raises
        ------
        TooLarge
        """
        length = int(request.headers.get("content-length", 0))
        self.check(start + length)
        return length

    async def stream(self, request: Request, start: int = 0) -> AsyncIterator[bytes]:
        """The parts of a body as they come.

        Parameters
        ----------
        start : int
            As of `check_announced`.

        Raises
        ------
        TooLarge
            In place of the part that goes over the limit.
        """
        size = start
        async for part in request.stream():
            size += len(part)
            self.check(size)
            yield part


def upload_limit(settings: Settings, what: str = "an archive") -> BodyLimit:
    """The limit ENVMATTE_UPLOAD_BYTES.

    Parameters
    ----------
    what : str
        What is sent, for the message.
    """
    limit = settings.upload_bytes
    return BodyLimit(
        limit,
        f"{what} may have {limit} bytes; send a smaller one or raise ENVMATTE_UPLOAD_BYTES",
        "upload_bytes",
    )


def has_body(request: Request) -> bool:
    """Whether a request has a body, by its headers."""
    return request.headers.get("content-length", "0") != "0" or "transfer-encoding" in request.headers


async def store_as_upload(pieces: AsyncIterator[bytes], objects: Objects, upload: str) -> Part:
    """Stream a body into the store as the only part of an upload."""
    return Part(ONLY_PART, await store_body(pieces, objects, part_path(upload, ONLY_PART)))


async def store_body(pieces: AsyncIterator[bytes], objects: Objects, path: str) -> int:
    """Stream a body into the store as one object; returns its bytes."""
    size = 0
    async with objects.write(path) as file:
        async for piece in pieces:
            size += len(piece)
            await file.write(piece)
    return size


@asynccontextmanager
async def spool_body(request: Request, limit: int) -> AsyncIterator[IO[bytes]]:
    """The body of a request as a file: in memory while it is small, so that many slow senders take little memory.

    Raises
    ------
    TooLarge
        As soon as more than ``limit`` bytes have come.
    NoRoom
        If the disk of temporary files is nearly full.
    """

    def write(part: bytes) -> None:
        require_reserve(Path(tempfile.gettempdir()))
        file.write(part)

    with tempfile.SpooledTemporaryFile(SPOOLED) as file:
        size = 0
        async for part in BodyLimit(limit).stream(request):
            size += len(part)
            if size > SPOOLED:
                await anyio.to_thread.run_sync(write, part)
            else:
                file.write(part)
        file.seek(0)
        yield file


async def read_json(request: Request, model: type[Model], limit: int) -> Model:
    """The JSON body of a request; unlike FastAPI, which reads any body whole, it stops at a limit.

    Raises
    ------
    TooLarge
        As soon as more than ``limit`` bytes have come.
    RequestValidationError
    """
    body = bytearray()
    async for part in BodyLimit(limit).stream(request):
        body += part
    try:
        return model.model_validate_json(bytes(body))
    except ValidationError as error:
        found = [detail | {"loc": ("body", *detail["loc"])} for detail in error.errors(include_url=False)]
        raise RequestValidationError(found) from error


def json_body(model: type[BaseModel]) -> dict[str, Any]:
    """The ``openapi_extra`` of a route that reads a JSON body itself."""
    return {"requestBody": {"content": {JSON: {"schema": schema_of(model)}}}}


def schema_of(model: type[BaseModel]) -> dict[str, Any]:
    """The JSON Schema of a model, with all of its ``$ref`` replaced by what they refer to.

    OpenAPI needs it for a body that a route reads itself: references there start at the document's root.
    """
    whole = model.model_json_schema()
    definitions = whole.pop("$defs", {})

    def resolve(node: Any) -> Any:
        if isinstance(node, list):
            return [resolve(one) for one in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            return resolve(definitions[node["$ref"].rpartition("/")[2]])
        return {name: resolve(one) for name, one in node.items() if name != "discriminator"}

    schema: dict[str, Any] = resolve(whole)
    return schema
