"""Rows of tiles: done, tried again, lost, missing, and what they add to their job."""

from sqlalchemy import Connection, select

from storage import steps
from storage.database import tables
from storage.records import jobs, tiles
from tests.storage.planned import log_of, planned


def test_plan_is_added_once(connection: Connection) -> None:
    job = planned(connection)
    tiles.mark_done(connection, job, [(1, 0.1, 5)])
    tiles.add_plan(connection, job, {"tiles": 7})
    assert jobs.get(connection, job).total == 3
    assert tiles.remaining(connection, job) == [0, 2]


def test_tile_done_twice_counts_once(connection: Connection) -> None:
    job, other = planned(connection), planned(connection)
    tiles.mark_done(connection, job, [(1, 0.1, 50), (1, 0.1, 50)])
    tiles.mark_done(connection, job, [(1, 9.0, 50), (2, 0.1, 30)])
    row = jobs.get(connection, job)
    assert (row.done, row.pixels) == (2, 80)
    assert tiles.remaining(connection, job) == [0]
    assert tiles.remaining(connection, other) == [0, 1, 2]
    assert jobs.get(connection, other).done == 0


def test_tile_fails_after_allowed_attempts(connection: Connection) -> None:
    job = planned(connection)
    assert [tiles.record_failure(connection, job, 1, "out of memory", 3) for _ in range(3)] == [
        True,
        True,
        False,
    ]
    assert jobs.get(connection, job).failed == 1
    assert tiles.remaining(connection, job) == [0, 2]
    assert log_of(connection, job)[1:] == [f"tile 1, attempt {n} of 3: out of memory" for n in (1, 2, 3)]
    tiles.mark_done(connection, job, [(1, 0.1, 10)])
    assert jobs.get(connection, job).done == 0


def test_step_fails_after_allowed_attempts(connection: Connection) -> None:
    job = planned(connection)
    tiles.add_steps(connection, job)
    tiles.add_steps(connection, job)
    assert tiles.remaining(connection, job) == [0, 1, 2]
    assert [tiles.record_failure(connection, job, steps.PREPARE, "why", 2) for _ in range(2)] == [
        True,
        False,
    ]
    assert tiles.record_failure(connection, job, steps.FINISH, "why", 2)
    assert log_of(connection, job)[1:] == [
        "preparing, attempt 1 of 2: why",
        "preparing, attempt 2 of 2: why",
        "finishing, attempt 1 of 2: why",
    ]
    assert jobs.get(connection, job).failed == 0


def test_losses_are_counted_separately(connection: Connection) -> None:
    job = planned(connection)
    assert tiles.record_loss(connection, job, 1, "it died", 2)
    assert tiles.record_failure(connection, job, 1, "why", 2)
    assert not tiles.record_loss(connection, job, 1, "it died", 2)
    assert log_of(connection, job)[1:] == [
        "tile 1, loss 1 of 2: it died",
        "tile 1, attempt 1 of 2: why",
        "tile 1, loss 2 of 2: it died",
    ]
    assert tiles.remaining(connection, job) == [0, 2]


def test_missing_tile_is_done_again_and_counts_once(connection: Connection) -> None:
    job = planned(connection)
    tiles.mark_done(connection, job, [(n, 0.1, 10) for n in range(3)])
    assert tiles.requeue_missing(connection, job, [0, 2], 2) == [0, 2]
    assert tiles.remaining(connection, job) == [0, 2]
    assert tiles.record_failure(connection, job, 2, "why", 2)  # it has not failed before
    assert (jobs.get(connection, job).done, jobs.get(connection, job).pixels) == (3, 30)
    tiles.mark_done(connection, job, [(0, 0.1, 10), (2, 0.1, 10)])
    assert (jobs.get(connection, job).done, jobs.get(connection, job).pixels) == (3, 30)
    assert tiles.requeue_missing(connection, job, [2], 2) == []
    jobs.end(connection, job, "failed", {"detail": "gone again"})
    jobs.retry(connection, job)
    assert jobs.get(connection, job).done == 2
    tiles.mark_done(connection, job, [(2, 0.1, 10)])
    assert jobs.get(connection, job).done == 3


def test_pace_is_measured_once_enough_tiles_are_done(connection: Connection) -> None:
    job = planned(connection)
    jobs.enter_stage(connection, job, "recovering")
    assert not tiles.start_pace(connection, job, after=2)
    tiles.mark_done(connection, job, [(0, 0.1, 10), (1, 0.1, 10)])
    assert tiles.start_pace(connection, job, after=2)
    row = jobs.get(connection, job)
    assert row.paced_done == 2
    assert row.moved_at <= row.paced_at
    jobs.enter_stage(connection, job, "finishing")
    assert jobs.get(connection, job).paced_at is None


def test_totals_include_deleted_jobs(connection: Connection) -> None:
    job, other = planned(connection), planned(connection)
    tiles.mark_done(connection, job, [(0, 0.5, 10), (0, 0.5, 10), (1, 0.25, 20)])
    tiles.record_failure(connection, job, 2, "why", 3)
    tiles.mark_done(connection, other, [(0, 0.25, 5)])
    tiles.record_loss(connection, other, 1, "why", 3)
    jobs.cancel(connection, job)
    jobs.delete(connection, job)
    (row,) = connection.execute(select(tables.totals))
    assert tuple(row) == ("recover", 3, 1, 1, 35, 1.0)
