"""The ledger: what a job may become, what its tiles count for, and its log."""

from itertools import pairwise

import pytest
from sqlalchemy import Connection, Engine, func, select

from storage import steps
from storage.database import rows, tables
from storage.database.engine import writing
from storage.errors import Conflict, NotFound
from storage.records import idempotency, job_log, jobs, mattes
from storage.records import tiles as tile_records


@pytest.fixture
def connection(engine: Engine):  # type: ignore[no-untyped-def]
    with writing(engine) as connection:
        yield connection


def laid(connection: Connection, tiles: int = 3) -> str:
    job = jobs.add(connection, "recover", "cap", {"method": "lobes"}, matte="mat")
    tile_records.add_plan(connection, job, {"tiles": tiles, "slab": 9})
    return job


def lines(connection: Connection, job: str) -> list[str]:
    return [row.text for row in job_log.lines(connection, job, 0, 100)]


def test_a_job_from_queue_to_success(connection: Connection) -> None:
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
    tile_records.add_plan(connection, job, {"tiles": 2, "slab": 5})
    jobs.enter_stage(connection, job, "recovering")
    row = jobs.get(connection, job)
    assert (row.state, row.stage, row.total, row.plan) == (
        "running",
        "recovering",
        2,
        {"tiles": 2, "slab": 5},
    )
    assert row.started_at == started is not None
    tile_records.mark_done(connection, job, [(0, 0.5, 100), (1, 0.25, 60)])
    assert jobs.end(connection, job, "succeeded")
    row = jobs.get(connection, job)
    assert (row.state, row.done, row.pixels, row.problem) == ("succeeded", 2, 160, None)
    assert row.created_at <= row.started_at <= row.finished_at
    assert lines(connection, job) == ["queued", "preparing", "recovering", "succeeded"]


def test_ids_are_opaque_and_differ() -> None:
    ids = {rows.new_id() for _ in range(1000)}
    assert len(ids) == 1000
    assert all(name.isalnum() and len(name) == 20 for name in ids)


def test_what_is_not_there(connection: Connection) -> None:
    for call in (jobs.get, jobs.cancel, jobs.retry, jobs.delete):
        with pytest.raises(NotFound, match="no job 'none'"):
            call(connection, "none")


def test_a_plan_is_laid_down_once(connection: Connection) -> None:
    job = laid(connection)
    tile_records.mark_done(connection, job, [(1, 0.1, 5)])
    tile_records.add_plan(connection, job, {"tiles": 7})
    assert jobs.get(connection, job).total == 3
    assert tile_records.remaining(connection, job) == [0, 2]


def test_a_tile_done_twice_counts_once(connection: Connection) -> None:
    job, other = laid(connection), laid(connection)
    tile_records.mark_done(connection, job, [(1, 0.1, 50), (1, 0.1, 50)])
    tile_records.mark_done(connection, job, [(1, 9.0, 50), (2, 0.1, 30)])
    row = jobs.get(connection, job)
    assert (row.done, row.pixels) == (2, 80)
    assert tile_records.remaining(connection, job) == [0]
    assert tile_records.remaining(connection, other) == [0, 1, 2]
    assert jobs.get(connection, other).done == 0


def test_a_tile_is_tried_as_often_as_allowed(connection: Connection) -> None:
    job = laid(connection)
    assert [tile_records.record_failure(connection, job, 1, "out of memory", 3) for _ in range(3)] == [
        True,
        True,
        False,
    ]
    assert jobs.get(connection, job).failed == 1
    assert tile_records.remaining(connection, job) == [0, 2]
    assert lines(connection, job)[1:] == [f"tile 1, attempt {n} of 3: out of memory" for n in (1, 2, 3)]
    tile_records.mark_done(connection, job, [(1, 0.1, 10)])
    assert jobs.get(connection, job).done == 0


@pytest.mark.parametrize("state", ["succeeded", "failed", "cancelled"])
def test_a_job_ends_once(connection: Connection, state: str) -> None:
    job = laid(connection)
    problem = {"title": "Corrupt", "detail": "a chunk is gone"} if state == "failed" else None
    assert jobs.end(connection, job, state, problem)
    before = jobs.get(connection, job)
    for again in ("succeeded", "failed", "cancelled"):
        assert not jobs.end(connection, job, again, {"detail": "late"})
    jobs.enter_stage(connection, job, "recovering")
    assert jobs.get(connection, job) == before
    assert before.problem == problem
    assert lines(connection, job)[-1] == ("failed: a chunk is gone" if problem else state)


def test_an_end_of_no_job(connection: Connection) -> None:
    assert not jobs.end(connection, "none", "failed")


def test_cancelling(connection: Connection) -> None:
    job = laid(connection)
    jobs.cancel(connection, job)
    jobs.cancel(connection, job)
    assert jobs.get(connection, job).state == "cancelled"
    assert lines(connection, job).count("cancelled") == 1
    for state in ("succeeded", "failed"):
        ended = laid(connection)
        jobs.end(connection, ended, state)
        with pytest.raises(Conflict, match=state):
            jobs.cancel(connection, ended)


def test_a_retry_keeps_what_is_done(connection: Connection) -> None:
    job = laid(connection)
    jobs.enter_stage(connection, job, "recovering")
    tile_records.mark_done(connection, job, [(0, 0.1, 10)])
    tile_records.record_failure(connection, job, 1, "why", 1)
    jobs.end(connection, job, "failed", {"detail": "a tile failed"})
    jobs.retry(connection, job)
    row = jobs.get(connection, job)
    assert (row.state, row.stage, row.done, row.failed, row.pixels) == ("queued", "waiting", 1, 0, 10)
    assert (row.problem, row.finished_at) == (None, None)
    assert tile_records.remaining(connection, job) == [1, 2]
    assert tile_records.record_failure(connection, job, 1, "again", 2)


def test_a_retry_may_begin_anew(connection: Connection) -> None:
    job = laid(connection)
    tile_records.mark_done(connection, job, [(0, 0.1, 10)])
    jobs.end(connection, job, "failed", {"detail": "its slabs were too large"})
    jobs.retry(connection, job, replan=True)
    row = jobs.get(connection, job)
    assert (row.state, row.plan, row.total, row.done, row.pixels) == ("queued", None, 0, 0, 0)
    tile_records.add_plan(connection, job, {"tiles": 5})
    assert tile_records.remaining(connection, job) == [0, 1, 2, 3, 4]


def test_only_a_failed_job_is_tried_again(connection: Connection) -> None:
    for state in (None, "succeeded", "cancelled"):
        job = laid(connection)
        if state:
            jobs.end(connection, job, state)
        with pytest.raises(Conflict, match=state or "queued"):
            jobs.retry(connection, job)


def test_forgetting_takes_tiles_and_log_along(connection: Connection) -> None:
    job, other = laid(connection), laid(connection)
    with pytest.raises(Conflict, match="cancel it first"):
        jobs.delete(connection, job)
    jobs.cancel(connection, job)
    jobs.delete(connection, job)
    with pytest.raises(NotFound):
        jobs.get(connection, job)
    for table in (tables.tiles, tables.log):
        count = select(func.count()).select_from(table)
        assert connection.scalar(count.where(table.c.job == job)) == 0
        assert connection.scalar(count.where(table.c.job == other))


def test_active_jobs_are_oldest_first(connection: Connection) -> None:
    made = [laid(connection) for _ in range(4)]
    jobs.enter_stage(connection, made[2], "recovering")
    jobs.end(connection, made[1], "failed")
    assert [row.id for row in jobs.active(connection)] == [made[0], made[2], made[3]]


def test_a_page_is_newest_first(connection: Connection) -> None:
    made = [laid(connection) for _ in range(5)]
    for job in (made[1], made[3]):
        jobs.end(connection, job, "failed")

    def ids(limit: int, after: str | None, **equal: str | None) -> list[str]:
        return [row.id for row in rows.page(connection, tables.jobs, limit, after, **equal)]

    assert ids(10, None) == made[::-1]
    assert ids(2, None) == [made[4], made[3]]
    assert ids(2, made[3]) == [made[2], made[1]]
    assert ids(2, made[0]) == []
    assert ids(10, None, state="failed", kind=None) == [made[3], made[1]]
    assert ids(10, made[2], state="failed") == [made[1]]
    assert ids(10, made[2], state="queued", kind="recover") == [made[0]]
    assert ids(10, None, kind="ingest") == []
    with pytest.raises(NotFound) as caught:
        ids(10, "none")
    assert caught.value.fields == {"field": "after"}


def test_log_lines_after_a_line(connection: Connection) -> None:
    job, other = laid(connection), laid(connection)
    for n in range(5):
        job_log.add(connection, job, f"line {n}")
        job_log.add(connection, other, "of another job")
    read = job_log.lines(connection, job, 0, 3)
    assert [row.text for row in read] == ["queued", "line 0", "line 1"]
    rest = job_log.lines(connection, job, read[-1].line, 100)
    assert [row.text for row in rest] == ["line 2", "line 3", "line 4"]
    assert job_log.lines(connection, job, rest[-1].line, 100) == []
    assert all(a.at <= b.at for a, b in pairwise(read))


def test_what_a_key_made(connection: Connection) -> None:
    assert idempotency.find(connection, "key", "POST /v1/jobs") is None
    idempotency.add(connection, "key", "POST /v1/jobs", "abc")
    assert idempotency.find(connection, "key", "POST /v1/jobs") == "abc"
    assert idempotency.find(connection, "key", "POST /v1/captures") is None
    assert idempotency.find(connection, "other", "POST /v1/jobs") is None


def test_the_steps_around_the_tiles_are_tried_as_often_as_allowed(connection: Connection) -> None:
    job = laid(connection)
    tile_records.add_steps(connection, job)
    tile_records.add_steps(connection, job)
    assert tile_records.remaining(connection, job) == [0, 1, 2]
    assert [tile_records.record_failure(connection, job, steps.PREPARE, "why", 2) for _ in range(2)] == [
        True,
        False,
    ]
    assert tile_records.record_failure(connection, job, steps.FINISH, "why", 2)
    assert lines(connection, job)[1:] == [
        "preparing, attempt 1 of 2: why",
        "preparing, attempt 2 of 2: why",
        "finishing, attempt 1 of 2: why",
    ]
    assert jobs.get(connection, job).failed == 0


def test_workers_that_die_are_counted_apart(connection: Connection) -> None:
    job = laid(connection)
    assert tile_records.record_loss(connection, job, 1, "it died", 2)
    assert tile_records.record_failure(connection, job, 1, "why", 2)
    assert not tile_records.record_loss(connection, job, 1, "it died", 2)
    assert lines(connection, job)[1:] == [
        "tile 1, loss 1 of 2: it died",
        "tile 1, attempt 1 of 2: why",
        "tile 1, loss 2 of 2: it died",
    ]
    assert tile_records.remaining(connection, job) == [0, 2]


def test_a_tile_that_the_store_lacks_is_done_again_and_counts_once(connection: Connection) -> None:
    job = laid(connection)
    tile_records.mark_done(connection, job, [(n, 0.1, 10) for n in range(3)])
    assert tile_records.requeue_missing(connection, job, [0, 2], 2) == [0, 2]
    assert tile_records.remaining(connection, job) == [0, 2]
    assert (jobs.get(connection, job).done, jobs.get(connection, job).pixels) == (3, 30)
    tile_records.mark_done(connection, job, [(0, 0.1, 10), (2, 0.1, 10)])
    assert (jobs.get(connection, job).done, jobs.get(connection, job).pixels) == (3, 30)
    assert tile_records.requeue_missing(connection, job, [2], 2) == []
    jobs.end(connection, job, "failed", {"detail": "gone again"})
    jobs.retry(connection, job)
    assert jobs.get(connection, job).done == 2
    tile_records.mark_done(connection, job, [(2, 0.1, 10)])
    assert jobs.get(connection, job).done == 3


def test_the_pace_is_measured_from_where_tiles_are_done(connection: Connection) -> None:
    job = laid(connection)
    jobs.enter_stage(connection, job, "recovering")
    assert not tile_records.start_pace(connection, job, after=2)
    tile_records.mark_done(connection, job, [(0, 0.1, 10), (1, 0.1, 10)])
    assert tile_records.start_pace(connection, job, after=2)
    row = jobs.get(connection, job)
    assert row.paced_done == 2
    assert row.moved_at <= row.paced_at
    jobs.enter_stage(connection, job, "finishing")
    assert jobs.get(connection, job).paced_at is None


def test_what_was_ever_done_is_added_up(connection: Connection) -> None:
    job, other = laid(connection), laid(connection)
    tile_records.mark_done(connection, job, [(0, 0.5, 10), (0, 0.5, 10), (1, 0.25, 20)])
    tile_records.record_failure(connection, job, 2, "why", 3)
    tile_records.mark_done(connection, other, [(0, 0.25, 5)])
    tile_records.record_loss(connection, other, 1, "why", 3)
    jobs.cancel(connection, job)
    jobs.delete(connection, job)
    (row,) = connection.execute(select(tables.totals))
    assert tuple(row) == ("recover", 3, 1, 1, 35, 1.0)


def test_a_cancelled_composite_has_leftovers_until_its_tiles_are_cleared(connection: Connection) -> None:
    recovery = jobs.add(connection, "recover", "cap", {}, matte="other")
    mattes.add(connection, "other", "cap", recovery, {})  # which is being recovered, and is no part of it
    job = jobs.add(connection, "composite", "cap", {"transfer": "srgb"}, "other", job="given")
    assert job == "given"
    tile_records.add_steps(connection, job)
    assert jobs.cancelled_with_leftovers(connection) == []
    jobs.cancel(connection, job)
    assert [row.id for row in jobs.cancelled_with_leftovers(connection)] == [job]
    tile_records.delete_all(connection, job)
    assert jobs.cancelled_with_leftovers(connection) == []
