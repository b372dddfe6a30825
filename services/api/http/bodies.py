"""Bodies of requests: no larger than they may be, whether they say how large they are or not."""

import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import IO, Any, TypeVar

import anyio.to_thread
from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from services.runtime.problems import TooLarge
from storage.objects.store import Objects

SPOOLED = 1 << 20
"""Bytes of a body that are kept in memory while it comes."""
Model = TypeVar("Model", bound=BaseModel)


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


async def read_json(request: Request, model: type[Model], limit: int) -> Model:
    """The JSON of a request, not read whole before its size is known, as a framework would."""
    try:
        return model.model_validate_json(await read_body(request, limit))
    except ValidationError as error:
        found = [detail | {"loc": ("body", *detail["loc"])} for detail in error.errors(include_url=False)]
        raise RequestValidationError(found) from error


def schema_of(model: type[BaseModel]) -> dict[str, Any]:
    """The JSON schema of a body that a handler reads itself, with nothing in it that refers to another place of it."""
    whole = model.model_json_schema()
    parts = whole.pop("$defs", {})

    def filled(node: Any) -> Any:
        if isinstance(node, list):
            return [filled(one) for one in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            return filled(parts[node["$ref"].rpartition("/")[2]])
        return {name: filled(one) for name, one in node.items() if name != "discriminator"}

    schema: dict[str, Any] = filled(whole)
    return schema


def announced(request: Request, limit: int, what: str = "an archive") -> int:
    """The bytes that a body is said to have, 0 if that is not said.

    Parameters
    ----------
    limit : int
        That it may have, by ENVMATTE_UPLOAD_BYTES.
    what : str
        What it is, for people.

    Raises
    ------
    TooLarge
    """
    length = int(request.headers.get("content-length", 0))
    if length > limit:
        raise too_large(limit, length, what)
    return length


async def store_body(
    request: Request, objects: Objects, path: str, limit: int, what: str = "an archive"
) -> int:
    """Stream a body into the store as one object; returns its bytes.

    Parameters
    ----------
    limit, what
        As of `announced`.

    Raises
    ------
    TooLarge
        As soon as more than ``limit`` bytes have come.
    """
    size = 0
    async with objects.write(path) as file:
        async for part in request.stream():
            size += len(part)
            if size > limit:
                raise too_large(limit, size, what)
            await file.write(part)
    return size


def too_large(limit: int, size: int, what: str = "an archive") -> TooLarge:
    """What is sent is over the limit of the settings, of so many bytes or more."""
    return TooLarge(
        f"{what} may have {limit} bytes; send a smaller one or raise ENVMATTE_UPLOAD_BYTES",
        name="upload_bytes",
        limit=limit,
        value=size,
    )


def _too_large(limit: int) -> TooLarge:
    return TooLarge(f"the body of this request may have {limit} bytes; send a smaller one", limit=limit)
