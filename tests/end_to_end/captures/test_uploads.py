"""Resumable uploads follow tus 1.0: every header and every refusal."""

import base64
import hashlib
import os
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from email.utils import parsedate_to_datetime
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest
from sqlalchemy import update

from services.client import ServiceError
from storage.database.engine import open_engine, writing
from storage.database.tables import uploads as table
from tests.end_to_end.captures.test_bad_input import check_problem
from tests.end_to_end.conftest import Service, paused, serving
from tests.parts.disks import small_disk
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
    given = CHUNK | {"Upload-Offset": str(offset)} | headers
    return service.http.patch(where, content=data, headers=given)


def offset_of(service: Service, where: str) -> int:
    return int(service.http.head(where, headers=TUS).headers["upload-offset"])


def begin(service: Service, where: str, offset: int, length: int, data: bytes) -> HTTPConnection:
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


def gone(service: Service, upload: str) -> None:
    """Wait until nothing of an upload is stored: an archive is deleted once its capture is ready."""
    until(lambda: not any(upload in name for name in uploads_of(service)))


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
    gone(service, capture["id"])
    service.http.delete(f"/v1/captures/{capture['id']}")
    check_problem(service.http.post("/v1/captures", json=body), 404, "not-found")


def test_creation_with_upload(service: Service) -> None:
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


def test_method_override(service: Service) -> None:
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
    assert uploads_of(service) == before
    assert patch(service, where, 0, b"12345", **header).headers["upload-offset"] == "5"
    for wrong in ("md5 AAAA", "sha1 ?", ""):
        answer = patch(service, where, 5, b"6", **{"Upload-Checksum": wrong})
        assert check_problem(answer, 400, "bad-header")["field"] == "Upload-Checksum"
        assert answer.headers["tus-resumable"] == "1.0.0"
    assert offset_of(service, where) == 5
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
    for length in ({}, {"Upload-Length": "-1"}, {"Upload-Length": "many"}, {"Upload-Defer-Length": "1"}):
        answer = service.http.post("/v1/uploads", headers=TUS | length)
        assert check_problem(answer, 400, "bad-header")["field"] == "Upload-Length"
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
def test_upload_limit_is_checked_before_the_first_byte(tmp_path: Path, capture_archive: Path) -> None:
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


@pytest.mark.slow
def test_full_disk_is_reported_and_loses_nothing(tmp_path: Path) -> None:
    with (
        small_disk(tmp_path / "disk", 48 << 20) as disk,
        serving(disk / "data", "--workers", "1") as service,
    ):
        where = create(service, 20 << 20)
        assert patch(service, where, 0, bytes(4 << 20)).status_code == 204
        # Another process takes the promised room.
        filler = disk / "filler"
        filler.write_bytes(bytes(os.statvfs(disk).f_bavail * os.statvfs(disk).f_bsize - (6 << 20)))
        before = uploads_of(service)
        body = iter([b"a" * (1 << 20)] * 16)
        problem = check_problem(patch(service, where, 4 << 20, body), 507, "no-room")
        assert "the disk is full" in problem["detail"]
        assert offset_of(service, where) == 4 << 20
        assert uploads_of(service) == before
        filler.unlink()
        assert patch(service, where, 4 << 20, b"a" * (16 << 20)).headers["upload-offset"] == str(20 << 20)


def test_bytes_before_a_broken_connection_are_kept(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 4 << 20)
    begin(service, where, 0, 4 << 20, b"a" * (3 << 20)).close()
    until(lambda: offset_of(service, where))
    offset = offset_of(service, where)
    assert (3 << 20) - (1 << 18) <= offset <= 3 << 20  # the web server drops bytes it has not passed on
    begin(service, where, offset, 1 << 20, b"").close()
    rest = b"b" * ((4 << 20) - offset)
    assert patch(service, where, offset, rest).headers["upload-offset"] == str(4 << 20)
    store = service.data / "store"
    parts = sorted((store / name).read_bytes() for name in uploads_of(service) - before)
    assert parts == [b"a" * offset, rest]
    service.http.delete(where, headers=TUS)


@pytest.mark.exhaustive
def test_silent_client_is_disconnected(service: Service) -> None:
    where = create(service, 1000)
    silent = begin(service, where, 0, 1000, b"a" * 300)
    until(lambda: offset_of(service, where) == 300)
    silent.close()
    service.http.delete(where, headers=TUS)


def test_upload_in_too_many_pieces_is_refused(service: Service) -> None:
    where = create(service, 1000)
    assert patch(service, where, 0, b"a").status_code == 204
    engine = open_engine(f"sqlite:///{service.data / 'envmatte.db'}")
    with writing(engine) as c:
        c.execute(update(table).where(table.c.id == where.rsplit("/", 1)[1]).values(parts=10_000))
    engine.dispose()
    assert check_problem(patch(service, where, 1, b"a"), 422, "bad-request")["limit"] == 10_000
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


def test_one_of_two_patches_at_the_same_offset_wins(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 1000)
    first = begin(service, where, 0, 1000, b"a" * 300)
    second = begin(service, where, 0, 1000, b"b" * 300)
    second.send(b"b" * 700)
    assert second.getresponse().status == 204
    first.send(b"a" * 700)
    assert first.getresponse().status == 409
    first.close()
    second.close()
    assert offset_of(service, where) == 1000
    (part,) = uploads_of(service) - before
    assert (service.data / "store" / part).read_bytes() == b"b" * 1000
    service.http.delete(where, headers=TUS)


def test_late_patch_damages_nothing(service: Service, capture_archive: Path) -> None:
    data = capture_archive.read_bytes()
    where = create(service, len(data))
    late = begin(service, where, 0, len(data), bytes(1000))
    assert patch(service, where, 0, data).status_code == 204
    with paused(service):
        made = service.http.post("/v1/captures", json={"upload": where.rsplit("/", 1)[1]}).json()
        late.send(bytes(len(data) - 1000))
        assert late.getresponse().status == 404
        late.close()
    assert service.client.wait(made["job"])["state"] == "succeeded"


def test_two_clients_with_the_same_key_share_an_upload(
    service: Service, capture_archive: Path, tmp_path: Path
) -> None:
    file = tmp_path / "same.zip"
    file.write_bytes(capture_archive.read_bytes())
    with ThreadPoolExecutor() as pool:
        made = [*pool.map(lambda _: service.client.upload(file), range(2))]
    # One or two captures: the slower client may finish after the first capture exists.
    for capture in made:
        assert service.client.wait(capture["job"])["state"] == "succeeded"
        gone(service, capture["id"])
    assert service.client.upload(file)["id"] not in {capture["id"] for capture in made}


def test_simultaneous_requests_make_one_capture(service: Service, capture_archive: Path) -> None:
    data = capture_archive.read_bytes()
    where = create(service, len(data))
    patch(service, where, 0, data)
    body = {"upload": where.rsplit("/", 1)[1]}
    with ThreadPoolExecutor() as pool:
        answers = [*pool.map(lambda _: service.http.post("/v1/captures", json=body), range(8))]
    assert {answer.status_code for answer in answers} == {201}
    assert {answer.json()["job"] for answer in answers} == {answers[0].json()["job"]}
    assert service.client.wait(answers[0].json()["job"])["state"] == "succeeded"


def test_deleted_upload_is_gone(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 1000)
    patch(service, where, 0, b"a" * 100)
    busy = begin(service, where, 100, 900, b"b" * 300)
    assert service.http.delete(where, headers=TUS).status_code == 204
    busy.send(b"b" * 600)
    assert busy.getresponse().status == 404
    busy.close()
    assert service.http.head(where, headers=TUS).status_code == 404
    check_problem(patch(service, where, 100, b"x"), 404, "not-found")
    check_problem(service.http.delete(where, headers=TUS), 404, "not-found")
    assert uploads_of(service) <= before  # some may have been ingested meanwhile


@pytest.mark.slow
def test_abandoned_upload_expires(tmp_path: Path) -> None:
    with serving(tmp_path / "data", "--workers", "1", ENVMATTE_UPLOAD_SECONDS="2") as service:
        unfinished, finished = create(service, 10), create(service, 3)
        patch(service, finished, 0, b"123")
        for offset in range(6):  # each piece extends its lifetime
            assert patch(service, unfinished, offset, b"x").status_code == 204
            time.sleep(0.5)
        assert service.http.head(finished, headers=TUS).status_code == 404
        until(lambda: not service.stored())
        check_problem(patch(service, unfinished, 6, b"x"), 404, "not-found")


def test_upload_that_is_no_capture_leaves_nothing(service: Service, tmp_path: Path) -> None:
    before = service.stored()
    for data in (b"", b"this is no archive" * 1000):
        broken = tmp_path / "broken.zip"
        broken.write_bytes(data)
        with pytest.raises(ServiceError, match="not a ZIP archive"):
            service.client.upload(broken)
    assert service.stored() == before
