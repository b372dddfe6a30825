"""Jobs: from the queue to their end, cancelled, retried and deleted."""

from itertools import pairwise

import pytest
from sqlalchemy import Connection, Engine, func, select

from storage import statistics
from storage.database import tables
from storage.database.engine import writing
from storage.database.owners import for_owner
from storage.database.rows import ROW, page
from storage.errors import Conflict, NotFound
from storage.records import captures, jobs, mattes, tiles
from tests.storage.planned import log_of, planned


def test_job_from_queued_to_succeeded(connection: Connection) -> None:
    job = jobs.add(connection, "recover", "cap", {"tile": 64}, matte="mat")
    row = jobs.get(connection, job)
    assert (row.state, row.stage, row.kind, row.capture, row.matte) == (
        "queued",
        "waiting",
        "recover",
        "cap",
        "mat",
    )
    assert row.options == {"tile": 64}
    assert (row.plan, row.started_at, row.finished_at, row.total) == (None, None, None, 0)
    jobs.enter_stage(connection, job, "preparing")
    started = jobs.get(connection, job).started_at
    tiles.add_plan(connection, job, {"tiles": 2, "slab": 5})
    jobs.enter_stage(connection, job, "recovering")
    row = jobs.get(connection, job)
    assert (row.state, row.stage, row.total, row.plan) == (
        "running",
        "recovering",
        2,
        {"tiles": 2, "slab": 5},
    )
    assert row.started_at == started is not None
    tiles.mark_done(connection, job, [(0, 0.5, 100), (1, 0.25, 60)])
    assert jobs.end(connection, job, "succeeded")
    row = jobs.get(connection, job)
    assert (row.state, row.done, row.pixels, row.problem) == ("succeeded", 2, 160, None)
    assert row.created_at <= row.started_at <= row.finished_at
    assert log_of(connection, job) == ["queued", "preparing", "recovering", "succeeded"]


def test_unknown_job_is_not_found(connection: Connection) -> None:
    for call in (jobs.get, jobs.cancel, jobs.retry, jobs.delete):
        with pytest.raises(NotFound, match="no job 'none'"):
            call(connection, "none")


@pytest.mark.parametrize("state", ["succeeded", "failed", "cancelled"])
def test_job_ends_once(connection: Connection, state: str) -> None:
    job = planned(connection)
    problem = {"title": "Corrupt", "detail": "a chunk is gone"} if state == "failed" else None
    assert jobs.end(connection, job, state, problem)
    before = jobs.get(connection, job)
    for again in ("succeeded", "failed", "cancelled"):
        assert not jobs.end(connection, job, again, {"detail": "late"})
    assert not jobs.enter_stage(connection, job, "recovering")
    assert jobs.get(connection, job) == before
    assert before.problem == problem
    assert log_of(connection, job)[-1] == ("failed: a chunk is gone" if problem else state)


def test_ending_unknown_job_changes_nothing(connection: Connection) -> None:
    assert not jobs.end(connection, "none", "failed")


def test_job_is_cancelled_once_and_not_after_its_end(connection: Connection) -> None:
    job = planned(connection)
    jobs.cancel(connection, job)
    jobs.cancel(connection, job)
    assert jobs.get(connection, job).state == "cancelled"
    assert log_of(connection, job).count("cancelled") == 1
    for state in ("succeeded", "failed"):
        ended = planned(connection)
        jobs.end(connection, ended, state)
        with pytest.raises(Conflict, match=state):
            jobs.cancel(connection, ended)


def test_retry_keeps_done_tiles(connection: Connection) -> None:
    job = planned(connection)
    jobs.enter_stage(connection, job, "recovering")
    tiles.mark_done(connection, job, [(0, 0.1, 10)])
    tiles.record_failure(connection, job, 1, "why", 1)
    tiles.record_loss(connection, job, 2, "it died", 2)
    jobs.end(connection, job, "failed", {"detail": "a tile failed"})
    jobs.retry(connection, job)
    row = jobs.get(connection, job)
    assert (row.state, row.stage, row.done, row.failed, row.pixels) == ("queued", "waiting", 1, 0, 10)
    assert (row.problem, row.finished_at) == (None, None)
    assert tiles.remaining(connection, job) == [1, 2]
    assert tiles.record_failure(connection, job, 1, "again", 2)
    assert tiles.record_loss(connection, job, 2, "again", 2)


def test_retry_with_new_plan(connection: Connection) -> None:
    job = planned(connection)
    tiles.mark_done(connection, job, [(0, 0.1, 10)])
    jobs.end(connection, job, "failed", {"detail": "its slabs were too large"})
    jobs.retry(connection, job, replan=True)
    row = jobs.get(connection, job)
    assert (row.state, row.plan, row.total, row.done, row.pixels) == ("queued", None, 0, 0, 0)
    tiles.add_plan(connection, job, {"tiles": 5})
    assert tiles.remaining(connection, job) == [0, 1, 2, 3, 4]


def test_only_failed_job_is_retried(connection: Connection) -> None:
    for state in (None, "succeeded", "cancelled"):
        job = planned(connection)
        if state:
            jobs.end(connection, job, state)
        with pytest.raises(Conflict, match=state or "queued"):
            jobs.retry(connection, job)


def test_deleting_job_deletes_tiles_and_log(connection: Connection) -> None:
    job, other = planned(connection), planned(connection)
    with pytest.raises(Conflict, match="cancel it first"):
        jobs.delete(connection, job)
    jobs.end(connection, job, "failed")
    jobs.delete(connection, job)
    with pytest.raises(NotFound):
        jobs.get(connection, job)
    for table in (tables.tiles, tables.log):
        count = select(func.count()).select_from(table)
        assert connection.scalar(count.where(table.c.job == job)) == 0
        assert connection.scalar(count.where(table.c.job == other))


def test_jobs_to_run_are_oldest_first(connection: Connection) -> None:
    made = [planned(connection) for _ in range(4)]
    jobs.enter_stage(connection, made[2], "recovering")
    jobs.end(connection, made[1], "failed")
    found = jobs.to_run(connection)
    assert [row.id for row in found] == [made[0], made[2], made[3]]
    assert not {"plan", "options", "problem"} & set(found[0]._fields)  # of many jobs, these take long to read


def test_jobs_to_run_lack_what_waits_for_an_ingest(connection: Connection) -> None:
    ingest = jobs.add(connection, "ingest", "new", {})
    captures.add(connection, "new", ingest, name="", bytes=1, frames=1, program={})
    recovery = jobs.add(connection, "recover", "new", {}, matte="m")
    for state, expected in (
        ("ingesting", [ingest]),
        ("failed", [ingest, recovery]),
        ("ready", [ingest, recovery]),
    ):
        captures.change(connection, "new", state=state)
        assert [row.id for row in jobs.to_run(connection)] == expected


def test_active_job_of_a_capture_or_a_matte(connection: Connection) -> None:
    assert jobs.active_job(connection, capture="new") is None
    first, second = (jobs.add(connection, "recover", "new", {}, matte=matte) for matte in ("a", "b"))
    assert jobs.active_job(connection, capture="new") == first
    assert jobs.active_job(connection, matte="b") == second
    jobs.end(connection, first, "succeeded")
    assert jobs.active_job(connection, capture="new") == second
    assert jobs.active_job(connection, matte="a") is None
    jobs.end(connection, second, "succeeded")
    composite = jobs.add(connection, "composite", "new", {}, matte="b")
    assert jobs.active_job(connection, matte="b") == composite
    assert jobs.active_job(connection, capture="new") is None  # which it does not read


def test_only_cancelled_job_has_leftovers(connection: Connection) -> None:
    other = jobs.add(connection, "recover", "cap", {}, matte="other")
    job = jobs.add(connection, "composite", "cap", {"transfer": "srgb"}, "other", job="given")
    assert job == "given"
    jobs.end(connection, other, "succeeded")
    assert jobs.cancelled_with_leftovers(connection) == []
    jobs.cancel(connection, job)
    (row,) = jobs.cancelled_with_leftovers(connection)
    assert row._asdict() == {"id": job, "kind": "composite", "capture": "cap", "matte": "other"}
    jobs.change(connection, job, leftovers=False)
    jobs.cancel(connection, job)  # again
    assert jobs.cancelled_with_leftovers(connection) == []


def test_deleted_job_is_kept_from_its_owner_until_its_leftovers_are_removed(engine: Engine) -> None:
    with writing(for_owner(engine, "alice")) as c:
        job, kept = planned(c), planned(c)
        for one in (job, kept):
            jobs.cancel(c, one)
        jobs.delete(c, job)
        assert [row.id for row in page(c, tables.jobs, 10, None)] == [kept]
        with pytest.raises(NotFound):
            jobs.delete(c, job)
    with writing(engine) as c:
        assert {row.id for row in jobs.cancelled_with_leftovers(c)} == {job, kept}
        for one in (job, kept):
            jobs.clear_leftovers(c, one)
        assert jobs.cancelled_with_leftovers(c) == []
        assert list(c.scalars(select(tables.jobs.c.id))) == [kept]


def test_each_attempt_counts_as_stored(connection: Connection) -> None:
    job = jobs.add(connection, "recover", "c", {})
    for attempts in (1, 2, 3):
        assert statistics.stored_bytes(connection) == attempts * ROW
        jobs.end(connection, job, "failed", {"detail": "", "status": 500})
        jobs.retry(connection, job)


def test_log_lines_after_a_line(connection: Connection) -> None:
    job, other = planned(connection), planned(connection)
    for n in range(5):
        jobs.log(connection, job, f"line {n}")
        jobs.log(connection, other, "of another job")
    read = jobs.log_lines(connection, job, 0, 3)
    assert [row.text for row in read] == ["queued", "line 0", "line 1"]
    rest = jobs.log_lines(connection, job, read[-1].line, 100)
    assert [row.text for row in rest] == ["line 2", "line 3", "line 4"]
    assert jobs.log_lines(connection, job, rest[-1].line, 100) == []
    assert all(a.at <= b.at for a, b in pairwise(read))


def test_job_is_paused_and_continued(connection: Connection) -> None:
    job = planned(connection)
    jobs.change(connection, job, paced_at=1.0)
    for paused in (True, True, False):
        jobs.pause(connection, job, paused)
        row = jobs.get(connection, job)
        assert (row.paused, row.paced_at) == (paused, None)
    assert log_of(connection, job)[-2:] == ["paused", "continued"]  # each once
    jobs.pause(connection, job, True)
    jobs.cancel(connection, job)
    assert not jobs.get(connection, job).paused
    with pytest.raises(Conflict, match="already cancelled"):
        jobs.pause(connection, job, True)


def test_job_has_the_name_of_its_matte_or_else_of_its_capture(connection: Connection) -> None:
    ingest = jobs.add(connection, "ingest", "cap", {})
    recovery = jobs.add(connection, "recover", "cap", {}, matte="mat")
    composite = jobs.add(connection, "composite", "", {}, matte="imported")
    gone = jobs.add(connection, "recover", "none", {}, matte="none")
    captures.add(connection, "cap", ingest, name="ball", program={}, frames=1, bytes=1)
    mattes.add(connection, "mat", "cap", recovery, {}, name="glass ball")
    mattes.add_imported(connection, "imported", {}, {}, name="tumbler")
    rows = [jobs.get(connection, job) for job in (ingest, recovery, composite, gone)]
    assert jobs.names(connection, rows) == {
        ingest: "ball",
        recovery: "glass ball",
        composite: "tumbler",
        gone: "",
    }
    mattes.delete(connection, "mat")
    assert jobs.names(connection, rows)[recovery] == "ball"
    assert jobs.names(connection, []) == {}
