"""Responses that do not stay in memory, and what headers and times look like."""

import tempfile
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from typing import IO

from fastapi import Response
from fastapi.responses import StreamingResponse
from starlette.datastructures import Headers
from starlette.types import Receive, Scope, Send

HELD = 1 << 18
"""Bytes of an answer that are kept in memory while it is taken, and that are read of a file at once."""


def answered(data: bytes, media_type: str, headers: dict[str, str] | None = None) -> Response:
    """An answer, a large one from a temporary file: any number may be taken slowly. Not for the loop's thread."""
    if len(data) <= HELD:
        return Response(data, headers=headers, media_type=media_type)
    with ExitStack() as stack:
        file = stack.enter_context(tempfile.TemporaryFile())
        file.write(data)
        file.seek(0)
        stack.pop_all()  # now it is the answer's to close
    return FromFile(file, len(data), media_type, headers)


class FromFile(StreamingResponse):
    """The bytes of a file, which is closed whatever becomes of the connection."""

    def __init__(
        self, file: IO[bytes], size: int, media_type: str, headers: dict[str, str] | None = None
    ) -> None:
        length = {"Content-Length": str(size)}
        super().__init__(
            iter(partial(file.read, HELD), b""), headers=(headers or {}) | length, media_type=media_type
        )
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()


def time_of(seconds: float | None) -> datetime | None:
    """A time of the database as answers have it."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def is_known(headers: Headers, tag: str) -> bool:
    """Whether the caller has what a tag stands for (If-None-Match, RFC 9110, sect. 13.1.2)."""
    return tag in [one.strip() for one in headers.get("if-none-match", "").split(",")]
