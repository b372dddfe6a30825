"""What expires and what is counted, with a real database and a real store."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from sqlalchemy import Connection, Engine, select, update

from services.coordinator import retention
from services.coordinator.retention import (
    count_bytes,
    delete_expired,
    delete_old_jobs,
    sweep,
    sweep_uploads,
)
from storage import installation, statistics
from storage.database import tables
from storage.database.engine import open_engine, reading, writing
from storage.database.owners import for_owner
from storage.database.rows import ROW
from storage.errors import WrongStore
from storage.layout import captures as stored_captures
from storage.layout import composites
from storage.layout import mattes as stored_mattes
from storage.layout import uploads as stored_uploads
from storage.layout.uploads import Part
from storage.objects import marker
from storage.objects.checksums import SUFFIX
from storage.objects.store import Objects
from storage.records import bodies, captures, idempotency, jobs, links, mattes, tiles, uploads


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:
    engine = open_engine(database_url)
    yield engine
    engine.dispose()


def add(engine: Engine, owner: str, name: str, **times: float) -> None:
    """Add a capture and a matte of it, both of one name, with their finished jobs."""
    with writing(for_owner(engine, owner)) as c:
        for kind, job in (("ingest", f"{name}-i"), ("recover", f"{name}-r")):
            jobs.add(c, kind, name, {}, name, job=job)
            jobs.end(c, job, "succeeded")
        captures.add(c, name, f"{name}-i", name="", bytes=10, frames=1, program={}, **times)
        captures.change(c, name, state="ready")
        mattes.add(c, name, name, f"{name}-r", {}, **times)
        mattes.change(c, name, state="ready")


def expire(engine: Engine) -> None:
    """Expire everything that has an expiry time."""
    with writing(engine) as c:
        for table in (tables.captures, tables.mattes):
            c.execute(update(table).where(table.c.expires_at.is_not(None)).values(expires_at=time.time() - 1))


def existing(engine: Engine) -> dict[str, set[str]]:
    with reading(engine) as c:
        return {t.name: set(c.scalars(select(t.c.id))) for t in (tables.captures, tables.mattes)}


def test_only_expired_rows_are_deleted(engine: Engine) -> None:
    add(engine, "alice", "short", seconds=60.0)
    add(engine, "bob", "long", seconds=3600.0)
    add(engine, "bob", "ever")
    with writing(engine) as c:
        assert delete_expired(c) == []
        for table in (tables.captures, tables.mattes):
            row = c.execute(select(table).where(table.c.id == "short")).one()
            assert row.expires_at == row.created_at + 60
            c.execute(update(table).where(table.c.id == "short").values(expires_at=time.time() - 1))
        uploads.add(c, "u", 5, "", -1, None)
        links.create(c, "ever", -1)
    with writing(engine) as c:
        assert delete_expired(c) == ["uploads/u", "captures/short", "uploads/short", "mattes/short"]
        assert c.execute(select(tables.links)).all() == []
    assert existing(engine) == {"captures": {"long", "ever"}, "mattes": {"long", "ever"}}
    with reading(engine) as c:
        assert jobs.get(c, "short-r").state == "succeeded"  # the record of its job stays


def test_expiry_does_not_depend_on_the_clock_of_the_api(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    later = time.time() + 3600
    with monkeypatch.context() as ahead:
        ahead.setattr(time, "time", lambda: later)
        add(engine, "alice", "over", seconds=-1.0)
    with writing(engine) as c:
        assert delete_expired(c) == ["captures/over", "uploads/over", "mattes/over"]


@pytest.mark.parametrize("kind", ["recover", "composite"])
@pytest.mark.parametrize("state", ["queued", "running"])
def test_data_of_an_active_job_does_not_expire(engine: Engine, kind: str, state: str) -> None:
    add(engine, "alice", "used", seconds=60.0)
    with writing(engine) as c:
        job = jobs.add(c, kind, "used", {}, "used")
        jobs.change(c, job, state=state)
    expire(engine)
    of_capture = ["captures/used", "uploads/used"]
    early = of_capture if kind == "composite" else []  # it uses the matte alone
    with writing(engine) as c:
        assert delete_expired(c) == early
    assert existing(engine) == {"captures": set() if early else {"used"}, "mattes": {"used"}}
    with writing(engine) as c:
        jobs.end(c, job, "failed", {"detail": "", "status": 500})
    with writing(engine) as c:
        assert delete_expired(c) == [*([] if early else of_capture), "mattes/used"]


def test_leftovers_of_cancelled_jobs_do_not_expire(engine: Engine, objects: Objects) -> None:
    """Until the coordinator has cleaned up, the states of a matte and its capture say that they are unfinished."""
    with writing(engine) as c:
        job = jobs.add(c, "ingest", "c", {})
        captures.add(c, "c", job, name="", bytes=1, frames=1, program={}, seconds=-1)
        other = jobs.add(c, "recover", "c", {}, "m")
        mattes.add(c, "m", "c", other, {}, -1)
        composite = jobs.add(c, "composite", "c", {}, "m")
        for one in (job, other, composite):
            jobs.cancel(c, one)
        assert delete_expired(c) == []
    age_jobs(engine)
    delete_old_jobs(engine, objects, 60)
    assert listed(engine) == {job, other, composite}


def test_large_backlog_expires_in_parts(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (retention, uploads):
        monkeypatch.setattr(module, "MOST", 2)
    for n in range(3):
        add(engine, "alice", f"old{n}", seconds=60.0)
    expire(engine)
    with writing(engine) as c:
        for n in range(3):
            uploads.add(c, f"u{n}", 5, "", -1, None)
        jobs.add(c, "recover", "old1", {}, "other")
    parts = []
    for _ in range(3):
        with writing(engine) as c:
            parts.append(delete_expired(c))
    folders = ("captures", "mattes", "uploads/old", "uploads/u")
    assert [[sum(path.startswith(folder) for path in part) for folder in folders] for part in parts] == [
        [2, 2, 2, 2],
        [0, 1, 0, 1],
        [0, 0, 0, 0],
    ]
    assert existing(engine) == {"captures": {"old1"}, "mattes": set()}


def age_jobs(engine: Engine) -> None:
    with writing(engine) as c:
        for row in c.execute(select(tables.jobs)).all():
            if row.finished_at is not None:
                jobs.change(c, row.id, finished_at=row.finished_at - 100)


def listed(engine: Engine) -> set[str]:
    with reading(engine) as c:
        return set(c.scalars(select(tables.jobs.c.id)))


def test_old_jobs_are_deleted_unless_their_results_exist(engine: Engine, objects: Objects) -> None:
    add(engine, "alice", "kept")
    add(engine, "bob", "gone")
    with writing(engine) as c:
        composite = jobs.add(c, "composite", "kept", {}, "kept", job="composite")
        failed = jobs.add(c, "composite", "kept", {}, "kept", job="failed")
        queued = jobs.add(c, "recover", "gone", {}, "gone", job="queued")
        tiles.add_plan(c, composite, {"tiles": 3})
        jobs.end(c, composite, "succeeded")
        jobs.end(c, failed, "failed", {"detail": "", "status": 500})
        captures.delete(c, "gone")
        mattes.delete(c, "gone")
    objects.put(composites.video_path(composite), b"video")
    everything = {"kept-i", "kept-r", "gone-i", "gone-r", composite, failed, queued}
    age_jobs(engine)
    delete_old_jobs(engine, objects, None)
    delete_old_jobs(engine, objects, 3600)
    assert listed(engine) == everything
    with writing(engine) as c:
        jobs.retry(c, failed)
    delete_old_jobs(engine, objects, 60)
    assert listed(engine) == {"kept-i", "kept-r", failed, queued}
    assert objects.paths_below("composites") == set()
    with reading(engine) as c:
        for table in (tables.tiles, tables.log):
            assert set(c.scalars(select(table.c.job))) <= listed(engine)


def test_job_that_is_retried_while_old_ones_are_searched_is_kept(
    engine: Engine, objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    with writing(engine) as c:
        job = jobs.add(c, "recover", "gone", {}, "gone")
        jobs.end(c, job, "failed", {"detail": "", "status": 500})
    age_jobs(engine)
    meanwhile(monkeypatch, lambda c: jobs.retry(c, job))
    delete_old_jobs(engine, objects, 60)
    assert listed(engine) == {job}


def meanwhile(monkeypatch: pytest.MonkeyPatch, change: Callable[[Connection], None]) -> None:
    """Change something between what retention reads and what it writes."""

    def after_a_change(engine: Engine) -> AbstractContextManager[Connection]:
        with writing(engine) as c:
            change(c)
        return writing(engine)

    monkeypatch.setattr(retention, "writing", after_a_change)


def test_idempotency_key_is_kept_as_long_as_its_result(engine: Engine, objects: Objects) -> None:
    add(engine, "alice", "thing")
    with writing(for_owner(engine, "alice")) as c:
        for key, made in (("capture", "thing"), ("job", "thing-r"), ("gone", "another")):
            idempotency.add(c, key, "POST", made)
    delete_old_jobs(engine, objects, None)

    def known() -> list[str | None]:
        with reading(for_owner(engine, "alice")) as c:
            return [idempotency.find(c, key, "POST") for key in ("capture", "job", "gone")]

    assert known() == ["thing", "thing-r", None]
    with writing(engine) as c:
        jobs.delete(c, "thing-r")
        captures.delete(c, "thing")
    delete_old_jobs(engine, objects, None)
    assert known() == ["thing", None, None]  # the matte of this name is there
    with writing(engine) as c:
        mattes.delete(c, "thing")
    delete_old_jobs(engine, objects, None)
    assert known() == [None, None, None]


def test_bytes_are_counted_once_complete(engine: Engine, objects: Objects) -> None:
    add(engine, "alice", "a")
    add(engine, "bob", "b")
    with writing(for_owner(engine, "alice")) as c:
        captures.add(c, "under-way", "j", name="", bytes=1000, frames=1, program={})
        mattes.add(c, "under-way", "a", "j", {})
        uploads.add(c, "u", 20_000, "", 60, None)
        clip = jobs.add(c, "composite", "a", {}, "a", stored=300_000)
    objects.put(f"{stored_captures.path('a')}/x/y", bytes(1))
    objects.put(f"{stored_uploads.path('a')}/rest", bytes(2))
    objects.put(f"{stored_mattes.path('a')}/z", bytes(4))
    objects.put(f"{stored_captures.path('under-way')}/z", bytes(999))
    objects.put(composites.clip_path(clip), bytes(300_000))

    def stored(owner: str) -> int:
        count_bytes(engine, objects)
        with reading(for_owner(engine, owner)) as c:
            return statistics.stored_bytes(c)

    each = len(objects.read_raw(f"{stored_mattes.path('a')}/z{SUFFIX}"))  # checksums count too
    rows = 8 * ROW + 2 * len("{}")  # two captures with their programs, two mattes, three jobs, an upload
    assert stored("alice") == 7 + 3 * each + 1000 + 20_000 + 300_000 + rows
    of_bob = 4 * ROW + len("{}")
    assert stored("bob") == of_bob  # the size of its capture archive counts until then
    with writing(engine) as c:
        jobs.end(c, clip, "succeeded")
        jobs.change(c, clip, stored=None)
        captures.change(c, "under-way", state="ready")
        assert statistics.stored_bytes(c, all_owners=True) == statistics.stored_bytes(c)
    objects.delete(composites.clip_path(clip))
    objects.put(composites.video_path(clip), bytes(64))
    assert stored("alice") == 7 + 999 + 20_000 + 64 + 5 * each + rows
    with reading(for_owner(engine, "bob")) as c:
        assert statistics.stored_bytes(c, all_owners=True) == 7 + 999 + 20_000 + 64 + 5 * each + rows + of_bob


def test_what_begins_again_while_it_is_counted_is_counted_later(
    engine: Engine, objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(engine, "alice", "a")
    with writing(engine) as c:
        mattes.delete(c, "a")
        captures.change(c, "a", state="failed")
    meanwhile(monkeypatch, lambda c: captures.change(c, "a", state="ingesting"))
    count_bytes(engine, objects)
    with reading(engine) as c:
        assert captures.get(c, "a").stored is None


def test_start_removes_what_killed_requests_have_left(engine: Engine, objects: Objects) -> None:
    with writing(engine) as c:
        uploads.add(c, "u", 10, "", 60, None)
        bodies.claim(c, "b", "u", 10)
        uploads.advance(c, "u", 0, [Part("recorded", 5)], 60)
    for name in ("recorded", "other"):
        objects.put(stored_uploads.part_path("u", name), b"bytes")
    sweep_uploads(engine, objects)
    assert objects.names(stored_uploads.path("u")) == ["recorded.part"]
    with writing(engine) as c:
        assert bodies.claim(c, "next", "u", 5)


def test_sweep_removes_files_that_killed_writers_left_of_a_video(engine: Engine, tmp_path: Path) -> None:
    objects = Objects((tmp_path / "store").as_uri())
    with writing(engine) as c:
        job = jobs.add(c, "composite", "", {}, "m")
    objects.put(composites.clip_path(job), b"clip")
    unfinished = tmp_path / "store" / f"{composites.video_path(job)}#1"
    unfinished.write_bytes(b"half")
    sweep(engine, objects, objects.clock() - 60)
    assert unfinished.exists()  # it may be under way
    sweep(engine, objects, objects.clock() + 60)
    assert not unfinished.exists()
    assert objects.paths_below("composites") == {composites.clip_path(job)}


def test_sweep_leaves_what_a_request_has_uploaded(engine: Engine, objects: Objects) -> None:
    """However old it looks: a bucket dates an object by when its upload began."""
    add(engine, "alice", "kept")
    objects.put(f"{stored_mattes.path('kept')}/z", b"matte")
    coming = {stored_uploads.part_path("a", "all"), composites.clip_path("b")}
    for path in coming:
        objects.put(path, b"body")
    with writing(for_owner(engine, "alice")) as c:
        bodies.add(c, "a", 4, 4)
        bodies.add(c, "b", 4, 4)
        # Its process may only be cut off, or check what has come.
        c.execute(update(tables.bodies).values(renewed_at=time.time() - 2 * bodies.LAPSE))
    sweep(engine, objects, objects.clock() + 60)
    assert objects.paths_below("uploads") | objects.paths_below("composites") == coming
    with writing(engine) as c:
        bodies.release(c, "a")
        bodies.release(c, "b")
    sweep(engine, objects, objects.clock() + 60)
    assert objects.paths_below("uploads") | objects.paths_below("composites") == set()
    assert objects.paths_below("mattes") == {f"{stored_mattes.path('kept')}/z"}


def test_sweep_leaves_the_store_of_another_installation(engine: Engine, tmp_path: Path) -> None:
    """As where its share is mounted in place of the right one."""
    objects = Objects(tmp_path.as_uri())
    installation.recognise(engine, objects)
    marker.write(objects, "another")
    objects.put(f"{stored_mattes.path('theirs')}/z", b"matte")
    with pytest.raises(WrongStore):
        sweep(engine, objects, objects.clock() + 60)
    with pytest.raises(WrongStore):
        count_bytes(engine, objects)
    assert objects.paths_below("mattes") == {f"{stored_mattes.path('theirs')}/z"}
