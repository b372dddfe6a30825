"""A tile that kills whoever works on it ends its own job, after so many, and no other."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from distributed import Client

from services.drive import LOSSES
from tests.faults.conftest import Known, check
from tests.faults.rig import Rig, Row
from tests.services.clusters import listening

pytestmark = [pytest.mark.full, pytest.mark.timeout(900)]

TILE, LAST = 64, 5
"""The edge of the tiles, and the number of the one in the corner."""


@contextmanager
def deadly(rig: Rig, key: str) -> Iterator[None]:
    """Kill every worker that works on a tile, while this lasts."""
    done = threading.Event()

    def watch() -> None:
        with Client(rig.cluster, set_as_default=False) as client:
            while not done.wait(0.1):
                keys = [one for held in client.processing().values() for one in held if one.startswith(key)]
                # A worker has a stack to show of what it works on, and none of what waits there.
                for address in client.call_stack(keys=keys) if keys else ():
                    for process in rig.workers():
                        if urlsplit(address).port in {port for _, port in listening(process)}:
                            process.kill()

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def test_a_tile_that_kills_its_workers(known: Known, table: list[Row], bundle_bytes: bytes) -> None:
    rig = known.rig
    headers = {"Content-Type": "application/zip"}
    capture = rig.ask("POST", "/v1/captures", content=bundle_bytes, headers=headers).json()
    assert rig.ended(capture["job"])["state"] == "succeeded"
    # A chunk that whoever reads it waits for, for ever: of the corner, which no other tile needs.
    folder = rig.folder / "store" / "captures" / capture["id"] / "frames" / "c" / "0"
    row = max(folder.iterdir(), key=lambda path: int(path.name))
    chunk = max(row.iterdir(), key=lambda path: int(path.name)) / "0"
    kept = chunk.rename(rig.folder / "kept")
    os.mkfifo(chunk)
    asked = {"capture": capture["id"], "options": {"tile": TILE}}
    job = rig.ask("POST", "/v1/jobs", json=asked).json()
    with deadly(rig, f"recover-{job['id']}-{LAST}-"):
        other = known.disturb("a tile that kills its workers", lambda: None, 1)
        found = rig.ended(job["id"])
    assert found["state"] == "failed"
    assert f"{LOSSES} workers that did it died" in found["problem"]["detail"]
    lines = [line["text"] for line in rig.ask("GET", f"/v1/jobs/{job['id']}/log").json()["lines"]]
    assert {line.split(",")[0] for line in lines if ", loss " in line} == {f"tile {LAST}"}, lines
    chunk.unlink()
    kept.rename(chunk)
    assert rig.ask("POST", f"/v1/jobs/{job['id']}/retry").status_code == 202
    assert rig.ended(job["id"])["state"] == "succeeded"
    other.differing += rig.files(job["matte"]) != known.files
    check(table, other)
