"""Resumable uploads follow tus 1.0: every header and every refusal."""

import base64
import hashlib
import socket
import time
from email.utils import parsedate_to_datetime
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest
from sqlalchemy import update

from storage.database.engine import open_engine, writing
from storage.database.tables import uploads as table
from tests.end_to_end.captures.tus import (
    CHUNK,
    TUS,
    create,
    offset_of,
    patch,
    uploads_of,
    wait_until_deleted,
)
from tests.end_to_end.conftest import Service, serving
from tests.end_to_end.problems import check_problem
from tests.parts.waiting import until


def test_options_list_versions_and_extensions(service: Service) -> None:
    answer = service.http.options("/v1/uploads")
    assert answer.status_code == 204
    assert answer.headers["tus-resumable"] == answer.headers["tus-version"] == "1.0.0"
    extensions = {"creation", "creation-with-upload", "checksum", "expiration", "termination"}
    assert set(answer.headers["tus-extension"].split(",")) == extensions
    assert answer.headers["tus-max-size"] == str(8 << 30)
    assert answer.headers["tus-checksum-algorithm"] == "sha1,sha256"


def test_capture_from_several_patches(service: Service, capture_archive: Path) -> None:
    data = capture_archive.read_bytes()
    metadata = f"filename {base64.b64encode(b'ball.zip').decode()},empty"
    answer = service.http.post(
        "/v1/uploads", headers=TUS | {"Upload-Length": str(len(data)), "Upload-Metadata": metadata}
    )
    where = answer.headers["location"]
    assert where.startswith("/v1/uploads/")
    assert answer.headers["upload-offset"] == "0"
    third = len(data) // 3
    for offset in (0, third, 2 * third):
        piece = data[offset : offset + third] if offset < 2 * third else data[offset:]
        answer = patch(service, where, offset, piece)
        assert (answer.status_code, answer.content) == (204, b"")
        assert answer.headers["upload-offset"] == str(offset + len(piece))
        assert answer.headers["tus-resumable"] == "1.0.0"
        assert (
            86_000
            < parsedate_to_datetime(answer.headers["upload-expires"]).timestamp() - time.time()
            < 86_401
        )
        answer = service.http.head(where, headers=TUS)
        assert answer.status_code == 200
        assert answer.headers["upload-offset"] == str(offset + len(piece))
        assert answer.headers["upload-length"] == str(len(data))
        assert answer.headers["upload-metadata"] == metadata
        assert answer.headers["cache-control"] == "no-store"
    body = {"upload": where.rsplit("/", 1)[1], "name": "from pieces"}
    made = service.http.post("/v1/captures", json=body)
    assert made.status_code == 201
    capture = made.json()
    assert made.headers["location"] == f"/v1/captures/{capture['id']}"
    assert (capture["name"], capture["bytes"]) == ("from pieces", len(data))
    assert service.http.post("/v1/captures", json=body).json()["id"] == capture["id"]
    assert service.client.wait(capture["job"])["state"] == "succeeded"
    assert service.http.post("/v1/captures", json=body).json()["state"] == "ready"
    assert service.http.head(where, headers=TUS).status_code == 404
    wait_until_deleted(service, capture["id"])
    service.http.delete(f"/v1/captures/{capture['id']}")
    check_problem(service.http.post("/v1/captures", json=body), 404, "not-found")


def test_creation_may_have_the_first_bytes(service: Service) -> None:
    headers = CHUNK | {"Upload-Length": "10"}
    answer = service.http.post("/v1/uploads", headers=headers, content=b"12345")
    assert (answer.status_code, answer.headers["upload-offset"]) == (201, "5")
    where = answer.headers["location"]
    assert offset_of(service, where) == 5
    assert patch(service, where, 5, b"").headers["upload-offset"] == "5"
    assert patch(service, where, 5, b"67890").headers["upload-offset"] == "10"
    service.http.delete(where, headers=TUS)
    answer = service.http.post("/v1/uploads", headers=TUS | {"Upload-Length": "10"}, content=b"12345")
    check_problem(answer, 415, "wrong-media-type")
    answer = service.http.post("/v1/uploads", headers=CHUNK | {"Upload-Length": "3"}, content=b"12345")
    check_problem(answer, 413, "too-large")


def test_method_may_be_overridden(service: Service) -> None:
    where = create(service, 3)
    headers = CHUNK | {"Upload-Offset": "0", "X-HTTP-Method-Override": "PATCH"}
    assert service.http.post(where, headers=headers, content=b"abc").status_code == 204
    assert offset_of(service, where) == 3
    assert service.http.post(where, headers=TUS | {"X-HTTP-Method-Override": "DELETE"}).status_code == 204


def test_same_idempotency_key_continues_the_same_upload(service: Service) -> None:
    where = create(service, 10, **{"Idempotency-Key": "one file"})
    patch(service, where, 0, b"1234")
    again = service.http.post(
        "/v1/uploads", headers=TUS | {"Upload-Length": "10", "Idempotency-Key": "one file"}
    )
    assert (again.headers["location"], again.headers["upload-offset"]) == (where, "4")
    service.http.delete(where, headers=TUS)
    assert create(service, 10, **{"Idempotency-Key": "one file"}) != where


@pytest.mark.parametrize("algorithm", ["sha1", "sha256"])
def test_only_bytes_that_match_the_checksum_are_kept(service: Service, algorithm: str) -> None:
    before = uploads_of(service)
    where = create(service, 10)
    digest = base64.b64encode(hashlib.new(algorithm, b"12345").digest()).decode()
    header = {"Upload-Checksum": f"{algorithm} {digest}"}
    check_problem(patch(service, where, 0, b"12346", **header), 460, "checksum-mismatch")
    assert offset_of(service, where) == 0
    assert uploads_of(service) <= before
    assert patch(service, where, 0, b"12345", **header).headers["upload-offset"] == "5"
    for wrong in ("md5 AAAA", "sha1 ?", ""):
        answer = patch(service, where, 5, b"6", **{"Upload-Checksum": wrong})
        assert check_problem(answer, 400, "bad-header")["field"] == "Upload-Checksum"
        assert answer.headers["tus-resumable"] == "1.0.0"
    assert offset_of(service, where) == 5
    service.http.delete(where, headers=TUS)


def test_unverified_bytes_are_not_kept(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 1000)
    host = urlsplit(service.url)
    head = "".join(
        f"{name}: {value}\r\n"
        for name, value in (
            CHUNK
            | {
                "Host": "localhost",
                "Upload-Offset": "0",
                "Content-Length": "1000",
                "Upload-Checksum": "sha1 AAAA",
            }
        ).items()
    )
    with socket.create_connection((host.hostname, host.port)) as raw:
        raw.sendall(f"PATCH {where} HTTP/1.1\r\n{head}\r\n".encode() + b"a" * 300)
    until(lambda: uploads_of(service) == before)
    assert offset_of(service, where) == 0
    service.http.delete(where, headers=TUS)


def test_invalid_requests_are_refused(service: Service) -> None:
    where = create(service, 10)
    patch(service, where, 0, b"12345")
    for version in ({}, {"Tus-Resumable": "0.2.2"}):
        for method, url in (("POST", "/v1/uploads"), ("PATCH", where), ("DELETE", where)):
            answer = service.http.request(method, url, headers=version | {"Upload-Length": "1"})
            check_problem(answer, 412, "wrong-version")
            assert answer.headers["tus-version"] == "1.0.0"
        assert service.http.head(where, headers=version).status_code == 412
    for offset in (0, 4, 6, 10, 99):
        assert check_problem(patch(service, where, offset, b"x"), 409, "conflict")["offset"] == 5
    for offset in ("", "-1", "five", "1e3", "٣", "9" * 30):
        answer = patch(service, where, 5, b"x", **{"Upload-Offset": offset.encode()})  # type: ignore[arg-type]
        assert check_problem(answer, 400, "bad-header")["field"] == "Upload-Offset"
    answer = patch(service, where, 5, b"x", **{"Content-Type": "application/zip"})
    check_problem(answer, 415, "wrong-media-type")
    assert check_problem(patch(service, where, 5, b"123456"), 413, "too-large")["limit"] == 10
    chunked = service.http.patch(
        where, headers=CHUNK | {"Upload-Offset": "5"}, content=iter([b"123", b"456"])
    )
    check_problem(chunked, 413, "too-large")
    for length in ({}, {"Upload-Length": "-1"}, {"Upload-Length": "many"}):
        answer = service.http.post("/v1/uploads", headers=TUS | length)
        assert check_problem(answer, 400, "bad-header")["field"] == "Upload-Length"
    for name, value in (
        ("Upload-Concat", "partial"),
        ("Upload-Concat", f"final;{where}"),
        ("Upload-Defer-Length", "1"),
    ):
        headers = TUS | ({"Upload-Length": "1"} if name == "Upload-Concat" else {}) | {name: value}
        answer = service.http.post("/v1/uploads", headers=headers)
        assert check_problem(answer, 400, "bad-header")["field"] == name
    for metadata in ("name ?", "a,a", ",", "a YQ==,,b", "x " + "A" * 9000):
        answer = service.http.post(
            "/v1/uploads", headers=TUS | {"Upload-Length": "1", "Upload-Metadata": metadata}
        )
        assert check_problem(answer, 400, "bad-header")["field"] == "Upload-Metadata"
    check_problem(service.http.get(where), 405, "method-not-allowed")
    assert offset_of(service, where) == 5
    body = {"upload": where.rsplit("/", 1)[1]}
    assert check_problem(service.http.post("/v1/captures", json=body), 409, "conflict")["offset"] == 5
    for wrong in ({}, {"upload": 3}, body | {"more": 1}, body | {"name": "x" * 201}, []):
        check_problem(service.http.post("/v1/captures", json=wrong), 422, "bad-request")
    assert service.http.delete(where, headers=TUS).status_code == 204


@pytest.mark.slow
def test_upload_limit_is_checked_before_the_first_byte(tmp_path: Path) -> None:
    limit = 1 << 58
    with serving(tmp_path / "data", "--workers", "1", ENVMATTE_UPLOAD_BYTES=str(limit)) as service:
        assert service.http.options("/v1/uploads").headers["tus-max-size"] == str(limit)
        host = urlsplit(service.url)
        for length, status, slug in ((limit + 1, 413, "too-large"), (1 << 55, 507, "no-room")):
            raw = HTTPConnection(host.hostname or "", host.port, timeout=120)
            raw.putrequest("POST", "/v1/uploads")
            for name, value in (CHUNK | {"Upload-Length": length, "Content-Length": length}).items():
                raw.putheader(name, str(value))
            raw.endheaders()  # and no byte of the body
            answer = raw.getresponse()
            problem = httpx2.Response(answer.status, headers=dict(answer.headers), content=answer.read())
            assert check_problem(problem, status, slug).keys() & {"limit", "missing"}
            raw.close()
        headers = {"Content-Type": "application/zip", "Content-Length": str(1 << 55)}
        raw = HTTPConnection(host.hostname or "", host.port, timeout=120)
        raw.request("POST", "/v1/captures", headers=headers)
        assert raw.getresponse().status == 507
        raw.close()
        assert service.stored() == set()


def test_upload_in_too_many_pieces_is_refused(service: Service) -> None:
    where = create(service, 1000)
    assert patch(service, where, 0, b"a").status_code == 204
    engine = open_engine(f"sqlite:///{service.data / 'envmatte.db'}")
    with writing(engine) as c:
        c.execute(update(table).where(table.c.id == where.rsplit("/", 1)[1]).values(parts=10_000))
    engine.dispose()
    assert check_problem(patch(service, where, 1, b"a"), 422, "bad-request")["limit"] == 10_000
    service.http.delete(where, headers=TUS)
