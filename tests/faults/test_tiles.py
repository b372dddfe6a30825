"""A tile that kills its workers fails its own job after some attempts, and no other."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from distributed import Client

from services.coordinator.job_run import LOSSES
from tests.faults.conftest import Prepared, check
from tests.parts.background import repeating
from tests.parts.rig import Rig, Row
from tests.services.cluster.clusters import listening

pytestmark = pytest.mark.timeout(900)

TILE, LAST = 64, 5
"""The edge of the tiles, and the index of the one in the corner."""


@contextmanager
def killing_workers(rig: Rig, key: str) -> Iterator[None]:
    """Kill every worker that works on a tile until the block ends."""

    def kill() -> None:
        keys = [one for held in client.processing().values() for one in held if one.startswith(key)]
        # A worker has a call stack for what it runs, and none for what is queued there.
        for address in client.call_stack(keys=keys) if keys else ():
            for process in rig.workers():
                if urlsplit(address).port in {port for _, port in listening(process)}:
                    process.kill()

    with Client(rig.cluster, set_as_default=False) as client, repeating(kill, 0.1):
        yield


@pytest.mark.exhaustive
def test_tile_that_kills_its_workers_fails_only_its_job(
    prepared: Prepared, table: list[Row], archive_bytes: bytes
) -> None:
    rig = prepared.rig
    headers = {"Content-Type": "application/zip"}
    capture = rig.ask("POST", "/v1/captures", content=archive_bytes, headers=headers).json()
    assert rig.ended(capture["job"])["state"] == "succeeded"
    # Readers of this chunk wait for ever. It belongs to the corner, which no other tile needs.
    folder = rig.folder / "store" / "captures" / capture["id"] / "frames" / "c" / "0"
    lowest = max(folder.iterdir(), key=lambda path: int(path.name))
    chunk = max(lowest.iterdir(), key=lambda path: int(path.name)) / "0"
    kept = chunk.rename(rig.folder / "kept")
    os.mkfifo(chunk)
    body = {"capture": capture["id"], "options": {"tile": TILE}}
    job = rig.ask("POST", "/v1/jobs", json=body).json()
    start = time.monotonic()
    with killing_workers(rig, f"recover-{job['id']}-{LAST}-"):
        other = rig.recover(prepared.capture)
        found, beside = rig.ended(job["id"]), rig.ended(other["id"])
    assert found["state"] == "failed"
    assert f"{LOSSES} workers died while doing it" in found["problem"]["detail"]
    lines = lines_of(rig, job["id"])
    assert {line.split(",")[0] for line in lines if ", loss " in line} == {f"tile {LAST}"}, lines
    assert beside["state"] == "succeeded"
    assert not [line for line in lines_of(rig, other["id"]) if ", loss " in line or ", attempt " in line]
    chunk.unlink()
    kept.rename(chunk)
    assert rig.ask("POST", f"/v1/jobs/{job['id']}/retry").status_code == 202
    row = Row("a tile that kills its workers", 1, lost=int(rig.ended(job["id"])["state"] != "succeeded"))
    row.seconds.append(round(time.monotonic() - start, 2))
    row.differing = sum(rig.files(made["matte"]) != prepared.files for made in (job, other))
    check(table, row)


def lines_of(rig: Rig, job: str) -> list[str]:
    return [line["text"] for line in rig.ask("GET", f"/v1/jobs/{job}/log").json()["lines"]]
