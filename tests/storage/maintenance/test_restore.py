"""Restoring a backup: into other databases and stores, completely or not at all."""

import hashlib
import json
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Engine, PoolProxiedConnection, func, select, text, update

from storage.database import dialects, migrations
from storage.database import tables as database_tables
from storage.database.engine import open_engine, reading, writing
from storage.database.revision import NEWEST, revision
from storage.errors import Conflict, InvalidInput, NoRoom, Unavailable
from storage.maintenance import row_dump
from storage.maintenance.backup import LEDGER, MANIFEST, back_up
from storage.maintenance.restore import MARKER, restore
from storage.maintenance.row_dump import open_without_upgrade
from storage.maintenance.verify import verify
from storage.objects.store import Objects
from storage.records import jobs, leases, tiles
from tests.parts.disks import small_disk
from tests.storage.installation import contents, fill, flip

KILLED = """
import os, sys
from storage.database import dialects
from storage.objects.store import Objects
from storage.maintenance.restore import restore
source, database, store = sys.argv[1:]
restore(Objects(source), dialects.make_engine(database), Objects(store), lambda share, size: os._exit(9))
"""


def rows_of(engine: Engine) -> list[str]:
    """All rows as a backup would have them, running jobs as they are restored: queued."""
    with reading(engine) as c:
        lines = [list(line) for line in row_dump.lines(c, row_dump.tables_of(c))]
    for name, row in lines:
        if name == "jobs" and row["state"] == "running":
            row |= {"state": "queued", "stage": "waiting"}
    return sorted(json.dumps(line, sort_keys=True) for line in lines)


def require_empty(engine: Engine, objects: Objects) -> None:
    """Check that an installation is empty."""
    with reading(engine) as c:
        assert row_dump.counts(c, row_dump.tables_of(c)) == {}
    assert contents(objects) == {}


def lines_of(target: Objects, name: str = MANIFEST) -> list[bytes]:
    return target.read_raw(name).splitlines(keepends=True)


def sealed(target: Objects, lines: list[bytes]) -> None:
    """Write a manifest whose last line matches the others."""
    entries = [json.loads(line) for line in lines[1:-1]]
    digest = hashlib.sha256(b"".join(lines[:-1])).hexdigest()
    last = {"objects": len(entries), "bytes": sum(one["size"] for one in entries), "sha256": digest}
    target.write_raw(MANIFEST, iter([*lines[:-1], json.dumps(last).encode()]))


def replace_rows(target: Objects, manifest: list[bytes], rows: list[bytes]) -> None:
    """Write other rows into a backup, and a manifest that matches them."""
    data = b"".join(rows)
    target.write_raw(LEDGER, iter([data]))
    lines = list(manifest)
    change(0, ledger={"size": len(data), "sha256": hashlib.sha256(data).hexdigest()})(lines)
    sealed(target, lines)


@pytest.mark.slow
@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_from_sqlite_and_folder_to_postgresql_and_bucket_and_back(
    engine: Engine,
    objects: Objects,
    folder: Path,
    s3: str,
    postgresql: str,
    elsewhere: tuple[Engine, Objects],
) -> None:
    fill(engine, objects)
    there, bucket = Objects(f"{s3}/backup"), Objects(f"{s3}/store")
    progress: list[tuple[float, int]] = []
    made = back_up(engine, objects, there, "1.2.3", lambda *how: progress.append(how))
    assert progress[-1] == (1.0, made["bytes"])
    assert made["bytes"] == sum(map(len, contents(objects).values()))
    header = json.loads(lines_of(there)[0])
    assert (header["version"], header["revision"]) == ("1.2.3", NEWEST)
    second = dialects.make_engine(postgresql)
    assert restore(there, second, bucket) == made
    assert rows_of(second) == rows_of(engine)
    assert contents(bucket) == contents(objects)
    assert bucket.names("") == ["captures", "composites", "mattes", "uploads"]
    assert verify(second, bucket).findings == []
    with writing(second) as c:  # new rows continue the numbers
        number = c.scalar(select(func.max(database_tables.jobs.c.number)))
        assert jobs.get(c, jobs.add(c, "ingest", "n", {})).number == number + 1
        jobs.cancel(
            c, c.scalar(select(database_tables.jobs.c.id).where(database_tables.jobs.c.capture == "n"))
        )
    back = Objects((folder.parent / "back").as_uri())
    again = back_up(second, bucket, back, "1.2.3")
    assert again["objects"] == made["objects"]
    restore(back, *elsewhere)
    assert rows_of(elsewhere[0]) == rows_of(second)
    assert contents(elsewhere[1]) == contents(objects)
    second.dispose()
    with reading(elsewhere[0]) as c:
        row = jobs.get(c, "rr")
        assert (row.state, row.done, tiles.remaining(c, "rr")) == ("queued", 2, [2, 3, 4, 5])
        tables = row_dump.tables_of(c)
        for name in row_dump.SKIPPED:  # the lease, and deliveries of the first service
            assert c.scalar(select(func.count()).select_from(tables[name])) == 0
    with reading(engine) as c:
        assert c.scalar(select(func.count()).select_from(database_tables.deliveries)) == 1


@pytest.mark.slow
def test_only_into_empty_targets(
    engine: Engine, filled: Objects, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    with pytest.raises(
        Conflict, match=r"has no manifest\.jsonl: there is no backup, or it was never finished"
    ):
        restore(target, *elsewhere)
    back_up(engine, filled, target, "1")
    with pytest.raises(Conflict, match="already has a backup; name an empty folder"):
        back_up(engine, filled, target, "1")
    target.delete(MANIFEST)
    with pytest.raises(Conflict, match=r"is not empty: it has 'ledger\.jsonl'"):
        back_up(engine, filled, target, "1")
    for what in (LEDGER, "objects"):
        target.delete(what)
    back_up(engine, filled, target, "1")
    with pytest.raises(Conflict, match=r"not empty: its database has rows \(.*2 of captures.*name another"):
        restore(target, engine, elsewhere[1])
    with pytest.raises(Conflict, match=r"not empty: its store .* has captures/c\."):
        restore(target, elsewhere[0], filled)
    used = open_engine(elsewhere[0].url.render_as_string(hide_password=False))
    with writing(used) as c:
        leases.acquire(c, "somebody")
    with pytest.raises(Conflict, match="a service runs on the installation; stop it"):
        restore(target, *elsewhere)
    with writing(used) as c:  # as when it was killed
        c.execute(update(database_tables.coordinator).values(expires_at=0))
    restore(target, *elsewhere)
    used.dispose()


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_backup_larger_than_the_disk_is_refused(
    engine: Engine, filled: Objects, folder: Path, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    size = back_up(engine, filled, target, "1")["bytes"]
    with small_disk(folder.parent / "disk", 1 << 20) as disk:
        store = Objects(disk.as_uri())
        with pytest.raises(
            NoRoom, match=rf"the backup has {size} bytes, but the disk of the store only \d+ free"
        ):
            restore(target, elsewhere[0], store)
        require_empty(elsewhere[0], store)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_rows_that_are_added_meanwhile_are_kept(
    engine: Engine, filled: Objects, folder: Path, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    back_up(engine, filled, target, "1")
    url = elsewhere[0].url.render_as_string(hide_password=False)

    def meanwhile(share: float, size: int) -> None:
        used = open_engine(url)
        with writing(used) as c:
            if not jobs.to_run(c):
                jobs.add(c, "ingest", "new", {}, job="added")
        used.dispose()

    with pytest.raises(Conflict, match=r"its database has rows \(1 of jobs"):
        restore(target, *elsewhere, meanwhile)
    with reading(elsewhere[0]) as c:
        assert [row.id for row in jobs.to_run(c)] == ["added"]


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_restore_whose_commit_is_not_confirmed_keeps_its_objects(
    engine: Engine,
    filled: Objects,
    folder: Path,
    target: Objects,
    elsewhere: tuple[Engine, Objects],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    back_up(engine, filled, target, "1")
    second, store = elsewhere
    broken = sqlite3.OperationalError()
    broken.sqlite_errorcode = sqlite3.SQLITE_IOERR
    commit, breaks = second.dialect.do_commit, [broken]

    def do_commit(connection: PoolProxiedConnection) -> None:
        commit(connection)
        if breaks:
            raise breaks.pop()

    monkeypatch.setattr(second.dialect, "do_commit", do_commit)
    with pytest.raises(Unavailable):
        restore(target, second, store)
    assert rows_of(second) == rows_of(engine)
    assert contents(store) == contents(filled)


def change(index: int, **values: Any) -> Callable[[list[bytes]], None]:
    def apply(lines: list[bytes]) -> None:
        lines[index] = json.dumps(json.loads(lines[index]) | values).encode() + b"\n"

    return apply


INVALID: dict[str, tuple[str, Callable[[list[bytes]], None]]] = {
    "cut": ("is incomplete or was changed", lambda lines: lines.__delitem__(slice(5, None))),
    "half a line": ("is incomplete or was changed", lambda lines: lines.__setitem__(-1, lines[-1][:30])),
    "one less": ("is incomplete or was changed", lambda lines: lines.__delitem__(4)),
    "empty": ("is incomplete or was changed", lambda lines: lines.clear()),
    "format": ("the format 'x', but this envmatte reads", change(0, format="x")),
    "revision": (
        "the backup was written by a newer envmatte: it has revision 9999",
        change(0, revision="9999"),
    ),
}
INVALID_BUT_SEALED: dict[str, tuple[str, Callable[[list[bytes]], None]]] = {
    "above": ("has the invalid object name 'captures/../../x'", change(3, name="captures/../../x")),
    "root": ("has the invalid object name '/etc/x'", change(3, name="/etc/x")),
    "elsewhere": ("has the invalid object name 'certs/ca.pem'", change(3, name="certs/ca.pem")),
    "hidden": ("has the invalid object name 'captures/c/.x'", change(3, name="captures/c/.x")),
    "number": ("has the invalid object name 3", change(3, name=3)),
    "not there": ("captures/c/none is missing in the backup", change(3, name="captures/c/none")),
    "checksum": ("does not match manifest.jsonl: it is damaged", change(3, sha256="0" * 64)),
    "no checksum": ("no valid size and checksum for", change(3, sha256="x")),
    "ledger": (
        "ledger.jsonl in the backup does not match",
        change(0, ledger={"size": 1, "sha256": "0" * 64}),
    ),
}


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_invalid_backup_is_refused_and_leaves_nothing(
    engine: Engine, filled: Objects, folder: Path, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    back_up(engine, filled, target, "1")
    whole = lines_of(target)
    for cases, seal in ((INVALID, False), (INVALID_BUT_SEALED, True)):
        for match, apply in cases.values():
            lines = list(whole)
            apply(lines)
            sealed(target, lines) if seal else target.write_raw(MANIFEST, iter(lines))
            with pytest.raises((InvalidInput, Conflict), match=match):
                restore(target, *elsewhere)
            require_empty(*elsewhere)
    target.write_raw(MANIFEST, iter(whole))
    for path in ("objects/mattes/m/rho/c/0/0/0", LEDGER):
        flip(target, path)
        with pytest.raises(InvalidInput, match=r"does not match manifest\.jsonl: it is damaged"):
            restore(target, *elsewhere)
        require_empty(*elsewhere)
        flip(target, path)
    rows = lines_of(target, LEDGER)
    for row, match in (
        (b'["alembic_version",{"version_num":"x"}]\n', "table 'alembic_version'"),
        (b'["coordinator",{"id":1}]\n', "table 'coordinator'"),
        (b'["jobs",{"id":1}]\n', "a row of jobs with unexpected columns"),
        (b"[1]\n", "a line that is not a row"),
        (b"[" * 100_000, "a line that is not a row"),
    ):
        replace_rows(target, whole, [*rows, row])
        with pytest.raises(InvalidInput, match=match):
            restore(target, *elsewhere)
        require_empty(*elsewhere)
    target.write_raw(LEDGER, iter(rows))
    target.write_raw(MANIFEST, iter(whole))
    restore(target, *elsewhere)
    assert rows_of(elsewhere[0]) == rows_of(engine)
    assert contents(elsewhere[1]) == contents(filled)


HOSTILE: tuple[tuple[str, str, Any], ...] = (
    ("mattes", "id", "../../../victim"),
    ("mattes", "id", ""),
    ("mattes", "id", ".."),
    ("mattes", "id", 7),
    ("mattes", "capture", "a/b"),
    ("jobs", "matte", "x" * 65),
    ("jobs", "kind", "shell"),
    ("jobs", "state", "done"),
    ("jobs", "created_at", 1e300),
    ("jobs", "finished_at", float("nan")),
    ("captures", "created_at", "soon"),
    ("captures", "bytes", 1 << 70),
    ("captures", "frames", 1.5),
    ("captures", "name", None),
    ("tiles", "attempts", True),
    ("tiles", "job", "../x"),
)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize(
    "hostile", [HOSTILE[:1], pytest.param(HOSTILE[1:], marks=pytest.mark.slow)], ids=["one", "others"]
)
def test_row_that_the_service_would_stumble_over_is_refused(
    hostile: tuple[tuple[str, str, Any], ...],
    folder: Path,
    engine: Engine,
    filled: Objects,
    target: Objects,
    elsewhere: tuple[Engine, Objects],
) -> None:
    back_up(engine, filled, target, "1")
    whole, lines = lines_of(target), lines_of(target, LEDGER)
    for table, column, value in hostile:
        rows = [json.loads(line) for line in lines]
        row = next(row for name, row in rows if name == table)
        row[column] = value
        replace_rows(target, whole, [json.dumps(line).encode() + b"\n" for line in rows])
        with pytest.raises(InvalidInput, match=f"a row of {table} with an invalid {column}"):
            restore(target, *elsewhere)
        require_empty(*elsewhere)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.slow
def test_killed_restore_can_be_repeated(
    engine: Engine, filled: Objects, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    back_up(engine, filled, target, "1")
    second, store = elsewhere
    where = [target.url, second.url.render_as_string(), store.url]
    killed = subprocess.run([sys.executable, "-c", KILLED, *where], timeout=120)
    assert killed.returncode == 9
    assert contents(store)
    assert MARKER in store.names("")
    store.put("mattes/x/left", b"of the first")
    other = dialects.make_engine(f"{second.url.render_as_string()}.other")
    # Its objects may belong to the first database.
    with pytest.raises(Conflict, match=r"its store .* has \w+/"):
        restore(target, other, store)
    other.dispose()
    restore(target, second, store)
    assert contents(store) == contents(filled)
    assert MARKER not in store.names("")


def test_backup_of_earlier_revision_is_upgraded(
    tmp_path: Path, objects: Objects, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    url = f"sqlite:///{tmp_path}/old.db"
    old = dialects.make_engine(url)
    with writing(old) as c:
        migrations.upgrade(c, "0004")
        c.execute(
            text(
                "INSERT INTO jobs VALUES (7, 'j', 'recover', 'running', 'recovering', 'c', 'm', '{}', "
                "'{\"tiles\": 2}', 2, 1, 0, 10, NULL, 1000.5, 1001.5, NULL, NULL, NULL, NULL, 0, NULL)"
            )
        )
        c.execute(
            text("INSERT INTO tiles VALUES ('j', 0, 'done', 1, 0.5, 0), ('j', 1, 'queued', 2, NULL, 0)")
        )
        c.execute(text("INSERT INTO uploads VALUES ('u', NULL, 1, 2, 1, '', 1000.5, 9e9)"))
        c.execute(text("INSERT INTO upload_parts VALUES ('u', 0, 'p', 1)"))
    old.dispose()
    objects.write_raw("uploads/u/p.part", iter([b"x"]))
    opened = open_without_upgrade(url)
    back_up(opened, objects, target, "1")
    with reading(opened) as c:
        assert revision(c) == "0004"  # backing up does not upgrade
    opened.dispose()
    restore(target, *elsewhere)
    with reading(elsewhere[0]) as c:
        assert revision(c) == NEWEST
        row = jobs.get(c, "j")
        assert (row.state, row.stage, row.problem, row.owner) == ("queued", "waiting", None, "default")
        assert tiles.remaining(c, "j") == [1]
        assert (
            c.scalar(select(database_tables.jobs.c.id).where(database_tables.jobs.c.problem.is_(None))) == "j"
        )
        assert c.execute(select(database_tables.upload_parts)).all() == [("u", 0, "p", 1)]
    assert verify(*elsewhere).read["unchecked"] == 1
