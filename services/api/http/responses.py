"""Responses from temporary files, entity tags and times."""

import os
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import IO

from fastapi import Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel
from starlette.datastructures import Headers
from starlette.types import Receive, Scope, Send

from storage.disks import require_reserve

MEMORY_BYTES = 1 << 18
"""The largest answer kept in memory while it is sent, and the size of the pieces read from a file."""
VERSION = version("envmatte")
"""Of this package: part of the entity tags of what its code computes, which an upgrade may change."""


def bytes_response(data: bytes, media_type: str, headers: dict[str, str] | None = None) -> Response:
    """A response from bytes. Large ones go through a temporary file, so that many slow clients take little memory.

    It may write to a disk, so don't call it in the event loop.
    """
    if len(data) <= MEMORY_BYTES:
        return Response(data, headers=headers, media_type=media_type)
    return file_response(lambda file: file.write(data), media_type, headers)


def file_response(
    write: Callable[[IO[bytes]], object], media_type: str, headers: dict[str, str] | None = None
) -> Response:
    """A response that a function writes to a temporary file. Don't call it in the event loop.

    Raises
    ------
    NoRoom
        If the disk of temporary files has no more than its reserve.
    """
    require_reserve(Path(tempfile.gettempdir()))
    with ExitStack() as stack:
        file = stack.enter_context(tempfile.TemporaryFile())
        write(file)
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        stack.pop_all()  # the response closes it
    return FileStreamResponse(file, size, media_type, headers)


def json_response(model: BaseModel) -> Response:
    """A response with a model as JSON, made where it is called: for large ones, outside of the event loop."""
    return bytes_response(model.model_dump_json().encode(), "application/json")


class FileStreamResponse(StreamingResponse):
    """A response that streams a file and closes it, also when the connection breaks.

    Attributes
    ----------
    size : int
        Bytes of the file.
    release : callable
        Is called once it is closed.
    """

    release: Callable[[], None] | None = None

    def __init__(
        self, file: IO[bytes], size: int, media_type: str, headers: dict[str, str] | None = None
    ) -> None:
        length = {"Content-Length": str(size)}
        super().__init__(
            iter(partial(file.read, MEMORY_BYTES), b""),
            headers=(headers or {}) | length,
            media_type=media_type,
        )
        self._file, self.size = file, size

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()
            if self.release is not None:
                self.release()


def utc_time(seconds: float | None) -> datetime | None:
    """A time in the database as a time in an answer."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def etag_matches(headers: Headers, tag: str) -> bool:
    """Whether the caller already has the answer with an entity tag (If-None-Match, RFC 9110, sect. 13.1.2).

    Tags are compared weakly, because a proxy that packs answers makes them weak; ``*`` is any answer.
    """
    known = [text.strip().removeprefix("W/") for text in headers.get("if-none-match", "").split(",")]
    return tag.removeprefix("W/") in known or known == ["*"]
