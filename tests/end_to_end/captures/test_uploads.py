"""Uploads keep what arrived before a connection breaks or the disk is full; expired and deleted ones are gone."""

import os
import time
from pathlib import Path

import pytest

from services.client import ServiceError
from tests.end_to_end.captures.tus import TUS, begin_patch, create, offset_of, patch, uploads_of
from tests.end_to_end.conftest import Service, serving
from tests.end_to_end.problems import check_problem
from tests.parts.disks import small_disk
from tests.parts.waiting import until


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


@pytest.mark.slow
def test_bytes_before_a_broken_connection_are_kept(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 4 << 20)
    begin_patch(service, where, 0, 4 << 20, b"a" * (3 << 20)).close()
    until(lambda: offset_of(service, where))
    offset = offset_of(service, where)
    assert (3 << 20) - (1 << 18) <= offset <= 3 << 20  # the web server drops bytes it has not passed on
    begin_patch(service, where, offset, 1 << 20, b"").close()
    rest = b"b" * ((4 << 20) - offset)
    assert patch(service, where, offset, rest).headers["upload-offset"] == str(4 << 20)
    store = service.data / "store"
    parts = sorted((store / name).read_bytes() for name in uploads_of(service) - before)
    assert parts == [b"a" * offset, rest]
    service.http.delete(where, headers=TUS)


def test_deleted_upload_is_gone(service: Service) -> None:
    before = uploads_of(service)
    where = create(service, 1000)
    patch(service, where, 0, b"a" * 100)
    busy = begin_patch(service, where, 100, 900, b"b" * 300)
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
        slow = (time.sleep(1) or b"x" for _ in range(4))  # and it does not end in the midst of one
        assert patch(service, unfinished, 6, slow).status_code == 204
        assert service.http.head(finished, headers=TUS).status_code == 404
        until(lambda: not service.stored())
        check_problem(patch(service, unfinished, 10, b""), 404, "not-found")


def test_upload_that_is_no_capture_leaves_nothing(service: Service, tmp_path: Path) -> None:
    before = service.stored_ids()
    for data in (b"", b"this is no archive" * 1000):
        broken = tmp_path / "broken.zip"
        broken.write_bytes(data)
        with pytest.raises(ServiceError, match="not a ZIP archive"):
            service.client.upload(broken)
    assert service.stored_ids() <= before
