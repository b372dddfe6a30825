"""Resumable uploads, by tus 1.0."""

import base64
import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.client._errors import Busy, FileChanged, NotFound, ServiceError, Unreachable
from services.client._paths import state_of

if TYPE_CHECKING:
    import httpx2

    from services.client._session import Session

TUS = {"Tus-Resumable": "1.0.0"}
LARGEST, SMALLEST = 8 << 20, 64 << 10
"""Bytes of a request: halved after a fault, doubled after a success."""
TEMPORARY = (408, 409, 423, 429, 460, 500, 502, 503, 504)
"""Statuses after which an upload is retried from the offset that the service has."""


def send(
    http: "Session", file: Path, body: dict[str, Any], progress: Callable[[int, int], None] | None
) -> dict[str, Any]:
    """Upload a file and create a capture from it; returns the answer of the service.

    Parameters
    ----------
    body : dict
        Further fields of the request that creates the capture.
    progress : callable, optional
        Is called with the bytes that the service has, and with all there are.
    """
    from services.client import _session

    state = state_of(file)
    size, create = state.st_size, _creation_headers(file, state)
    where, offset, step, pause = "", -1, LARGEST, _session.FIRST_PAUSE
    give_up = time.monotonic() + _session.PATIENCE

    def reached(answer: "httpx2.Response") -> int:
        found = int(http.header(answer, "Upload-Offset"))
        if progress and size and found != offset:
            progress(found, size)
        return found

    with file.open("rb") as source:
        while True:
            try:
                if not where:
                    made = http.once("POST", "/v1/uploads", headers=create)
                    # Its id alone: a proxy may put the prefix that it serves the service below before the path.
                    where = f"/v1/uploads/{http.header(made, 'Location').rsplit('/', 1)[-1]}"
                if offset < size:
                    offset = reached(http.once("HEAD", where, headers=TUS))
                while offset < size:
                    source.seek(offset)
                    offset = reached(_patch(http, where, offset, source.read(step)))
                    step, pause = min(2 * step, LARGEST), _session.FIRST_PAUSE
                    give_up = time.monotonic() + _session.PATIENCE
                upload = where.rsplit("/", 1)[-1]
                return http.json("POST", "/v1/captures", json=body | {"upload": upload})
            except NotFound:
                if offset == size or not where:
                    raise
                offset = size  # another process may have finished this upload: then the capture exists
            except ServiceError as error:
                # As for other calls: is there a service? One that is busy says when to try again.
                there = http.answered and isinstance(error, Unreachable | Busy)
                hopeless = (
                    not (where or there) and error.status in (502, 503, 504) and error.retry_after is None
                )
                wait = max(pause, error.retry_after or 0.0)
                if hopeless or error.status not in TEMPORARY or time.monotonic() + wait > give_up:
                    raise
                time.sleep(wait)
                step, pause = max(step // 2, SMALLEST), min(2 * pause, _session.LONGEST_PAUSE)


def _creation_headers(file: Path, state: os.stat_result) -> dict[str, str]:
    """Headers of the request that starts an upload, or finds the one that an earlier call has started.

    The Idempotency-Key is a hash of the file's path, size and modification time, so the client stores nothing about
    the upload.
    """
    from services.client._declared import declared

    mark = f"{file.resolve()} {state.st_size} {state.st_mtime_ns}"
    key = hashlib.sha256(mark.encode(errors="surrogateescape")).hexdigest()
    known = declared(file) | {"filename": file.name.encode(errors="replace").decode()}
    metadata = ",".join(f"{name} {_base64(str(one))}" for name, one in known.items())
    return TUS | {"Upload-Length": str(state.st_size), "Idempotency-Key": key, "Upload-Metadata": metadata}


def _patch(http: "Session", where: str, offset: int, data: bytes) -> "httpx2.Response":
    if not data:
        raise FileChanged
    digest = base64.b64encode(hashlib.sha256(data).digest()).decode()
    headers = TUS | {
        "Content-Type": "application/offset+octet-stream",
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {digest}",
    }
    return http.once("PATCH", where, headers=headers, content=data)


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
