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
from tests.faults.rig import Row, stored
from tests.parts.disks import small_disk
from tests.parts.waiting import until

pytestmark = pytest.mark.timeout(900)

STORE, LEDGER = 64 << 20, 8 << 20


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
    service, start = small.service, time.monotonic()
    job = service.client.recover(small.capture)
    until(lambda: service.client.job(job["id"])["progress"] > 0.1)

    def refused() -> bool:
        """Whether an upload is accepted in the end: SQLite may reuse the room of its own log."""
        headers = {"Tus-Resumable": "1.0.0", "Upload-Length": "1", "Upload-Metadata": "name " + "QUFB" * 1000}
        answer = service.http.post("/v1/uploads", headers=headers)
        assert answer.status_code in (201, 507), answer.text
        if answer.status_code == 507:
            assert "the disk is full" in answer.json()["detail"]
        return answer.status_code == 507

    log = service.data.parent / f"{service.data.name}.log"
    message = "trying again in a second: the disk is full"
    with ExitStack() as filled:
        with paused(service):
            filled.enter_context(full(small.ledger))
            while not refused():
                pass
        count = log.read_text().count(message)
        until(lambda: log.read_text().count(message) > count + 2)
        until(lambda: service.http.get("/readyz").status_code == 503)
        assert service.client.job(job["id"])["state"] == "running"
    assert service.client.wait(job["id"])["state"] == "succeeded"
    until(lambda: service.http.get("/readyz").status_code == 200)
    assert "continues after an error" not in log.read_text()
    check(table, small.row("a full disk of SQLite", start, job["matte"]))
