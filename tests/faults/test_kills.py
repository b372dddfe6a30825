"""Processes are killed or frozen at random moments and jobs cancelled: no job is lost, every matte is the same to
the byte.
"""

import random
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from storage.objects.store import Objects
from tests.end_to_end.conftest import serving
from tests.faults.conftest import Prepared, check
from tests.faults.rig import Row, freeze, stored, thaw
from tests.parts.waiting import until

pytestmark = pytest.mark.timeout(7200)


@pytest.mark.slow
def test_killed_worker(prepared: Prepared, table: list[Row], times: int) -> None:
    def kill() -> None:
        until(prepared.rig.workers)
        random.choice(prepared.rig.workers()).kill()

    check(table, prepared.disturb("SIGKILL of a worker", kill, times))


@pytest.mark.exhaustive
def test_all_workers_killed(prepared: Prepared, table: list[Row], times: int) -> None:
    def kill() -> None:
        for worker in prepared.rig.workers():
            worker.kill()

    check(table, prepared.disturb("SIGKILL of all workers", kill, times))


@pytest.mark.exhaustive
def test_killed_scheduler(prepared: Prepared, table: list[Row], times: int) -> None:
    rig = prepared.rig
    row = prepared.disturb("SIGKILL of the scheduler", lambda: rig.restart("scheduler"), times)
    check(table, row)


@pytest.mark.slow
def test_killed_leading_service(prepared: Prepared, table: list[Row], times: int) -> None:
    rig = prepared.rig
    row = prepared.disturb("SIGKILL of API and coordinator", lambda: rig.restart(rig.leader()), times)
    check(table, row)


@pytest.mark.exhaustive
def test_frozen_worker(prepared: Prepared, table: list[Row]) -> None:
    frozen: list[psutil.Process] = []

    def act() -> None:
        frozen.append(prepared.rig.workers()[0])
        freeze(frozen[0])

    start = time.monotonic()
    row = prepared.disturb("SIGSTOP of a worker, for 60 s", act, 1)
    time.sleep(max(0.0, 60 - (time.monotonic() - start)))
    with suppress(psutil.NoSuchProcess):  # its nanny may have killed it meanwhile
        thaw(frozen[0])
    time.sleep(3)  # time to do what it was about to do when frozen
    (matte, *_) = prepared.rig.ask("GET", "/v1/mattes").json()["mattes"]
    assert prepared.rig.files(matte["id"]) == prepared.files
    check(table, row)


@pytest.mark.slow
def test_cancelled_job_frees_workers_and_disk(prepared: Prepared) -> None:
    rig = prepared.rig
    # One tile of nn-dgsr that takes minutes.
    options = {"method": "nn-dgsr", "tile": 1024}
    job = rig.ask("POST", "/v1/jobs", json={"capture": prepared.capture, "options": options}).json()
    until(lambda: rig.job(job["id"])["stage"] == "recovering")
    time.sleep(1)
    cancelled = rig.ask("POST", f"/v1/jobs/{job['id']}/cancel").json()
    assert cancelled["state"] == "cancelled"
    until(lambda: not rig.names(job["matte"]), 10)
    assert rig.ask("GET", f"/v1/mattes/{job['matte']}").status_code == 404
    after = rig.recover(prepared.capture)
    prepared.check_continues(after["id"], after["matte"])
    assert not rig.names(job["matte"])


@pytest.mark.slow
def test_any_process_of_a_service_killed(
    capture_archive: Path, tmp_path: Path, table: list[Row], times: int
) -> None:
    row = Row("SIGKILL of any process, 4 a job")
    with serving(tmp_path / "data", "--workers", "2") as service:
        capture = service.client.upload(capture_archive)["id"]
        objects = Objects((tmp_path / "data" / "store").as_uri())

        def recovered(kills: int) -> dict[str, str]:
            job = service.client.recover(capture, tile=16)
            for _ in range(kills):
                time.sleep(random.uniform(0.5, 2))
                with suppress(psutil.NoSuchProcess, IndexError):  # it ended, or all of them have
                    random.choice(psutil.Process(service.process.pid).children(recursive=True)).kill()
                    row.injected += 1
            began = time.monotonic()
            until(lambda: service.client.job(job["id"])["state"] not in ("queued", "running"), 120)
            row.seconds.append(time.monotonic() - began)
            row.lost += service.client.job(job["id"])["state"] != "succeeded"
            return stored(objects, f"mattes/{job['matte']}")

        expected = recovered(0)
        row.seconds.clear()
        for _ in range(times):
            row.differing += recovered(4) != expected
    check(table, row)
