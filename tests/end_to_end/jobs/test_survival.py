"""A service survives kills, cancelled jobs and a second service, and its mattes stay the same to the byte."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from services.client import ServiceError
from tests.end_to_end.captures.tus import begin_patch, create
from tests.end_to_end.conftest import TILES, Service, digests, png, serving
from tests.parts.waiting import until
from tests.services.cluster.clusters import workers


def files_of(service: Service, matte: str) -> dict[str, str]:
    return digests(service.data / "store" / "mattes" / matte)


def wait_until_deleted(service: Service, matte: str) -> None:
    """Wait until nothing of a matte is left."""
    until(lambda: service.http.get(f"/v1/mattes/{matte}").status_code == 404)
    until(lambda: not any(matte in name for name in service.stored()))


def recovered(service: Service, capture_archive: Path, **options: object) -> dict[str, str]:
    uploaded = service.client.upload(capture_archive)
    job = service.client.wait(service.client.recover(uploaded["id"], **options)["id"])
    return files_of(service, job["matte"])


def test_job_continues_after_the_server_is_killed(
    service: Service, matte: str, capture_archive: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    with serving(data, "--workers", "1") as first:
        job = first.client.recover(first.client.upload(capture_archive)["id"])
        until(lambda: first.client.job(job["id"])["tiles"]["done"] >= 3)
        family = psutil.Process(first.process.pid).children(recursive=True)
        first.kill()
        _, alive = psutil.wait_procs(family, timeout=300)
        assert alive == []
    with serving(data, "--workers", "1") as second:
        found = second.client.job(job["id"])
        assert 3 <= found["tiles"]["done"] < TILES
        ended = second.client.wait(job["id"])
        assert ended["tiles"] == {"total": TILES, "done": TILES, "failed": 0}
        log = [line["text"] for line in second.http.get(f"/v1/jobs/{job['id']}/log").json()["lines"]]
        assert log.count("preparing") == 1
        assert files_of(second, ended["matte"]) == files_of(service, matte)


@pytest.mark.exhaustive
def test_ingest_continues_after_the_server_is_killed(
    service: Service, matte: str, capture_archive: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    # A frame takes 20 kB: a budget of 1 MiB makes slabs of a few frames, and many tiles.
    with serving(data, "--workers", "1", ENVMATTE_INGEST_MEMORY=str(1 << 20)) as first:
        uploaded = first.client.upload(capture_archive)
        until(lambda: first.client.job(uploaded["job"])["stage"] != "waiting")
        first.kill()
    with serving(data, "--workers", "2", ENVMATTE_INGEST_MEMORY=str(1 << 20)) as second:
        assert second.client.wait(uploaded["job"])["state"] == "succeeded"
        job = second.client.wait(second.client.recover(uploaded["id"])["id"])
        assert files_of(second, job["matte"]) == files_of(service, matte)


@pytest.mark.exhaustive
def test_matte_bytes_do_not_depend_on_tiles_or_workers(
    service: Service, matte: str, capture_archive: Path, tmp_path: Path
) -> None:
    expected = files_of(service, matte)
    assert len(expected) > 100
    assert recovered(service, capture_archive, tile=48) == expected
    assert recovered(service, capture_archive, tile=1024) == expected
    with serving(tmp_path / "data", "--workers", "3") as other:
        assert recovered(other, capture_archive, tile=32) == expected


def test_cancelled_job_leaves_nothing(service: Service, capture: str) -> None:
    job = service.client.recover(capture)
    until(lambda: service.client.job(job["id"])["tiles"]["done"] >= 2)
    assert service.client.cancel(job["id"])["state"] == "cancelled"
    with pytest.raises(ServiceError, match="cancelled"):
        service.client.wait(job["id"])
    wait_until_deleted(service, job["matte"])
    assert service.client.cancel(job["id"])["state"] == "cancelled"


@pytest.mark.slow
def test_job_cancelled_while_waiting_leaves_nothing(service: Service, capture_archive: Path) -> None:
    uploaded = service.client.upload(capture_archive)
    job = service.client.recover(uploaded["id"])
    assert service.client.cancel(job["id"])["state"] == "cancelled"
    service.client.wait(uploaded["job"])
    wait_until_deleted(service, job["matte"])


def test_cancelled_ingest_leaves_nothing(service: Service, capture: str, capture_archive: Path) -> None:
    service.client.recover(capture, tile=1024)  # keeps a worker busy
    before = service.stored()
    uploaded = service.client.upload(capture_archive)
    service.client.cancel(uploaded["job"])
    until(lambda: service.client.capture(uploaded["id"])["state"] != "ingesting")
    assert service.client.capture(uploaded["id"])["problem"]["detail"].startswith("the ingest was cancelled")
    until(lambda: not any(uploaded["id"] in name for name in service.stored() - before))


def test_job_deleted_as_soon_as_it_is_cancelled_leaves_nothing(
    service: Service, capture: str, capture_archive: Path
) -> None:
    made = []
    for _ in range(3):
        job = service.client.recover(capture)
        until(lambda job=job: service.client.job(job["id"])["tiles"]["done"])
        uploaded = service.client.upload(capture_archive)
        made += [uploaded["id"], job["matte"]]
        for one in (job["id"], uploaded["job"]):
            service.http.post(f"/v1/jobs/{one}/cancel")
            assert service.http.delete(f"/v1/jobs/{one}").status_code == 204
            assert service.http.get(f"/v1/jobs/{one}").status_code == 404
    until(lambda: service.stored_ids().isdisjoint(made), 20)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_ingest_that_failed_for_a_passing_reason_can_be_retried(
    capture_archive: Path, tmp_path: Path
) -> None:
    with serving(tmp_path / "data", "--workers", "1") as service:
        first = service.client.upload(capture_archive)
        service.client.wait(first["job"])
        busy = service.client.recover(first["id"], tile=1024)
        until(lambda: service.client.job(busy["id"])["stage"] == "recovering")
        time.sleep(0.3)
        second = service.client.upload(capture_archive)
        (part,) = (service.data / "store" / "uploads" / second["id"]).glob("*.part")
        data = part.read_bytes()
        part.unlink()
        with pytest.raises(ServiceError, match="failed 3 times"):
            service.client.wait(second["job"])
        assert service.client.capture(second["id"])["state"] == "failed"
        part.write_bytes(data)
        assert service.http.post(f"/v1/jobs/{second['job']}/retry").status_code == 202
        service.client.wait(second["job"])
        assert service.client.capture(second["id"])["state"] == "ready"


@pytest.mark.exhaustive
def test_job_cancelled_before_a_kill_leaves_nothing(capture_archive: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    with serving(data, "--workers", "1") as first:
        job = first.client.recover(first.client.upload(capture_archive)["id"])
        until(lambda: first.client.job(job["id"])["tiles"]["done"] >= 2)
        first.client.cancel(job["id"])
        first.kill()
    (data / "store" / "uploads").mkdir(exist_ok=True)
    (data / "store" / "uploads" / "orphan.zip").write_bytes(b"an upload that was cut off by the kill")
    (data / "store" / "uploads" / "orphan.zip#1").write_bytes(b"and one that was being written")
    with serving(data, "--workers", "1") as second:
        until(lambda: not [name for name in second.stored() if "orphan" in name])
        wait_until_deleted(second, job["matte"])
        assert second.client.job(job["id"])["state"] == "cancelled"
        assert second.client.wait(second.client.recover(job["capture"])["id"])["state"] == "succeeded"


@pytest.mark.slow
def test_killed_worker_changes_no_byte(service: Service, matte: str, capture: str) -> None:
    job = service.client.recover(capture)
    until(lambda: service.client.job(job["id"])["tiles"]["done"] >= 3)
    workers(service.process)[-1].kill()
    ended = service.client.wait(job["id"])
    assert files_of(service, ended["matte"]) == files_of(service, matte)


@pytest.mark.slow
def test_damaged_matte_is_reported(service: Service, capture: str) -> None:
    job = service.client.wait(service.client.recover(capture, tile=48)["id"])
    folder = service.data / "store" / "mattes" / job["matte"]
    for at, name in ((0, "S/c/0/0/0"), (16, "count/c/1/1/0"), (32, "T/2.2/weight/c/0")):
        data = (folder / name).read_bytes()
        (folder / name).unlink()
        white = png(np.ones((2, 2, 3), np.float32), "srgb", np.uint8)
        block = {"x": at, "y": at, "width": 16, "height": 16}  # other blocks are cached in memory
        answer = service.http.post(f"/v1/mattes/{job['matte']}/composite", params=block, content=white)
        assert (answer.status_code, answer.json()["type"]) == (500, "urn:envmatte:problem:corrupt")
        (folder / name).write_bytes(data)


@pytest.mark.slow
def test_failing_tile_fails_its_job_and_retry_continues(
    service: Service, matte: str, capture_archive: Path
) -> None:
    uploaded = service.client.upload(capture_archive)
    service.client.wait(uploaded["job"])
    chunk = service.data / "store" / "captures" / uploaded["id"] / "frames" / "c" / "0" / "0" / "0" / "0"
    data = chunk.read_bytes()
    job = service.client.recover(uploaded["id"])
    until(lambda: service.client.job(job["id"])["tiles"]["done"] >= 3)
    chunk.unlink()
    with pytest.raises(ServiceError, match="is missing"):
        service.client.wait(job["id"])
    failed = service.client.job(job["id"])
    assert failed["state"] == "failed"
    assert 3 <= failed["tiles"]["done"] < TILES
    chunk.write_bytes(data)
    assert service.http.post(f"/v1/jobs/{job['id']}/retry").status_code == 202
    assert service.client.wait(job["id"])["tiles"] == {"total": TILES, "done": TILES, "failed": 0}
    assert files_of(service, job["matte"]) == files_of(service, matte)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_stopped_server_leaves_no_process(
    capture_archive: Path, tmp_path: Path, number: int, code: int
) -> None:
    with serving(tmp_path / "data", "--workers", "2") as service:
        service.client.recover(service.client.upload(capture_archive)["id"])
        sending = begin_patch(service, create(service, 1000), 0, 1000, b"the rest of which never comes")
        family = psutil.Process(service.process.pid).children(recursive=True)
        assert len(family) >= 2
        service.process.send_signal(number)
        assert service.process.wait(120) == code
        sending.close()
        _, alive = psutil.wait_procs(family, timeout=300)
        assert alive == []


@pytest.mark.slow
def test_second_service_on_the_same_folder_is_refused(service: Service) -> None:
    command = [sys.executable, "-m", "services", "serve", "--data", str(service.data), "--port", "0"]
    second = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert second.returncode == 1
    assert "serves" in second.stderr
    assert "already" in second.stderr
    assert service.http.get("/healthz").status_code == 200
