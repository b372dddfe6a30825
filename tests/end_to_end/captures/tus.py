"""Requests of a tus client, and the uploads in the store."""

from collections.abc import Iterator
from http.client import HTTPConnection
from urllib.parse import urlsplit

import httpx2

from tests.end_to_end.conftest import Service
from tests.parts.waiting import until

TUS = {"Tus-Resumable": "1.0.0"}
CHUNK = TUS | {"Content-Type": "application/offset+octet-stream"}


def create(service: Service, length: int, **headers: str) -> str:
    answer = service.http.post("/v1/uploads", headers=TUS | {"Upload-Length": str(length)} | headers)
    assert answer.status_code == 201, answer.text
    return str(answer.headers["location"])


def patch(
    service: Service, where: str, offset: int, data: bytes | Iterator[bytes], **headers: str
) -> httpx2.Response:
    return service.http.patch(where, content=data, headers=CHUNK | {"Upload-Offset": str(offset)} | headers)


def offset_of(service: Service, where: str) -> int:
    return int(service.http.head(where, headers=TUS).headers["upload-offset"])


def begin_patch(service: Service, where: str, offset: int, length: int, data: bytes) -> HTTPConnection:
    """Start a PATCH and send only part of its body."""
    host = urlsplit(service.url)
    assert host.hostname is not None
    connection = HTTPConnection(host.hostname, host.port, timeout=120)
    connection.putrequest("PATCH", where)
    for name, value in (CHUNK | {"Upload-Offset": str(offset), "Content-Length": str(length)}).items():
        connection.putheader(name, value)
    connection.endheaders()
    connection.send(data)
    return connection


def uploads_of(service: Service) -> set[str]:
    return {name for name in service.stored() if name.startswith("uploads/")}


def wait_until_deleted(service: Service, upload: str) -> None:
    """Wait until nothing of an upload is stored: a capture archive is deleted once its capture is ready."""
    until(lambda: not any(upload in name for name in uploads_of(service)))
