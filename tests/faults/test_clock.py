"""The clock of a host jumps: by an hour and back while jobs run and bytes come in, and by months."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.objects.store import Objects
from tests.end_to_end.conftest import serving
from tests.faults.conftest import check
from tests.parts.rig import Row, stored
from tests.parts.waiting import until
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

FAKETIME = "faketime/libfaketimeMT.so.1"
"""A library that makes up the time for a process, of the package faketime."""

pytestmark = pytest.mark.timeout(7200)


@pytest.fixture
def faketime() -> Path:
    found = sorted(Path("/usr/lib").glob(f"*/{FAKETIME}"))
    if not found:
        pytest.skip("the clock can't be set for a process: install Debian's package faketime")
    return found[0]


class Clock:
    """The clock of the processes that have this environment; elapsed time goes on evenly."""

    def __init__(self, library: Path, file: Path) -> None:
        self._file = file
        self.environment = {
            "LD_PRELOAD": str(library),
            "FAKETIME_TIMESTAMP_FILE": str(file),
            "FAKETIME_CACHE_DURATION": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }
        self.jump(0)

    def jump(self, hours: float) -> None:
        """Set the clock that far ahead of the true one."""
        new = self._file.with_suffix(".new")
        new.write_text(f"{hours * 3600:+.0f}\n")
        new.replace(self._file)


def filmed(archive: Path, width: int, height: int) -> Path:
    """Write a capture of a glass ball with that many pixels."""
    monitor = 256, 192
    scene = glass_ball.glass_ball(width, height, monitor=monitor, rays=4)
    write_capture(scene, preset("sketch", *monitor), archive)
    return archive


@pytest.mark.slow
def test_jobs_and_upload_go_on_when_the_clock_jumps(tmp_path: Path, faketime: Path, table: list[Row]) -> None:
    clock = Clock(faketime, tmp_path / "offset")
    row = Row("clock an hour forward and back")
    archive = filmed(tmp_path / "ball.zip", 32, 24)
    content = archive.read_bytes()
    middle = len(content) // 2
    with serving(tmp_path / "data", **clock.environment) as service:
        objects = Objects((tmp_path / "data" / "store").as_uri())
        capture = service.client.upload(archive)["id"]
        first = service.client.wait(service.client.recover(capture, tile=16)["id"])
        expected = stored(objects, f"mattes/{first['matte']}")
        jobs: list[str] = []

        def body() -> Iterator[bytes]:
            for hours, part in ((1, content[:middle]), (0, content[middle:])):
                jobs.append(service.client.recover(capture, tile=16)["id"])
                yield part
                clock.jump(hours)
                row.injected += 1
                time.sleep(4)  # the service looks at its clock

        headers = {"Content-Type": "application/zip", "Content-Length": str(len(content))}
        answer = service.http.post("/v1/captures", content=body(), headers=headers)
        assert answer.status_code == 201, answer.text
        began = time.monotonic()
        for job in (answer.json()["job"], *jobs):
            while (found := service.client.job(job))["state"] in ("queued", "running"):
                assert time.monotonic() - began < 400
                assert min(found["queued_seconds"], found["run_seconds"], found["eta_seconds"] or 0) >= 0
                time.sleep(0.1)
            row.lost += found["state"] != "succeeded"
            if found["kind"] == "recover":
                row.differing += stored(objects, f"mattes/{found['matte']}") != expected
        row.seconds.append(time.monotonic() - began)
    check(table, row)


@pytest.mark.exhaustive
def test_captures_expire_month_by_month(tmp_path: Path, faketime: Path) -> None:
    clock = Clock(faketime, tmp_path / "offset")
    archive = filmed(tmp_path / "ball.zip", 16, 12)
    kept = {f"ENVMATTE_{what}_SECONDS": str(30 * 86400) for what in ("CAPTURE", "MATTE", "JOB")}
    with serving(tmp_path / "data", "--workers", "1", **kept, **clock.environment) as service:
        for month in range(12):
            capture = service.client.upload(archive)
            service.client.wait(capture["job"])
            service.client.wait(service.client.recover(capture["id"])["id"])
            assert service.stored()
            clock.jump((month + 1) * 31 * 24)
            until(lambda: not service.stored(), 30)
        for what in ("captures", "mattes", "jobs"):
            until(lambda what=what: service.http.get(f"/v1/{what}").json()[what] == [], 120)
        assert "ERROR" not in service.log()
