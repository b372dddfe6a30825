"""Verification of an installation: what is reported, and what is not."""

import os
import re
import time
from pathlib import Path

import pytest
from sqlalchemy import Engine, delete

from storage.database import tables as database_tables
from storage.database.engine import writing
from storage.maintenance.integrity import Finding
from storage.maintenance.verify import Report, verify
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes
from tests.storage.installation import contents

NOT_READ = re.compile(r"mattes/r/|captures/i/|composites/w/")
"""Items that are being written, which are skipped."""


def found(report: Report) -> set[tuple[str, str]]:
    return {(one.what, one.object) for one in report.findings}


def test_intact_installation_has_no_findings(engine: Engine, filled: Objects) -> None:
    progress: list[tuple[float, int]] = []
    report = verify(engine, filled, lambda *how: progress.append(how))
    assert report.findings == []
    read = {path: data for path, data in contents(filled).items() if not NOT_READ.match(path)}
    assert report.read == {
        "objects": len(read),
        "bytes": sum(map(len, read.values())),
        "unchecked": 0,
        "unchecked_bytes": 0,
    }
    assert (report.things, report.busy) == (7, 3)
    assert progress[-1] == (1.0, report.read["bytes"])


def test_data_deleted_meanwhile_is_not_reported(engine: Engine, filled: Objects) -> None:
    def meanwhile(share: float, size: int) -> None:
        with writing(engine) as c:
            captures.delete(c, "c")
            mattes.delete(c, "m")
            c.execute(delete(database_tables.jobs).where(database_tables.jobs.c.id == "v"))
        for folder in ("captures/c", "mattes/m", "composites/v"):
            filled.delete(folder)

    assert verify(engine, filled, meanwhile).findings == []


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_items_that_change_meanwhile_are_not_reported(engine: Engine, filled: Objects) -> None:
    filled.delete("uploads/i")

    def meanwhile(share: float, size: int) -> None:
        with writing(engine) as c:  # the ingest ends, and its archive is no longer needed
            captures.change(c, "i", state="failed", problem={"status": 409})
            jobs.end(c, "ii", "cancelled")

    assert verify(engine, filled, meanwhile).findings == []


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_object_that_is_written_meanwhile_is_not_reported(engine: Engine, filled: Objects) -> None:
    path = "mattes/m/S/c/1/2/0"
    data = filled.read_raw(path)
    filled.delete(path)

    def meanwhile(share: float, size: int) -> None:
        if share == 1:  # and it was missing
            filled.write_raw(path, [data])

    assert verify(engine, filled, meanwhile).findings == []


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_old_objects_without_a_row_are_reported(engine: Engine, filled: Objects, folder: Path) -> None:
    filled.put("mattes/unknown/S/c/0", b"any")
    filled.put("uploads/unknown/all.part", b"any")
    filled.put("mattes/m/T/7.7/cell/c/9", b"any")
    long_ago = time.time() - 7200
    for path in (folder / "mattes/unknown", *(folder / "mattes/unknown").rglob("*")):
        os.utime(path, (long_ago, long_ago))
    report = verify(engine, filled)
    assert {("unexpected", "mattes/unknown")} == {one for one in found(report) if one[0] == "unexpected"}
    assert Finding(
        "unexpected", "mattes/unknown", "no row refers to it; a running service removes it within an hour"
    ) in (report.findings)
    assert {path for what, path in found(report) if what == "missing"} == {
        "mattes/m/T/7.7/zarr.json",
        "mattes/m/T/7.7/cell/zarr.json",
    }
    filled.delete("mattes/m/T/7.7")
    filled.delete("mattes/unknown")
    filled.put("mattes/m/S/note", b"any")
    assert found(verify(engine, filled)) == {
        ("unexpected", "mattes/m/S/note"),
        ("unexpected", "mattes/m/S/note.crc32c"),
    }
