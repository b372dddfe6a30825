"""Expiry of captures and mattes in a real service, measured on disk."""

import os
import time
from contextlib import suppress
from pathlib import Path

import pytest

from storage.database.rows import ROW
from tests.end_to_end.conftest import Service, paused, serving
from tests.end_to_end.problems import check_problem
from tests.parts.waiting import until


def disk(service: Service) -> int:
    """Bytes in the store. Files may be deleted meanwhile; `os.walk` skips folders that are gone."""
    used = 0
    for folder, _, names in os.walk(service.data / "store"):
        for name in names:
            with suppress(FileNotFoundError):
                used += Path(folder, name).stat().st_size
    return used


@pytest.mark.slow
def test_expired_data_is_deleted_unless_a_job_needs_it(capture_archive: Path, tmp_path: Path) -> None:
    """Both expire long before the recovery begins, and it still succeeds."""
    with serving(
        tmp_path / "data", "--workers", "1", ENVMATTE_CAPTURE_SECONDS="1", ENVMATTE_MATTE_SECONDS="1"
    ) as service:
        before = disk(service)
        with paused(service):
            capture = service.client.upload(capture_archive)
            job = service.client.recover(capture["id"])
            time.sleep(4)  # the second of its lifetime, and the two between checks of the coordinator
            found = service.client.capture(capture["id"])
            assert found["expires_at"] > found["created_at"]
            assert disk(service) - before >= capture_archive.stat().st_size
        assert service.client.wait(job["id"])["state"] == "succeeded"
        for url in (f"/v1/captures/{capture['id']}", f"/v1/mattes/{job['matte']}"):
            until(lambda url=url: service.http.get(url).status_code == 404)
            check_problem(service.http.get(url), 404, "not-found")
        until(lambda: disk(service) <= before)
        assert service.client.job(job["id"])["state"] == "succeeded"  # its record stays, and counts
        assert 2 * ROW <= service.used()["owner_bytes"] < 5 * ROW
        for one in (job["id"], capture["job"]):
            assert service.http.delete(f"/v1/jobs/{one}").status_code == 204
        assert service.used() == {"owner_captures": 0, "owner_jobs": 0, "owner_bytes": 0, "store_bytes": 0}


@pytest.mark.exhaustive
def test_deleted_data_leaves_the_disk(capture_archive: Path, tmp_path: Path) -> None:
    with serving(tmp_path / "data", "--workers", "1") as service:
        before = disk(service)
        capture = service.client.upload(capture_archive)
        service.client.wait(capture["job"])
        matte = service.client.wait(service.client.recover(capture["id"])["id"])["matte"]
        deadline = time.monotonic() + 60
        while True:  # until everything is counted, which happens after the job's end
            stored = service.used()["owner_bytes"]
            # The rest are rows, and the zarr.json of folders.
            if disk(service) - before - stored in range(-8 * ROW, 2000):
                break
            assert time.monotonic() < deadline, (stored, disk(service) - before)
            time.sleep(0.1)
        for url in (f"/v1/mattes/{matte}", f"/v1/captures/{capture['id']}"):
            assert service.http.delete(url).status_code == 204
        assert disk(service) - before in range(2000)
        assert service.used()["owner_bytes"] < 5 * ROW  # of the jobs
