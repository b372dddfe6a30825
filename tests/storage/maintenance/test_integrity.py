"""Integrity checks: flipped bits and lost objects are found."""

import re
from pathlib import Path

import pytest
from sqlalchemy import Engine

from storage.database.engine import writing
from storage.maintenance.verify import verify
from storage.objects.store import Objects
from storage.records import mattes
from tests.storage.installation import contents, flip
from tests.storage.maintenance.test_verify import NOT_READ, found


@pytest.mark.slow
@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_flipped_bit_of_any_object_is_found(engine: Engine, filled: Objects) -> None:
    paths = [path for path in contents(filled) if not NOT_READ.match(path)]
    kinds: dict[str, str] = {}
    for path in paths:
        kinds.setdefault(re.sub(r"\d+", "0", path), path)
    assert len(kinds) > 50
    documents = {path for path in paths if path.endswith(".json")}
    plain = {path for path in paths if not path.startswith(("captures", "mattes"))}
    tables = {path for path in plain if path.endswith(".crc32c")}
    index = {"uploads/i/parts.json.crc32c"}  # without it the parts are not known
    # Chunks are not checked if their zarr.json or index is damaged, nor bytes if their table of checksums is.
    for some in (set(paths) - documents - tables, documents, tables - index, index):
        for path in some:
            flip(filled, path)
        assert found(verify(engine, filled)) == {("damaged", path) for path in some}
        for path in some:
            flip(filled, path)
    assert verify(engine, filled).findings == []


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize(
    "path",
    [
        *("captures/c/zarr.json", "captures/c/frames/zarr.json", "captures/c/measured/zarr.json"),
        *("captures/c/mask/zarr.json", "captures/c/images/zarr.json", "captures/c/frames/c/0/0/0/0"),
        *("mattes/m/zarr.json", "mattes/m/T/zarr.json", "mattes/m/T/1.2/zarr.json", "mattes/m/error/c/1/2"),
        *("mattes/m/T/1.2/cell/zarr.json", "mattes/m/T/1.2/cell/c/0", "mattes/m/live-1/c/0"),
        *("uploads/i/parts.json", "uploads/i/all.part", "uploads/u/q.part", "composites/v/video.mp4"),
    ],
)
def test_missing_object_is_found(engine: Engine, filled: Objects, folder: Path, path: str) -> None:
    (folder / path).unlink()
    report = verify(engine, filled)
    assert ("missing", path) in found(report)
    assert {what for what, _ in found(report)} == {"missing"}
    assert all(("again" in one.remedy) for one in report.findings)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_missing_item_is_found(engine: Engine, filled: Objects) -> None:
    for folder in ("captures/c", "mattes/m", "uploads/u", "composites/v"):
        filled.delete(folder)
    missing = {path for what, path in found(verify(engine, filled)) if what == "missing"}
    assert {"captures/c/frames/zarr.json", "mattes/m/S/zarr.json", "uploads/u/p.part"} <= missing
    assert "composites/v/video.mp4" in missing


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_only_damage_counts_of_what_a_failed_job_left(engine: Engine, filled: Objects) -> None:
    with writing(engine) as c:
        mattes.change(c, "m", state="failed")
    filled.delete("mattes/m/S/c/0/0/0")
    flip(filled, "mattes/m/S/c/1/2/0")
    assert found(verify(engine, filled)) == {("damaged", "mattes/m/S/c/1/2/0")}


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_objects_without_checksum_are_counted(engine: Engine, filled: Objects) -> None:
    filled.delete("composites/v/video.mp4.crc32c")
    report = verify(engine, filled)
    assert (report.findings, report.read["unchecked"], report.read["unchecked_bytes"]) == ([], 1, 5000)
