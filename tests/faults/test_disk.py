"""Full disks: jobs fail with a reason or wait, nothing half written stays, and work continues with room."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from storage.layout import mattes
from storage.objects.store import Objects
from tests.end_to_end.conftest import Service, paused, serving
from tests.faults.conftest import check
from tests.parts.disks import small_disk
from tests.parts.rig import Row, stored
from tests.parts.waiting import until

pytestmark = pytest.mark.timeout(900)

STORE, LEDGER = 64 << 20, 32 << 20


@dataclass
class Small:
    """A service whose store and database are on small disks, and the matte of a capture there."""

    service: Service
    store: Path
    ledger: Path
    capture: str
    files: dict[str, str]

    def matte(self, matte: str) -> dict[str, str]:
        return stored(Objects((self.store / "store").as_uri()), mattes.path(matte))

    def row(self, fault: str, start: float, matte: str) -> Row:
        differing = self.matte(matte) != self.files
        return Row(fault, 1, differing=int(differing), seconds=[round(time.monotonic() - start, 2)])

    def half_written(self) -> list[str]:
        # os.walk skips folders that are deleted meanwhile.
        return [name for _, _, names in os.walk(self.store) for name in names if "#" in name]

    def retried(self, job: str) -> str:
        assert self.service.http.post(f"/v1/jobs/{job}/retry").status_code == 202
        return str(self.service.client.wait(job)["state"])

    def failed_for_room(self, job: str) -> bool:
        """Check that a job fails for lack of room and the service keeps working."""
        until(lambda: self.service.client.job(job)["state"] not in ("queued", "running"))
        found = self.service.client.job(job)
        assert (found["state"], found["problem"]["type"]) == ("failed", "urn:envmatte:problem:no-room"), found
        assert "the disk is full" in found["problem"]["detail"]
        assert not self.half_written()
        return self.service.http.get("/healthz").status_code == 200


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory, capture_archive: Path) -> Iterator[Small]:
    folder = tmp_path_factory.mktemp("disks")
    with small_disk(folder / "store", STORE) as store, small_disk(folder / "ledger", LEDGER) as ledger:
        where = ("--store", (store / "store").as_uri(), "--database", f"sqlite:///{ledger / 'ledger.db'}")
        with serving(folder / "data", "--workers", "1", *where) as service:
            uploaded = service.client.upload(capture_archive)
            service.client.wait(uploaded["job"])
            found = Small(service, store, ledger, uploaded["id"], {})
            found.files = found.matte(
                service.client.wait(service.client.recover(uploaded["id"])["id"])["matte"]
            )
            yield found


@contextmanager
def full(disk: Path, left: int = 0) -> Iterator[None]:
    """Fill a disk up to some free bytes until the block ends."""
    ballast = disk / "ballast"
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(disk).free - left)
    try:
        yield
    finally:
        ballast.unlink()


@pytest.mark.exhaustive
def test_full_disk_during_ingest(small: Small, capture_archive: Path, table: list[Row]) -> None:
    service, start = small.service, time.monotonic()
    with ExitStack() as filled:
        with paused(service):
            uploaded = service.client.upload(capture_archive)
            filled.enter_context(full(small.store, 256 << 10))
        assert small.failed_for_room(uploaded["job"])
    assert small.retried(uploaded["job"]) == "succeeded"
    job = service.client.wait(service.client.recover(uploaded["id"])["id"])
    check(table, small.row("a full disk at ingest", start, job["matte"]))


@pytest.mark.exhaustive
def test_full_disk_during_tiles(small: Small, table: list[Row]) -> None:
    start = time.monotonic()
    with full(small.store, 256 << 10):
        job = small.service.client.recover(small.capture)
        assert small.failed_for_room(job["id"])
    assert small.retried(job["id"]) == "succeeded"
    check(table, small.row("a full disk at tiles", start, job["matte"]))


@pytest.mark.exhaustive
def test_full_disk_of_sqlite(small: Small, table: list[Row]) -> None:
    """The job goes on, as the database has a reserve within its files."""
    service, start = small.service, time.monotonic()
    job = service.client.recover(small.capture)
    until(lambda: service.client.job(job["id"])["progress"] > 0.1)
    with full(small.ledger):
        check_full(service)
        assert service.client.wait(job["id"])["state"] == "succeeded"
    until(lambda: service.http.get("/readyz").status_code == 200)
    check(table, small.row("a full disk of SQLite", start, job["matte"]))


def check_full(service: Service) -> None:
    """Check that a service on a full disk says so, and refuses what is new."""
    headers = {"Tus-Resumable": "1.0.0", "Upload-Length": "1"}
    answer = service.http.post("/v1/uploads", headers=headers)
    assert (answer.status_code, answer.json()["type"]) == (507, "urn:envmatte:problem:no-room")
    assert "the disk is full" in answer.json()["detail"]
    until(lambda: service.http.get("/readyz").status_code == 503)  # it looks once a second
    assert "full" in service.http.get("/readyz").json()["database"]


@pytest.mark.slow
def test_full_disk_can_be_left_by_calls(tmp_path: Path, capture_archive: Path) -> None:
    with (
        small_disk(tmp_path / "disk", STORE) as disk,
        serving(disk / "data", "--workers", "1") as service,
        paused(service),
    ):
        made = service.client.upload(capture_archive)
        uploads = []
        size = shutil.disk_usage(disk).free
        while size > 1 << 19:  # uploads to the last byte that is accepted
            headers = {"Tus-Resumable": "1.0.0", "Upload-Length": str(size), "Upload-Offset": "0"}
            chunk = headers | {"Content-Type": "application/offset+octet-stream"}
            answer = service.http.post("/v1/uploads", headers=chunk, content=bytes(size))
            if answer.status_code == 201:
                uploads.append(answer.headers["location"])
            else:
                assert answer.status_code == 507
                size //= 2
        usage = shutil.disk_usage(disk)
        assert 0.04 * usage.total < usage.free < 0.07 * usage.total  # the reserve
        until(lambda: service.http.get("/readyz").status_code == 200)
        with full(disk):
            check_full(service)
            assert service.http.post(f"/v1/jobs/{made['job']}/cancel").json()["state"] == "cancelled"
            for path in (uploads[0], f"/v1/captures/{made['id']}"):
                assert service.http.delete(path, headers={"Tus-Resumable": "1.0.0"}).status_code == 204
            until(lambda: not (disk / "data/store/uploads" / made["id"]).exists())
            assert shutil.disk_usage(disk).free > usage.free
        until(lambda: service.http.get("/readyz").status_code == 200)
        assert "trying again every second" not in (disk / "data.log").read_text()
