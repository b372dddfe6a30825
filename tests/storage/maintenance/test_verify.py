"""A look at everything that is stored: whatever is flipped, lost or left over is found, and nothing else."""

import os
import re
import time
from pathlib import Path

import pytest
from sqlalchemy import Engine, delete

from storage.database import tables as database_tables
from storage.database.engine import open_engine, writing
from storage.errors import Conflict
from storage.maintenance import verify as verifying
from storage.maintenance.integrity import Finding
from storage.maintenance.row_dump import open_without_upgrade
from storage.maintenance.verify import Report, verify
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes
from tests.storage.furnished import contents, flip, furnish

NOT_READ = re.compile(r"mattes/r/|captures/i/|composites/w/")
"""What is being written."""


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verifying, "RECHECK_AFTER", 0.0)


@pytest.fixture
def furnished(engine: Engine, objects: Objects) -> Objects:
    furnish(engine, objects)
    return objects


def found(report: Report) -> set[tuple[str, str]]:
    return {(one.what, one.object) for one in report.findings}


def test_all_is_as_it_was_written(engine: Engine, furnished: Objects) -> None:
    told: list[tuple[float, int]] = []
    report = verify(engine, furnished, lambda *how: told.append(how))
    assert report.findings == []
    read = {path: data for path, data in contents(furnished).items() if not NOT_READ.match(path)}
    assert report.read == {
        "objects": len(read),
        "bytes": sum(map(len, read.values())),
        "unchecked": 0,
        "unchecked_bytes": 0,
    }
    assert (report.things, report.busy) == (7, 3)
    assert told[-1] == (1.0, report.read["bytes"])


@pytest.mark.slow
@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_a_bit_of_any_object_is_found(engine: Engine, furnished: Objects) -> None:
    paths = [path for path in contents(furnished) if not NOT_READ.match(path)]
    kinds: dict[str, str] = {}
    for path in paths:
        kinds.setdefault(re.sub(r"\d+", "0", path), path)
    assert len(kinds) > 50
    documents = {path for path in paths if path.endswith(".json")}
    plain = {path for path in paths if not path.startswith(("captures", "mattes"))}
    tables = {path for path in plain if path.endswith(".crc32c")}
    index = {"uploads/i/parts.json.crc32c"}  # without which its parts are not known either
    # Without its zarr.json, or index, an array's chunks are not looked for, nor bytes without their checksums.
    for some in (set(paths) - documents - tables, documents, tables - index, index):
        for path in some:
            flip(furnished, path)
        assert found(verify(engine, furnished)) == {("damaged", path) for path in some}
        for path in some:
            flip(furnished, path)
    assert verify(engine, furnished).findings == []


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
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
def test_an_object_that_is_gone_is_found(engine: Engine, furnished: Objects, folder: Path, path: str) -> None:
    (folder / path).unlink()
    report = verify(engine, furnished)
    assert ("missing", path) in found(report)
    assert {what for what, _ in found(report)} == {"missing"}
    assert all(("again" in one.remedy) for one in report.findings)


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_a_whole_thing_that_is_gone_is_found(engine: Engine, furnished: Objects) -> None:
    for folder in ("captures/c", "mattes/m", "uploads/u", "composites/v"):
        furnished.delete(folder)
    missing = {path for what, path in found(verify(engine, furnished)) if what == "missing"}
    assert {"captures/c/frames/zarr.json", "mattes/m/S/zarr.json", "uploads/u/p.part"} <= missing
    assert "composites/v/video.mp4" in missing


def test_what_is_deleted_meanwhile_is_no_finding(engine: Engine, furnished: Objects) -> None:
    def meanwhile(share: float, size: int) -> None:
        with writing(engine) as c:
            captures.delete(c, "c")
            mattes.delete(c, "m")
            c.execute(delete(database_tables.jobs).where(database_tables.jobs.c.id == "v"))
        for folder in ("captures/c", "mattes/m", "composites/v"):
            furnished.delete(folder)

    assert verify(engine, furnished, meanwhile).findings == []


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_what_comes_or_goes_on_meanwhile_is_no_finding(engine: Engine, furnished: Objects) -> None:
    furnished.delete("uploads/i")

    def meanwhile(share: float, size: int) -> None:
        with writing(engine) as c:  # it is ingested, and its archive not needed any more
            captures.change(c, "i", state="failed", problem={"status": 409})
            jobs.end(c, "ii", "cancelled")

    assert verify(engine, furnished, meanwhile).findings == []


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_what_belongs_to_nothing_is_found_once_it_is_old(
    engine: Engine, furnished: Objects, folder: Path
) -> None:
    furnished.put("mattes/nobody/S/c/0", b"any")
    furnished.put("uploads/nobody/all.part", b"any")
    furnished.put("mattes/m/T/7.7/cell/c/9", b"any")
    long_ago = time.time() - 7200
    for path in (folder / "mattes/nobody", *(folder / "mattes/nobody").rglob("*")):
        os.utime(path, (long_ago, long_ago))
    report = verify(engine, furnished)
    assert {("unexpected", "mattes/nobody")} == {one for one in found(report) if one[0] == "unexpected"}
    assert Finding(
        "unexpected", "mattes/nobody", "no row refers to it; a running service removes it within an hour"
    ) in (report.findings)
    assert {path for what, path in found(report) if what == "missing"} == {
        "mattes/m/T/7.7/zarr.json",
        "mattes/m/T/7.7/cell/zarr.json",
    }
    furnished.delete("mattes/m/T/7.7")
    furnished.delete("mattes/nobody")
    furnished.put("mattes/m/S/note", b"any")
    assert found(verify(engine, furnished)) == {
        ("unexpected", "mattes/m/S/note"),
        ("unexpected", "mattes/m/S/note.crc32c"),
    }


@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_what_has_no_checksum_is_counted(engine: Engine, furnished: Objects) -> None:
    furnished.delete("composites/v/video.mp4.crc32c")
    report = verify(engine, furnished)
    assert (report.findings, report.read["unchecked"], report.read["unchecked_bytes"]) == ([], 1, 5000)


def test_a_database_that_is_none_is_refused_and_not_made(tmp_path: Path) -> None:
    with pytest.raises(Conflict, match=r"no database sqlite:.*none\.db; name the service's database"):
        open_without_upgrade(f"sqlite:///{tmp_path}/none.db")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty.db").touch()
    with pytest.raises(Conflict, match="no tables of envmatte"):
        open_without_upgrade(f"sqlite:///{tmp_path}/empty.db")
    open_engine(f"sqlite:///{tmp_path}/some.db").dispose()
    open_without_upgrade(f"sqlite:///{tmp_path}/some.db").dispose()
