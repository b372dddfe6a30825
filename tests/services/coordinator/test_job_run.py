"""How a job advances with the outcomes of its tiles, with a real database."""

import time
from collections import deque
from collections.abc import Iterator

import pytest
from sqlalchemy import Connection, Engine, select

from services.cluster.dispatcher import Outcome
from services.coordinator import job_run
from services.coordinator.job_run import LOSSES, JobRun
from storage.database.engine import writing
from storage.database.tables import tiles, totals
from storage.errors import Corrupt, StoreUnavailable, Unavailable, WrongStore
from storage.records import captures, jobs, mattes
from storage.records import tiles as tile_records
from storage.steps import FINISH, PREPARE
from workflows.untrusted.limits import Limits

LIMITS = Limits(1 << 30, 1 << 26)


@pytest.fixture
def connection(engine: Engine) -> Iterator[Connection]:
    with writing(engine) as connection:
        yield connection


@pytest.fixture
def job(connection: Connection) -> str:
    captures.add(connection, "cap", "other", name="", bytes=0, frames=0, program={})
    job = jobs.add(connection, "recover", "cap", {}, "mat")
    mattes.add(connection, "mat", "cap", job, {})
    return job


def start(connection: Connection, job: str) -> JobRun:
    tile_records.add_steps(connection, job)
    run = JobRun.of(jobs.get(connection, job), tile_records.remaining(connection, job), LIMITS)
    jobs.enter_stage(connection, job, run.stage)
    return run


def advance(
    connection: Connection, run: JobRun, *news: Outcome, under_way: int = 0, threads: int = 2
) -> bool:
    """Record and write outcomes of tiles; returns whether the job continues."""
    for outcome in news:
        if outcome.tile in run.to_do:
            run.to_do.remove(outcome.tile)
        run.record_outcome(outcome)
    following = run.write(connection, 3, threads, under_way)
    run.advance(following)
    return not following.ended


def done(run: JobRun, tile: int, result: object = 10) -> Outcome:
    return Outcome(run.job, tile, done=(0.1, result))


def working(connection: Connection, job: str, tiles: int = 3) -> JobRun:
    run = start(connection, job)
    assert advance(connection, run, done(run, PREPARE, {"tiles": tiles}))
    return run


def lines(connection: Connection, job: str) -> list[str]:
    return [row.text for row in jobs.log_lines(connection, job, 0, 100)]


def test_steps_run_in_order(connection: Connection, job: str) -> None:
    run = start(connection, job)
    assert list(run.to_do) == [PREPARE]
    assert advance(connection, run, done(run, PREPARE, {"tiles": 3}))
    assert (run.stage, sorted(run.to_do), run.task.plan) == ("recovering", [0, 1, 2], {"tiles": 3})
    run.to_do.clear()  # all are submitted
    assert advance(connection, run, done(run, 0), done(run, 1), under_way=1)
    assert run.stage == "recovering"
    assert advance(connection, run, done(run, 2))
    assert (run.stage, list(run.to_do)) == ("finishing", [FINISH])
    assert not advance(connection, run, done(run, FINISH, {"width": 4}))
    assert jobs.get(connection, job).state == "succeeded"
    matte = mattes.get(connection, "mat")
    assert (matte.state, matte.figures) == ("ready", {"width": 4})
    seconds = dict(connection.execute(select(tiles.c.tile, tiles.c.seconds).where(tiles.c.job == job)).all())
    assert seconds == dict.fromkeys((PREPARE, FINISH, 0, 1, 2), 0.1)
    assert connection.scalar(select(totals.c.seconds)) == pytest.approx(0.3)  # of tiles only


def test_a_task_has_several_tiles_where_many_threads_do_short_ones(connection: Connection, job: str) -> None:
    run = working(connection, job, tiles=9_000)
    run.spent, run.counted = 500.0, 1000
    first = list(run.to_do)
    assert [len(run.next_tiles(threads)) for threads in (2, 125, 126, 1000)] == [1, 1, 2, 4]
    assert list(run.to_do) == first[8:]
    run.to_do = deque(first[:3000])
    assert len(run.next_tiles(1000)) == 1  # all threads are to have some to the end
    run.spent = run.counted = 0  # nobody knows how long they are
    run.to_do = deque(first)
    assert len(run.next_tiles(1000)) == 1


def test_used_seconds_include_tiles_under_way(connection: Connection, job: str) -> None:
    run = start(connection, job)
    run.start = 5.0
    assert (run.used(), run.used(under_way=2)) == (5.0, 5.0)
    run.record_outcome(Outcome(job, 0, done=(0.5, 10)))
    run.record_outcome(Outcome(job, 1, error=OSError()))
    run.record_outcome(Outcome(job, 2, done=(1.5, 10)))
    assert (run.used(), run.used(under_way=2)) == (7.0, 9.0)


def test_a_job_continues_where_the_ledger_says(connection: Connection, job: str) -> None:
    run = working(connection, job)
    advance(connection, run, done(run, 1), under_way=2)
    again = start(connection, job)
    assert (again.stage, sorted(again.to_do), again.task) == ("recovering", [0, 2], run.task)
    advance(connection, again, done(again, 0), done(again, 2))
    assert list(start(connection, job).to_do) == [FINISH]


def test_lost_tiles_are_repeated_without_counting_as_failures(connection: Connection, job: str) -> None:
    run = working(connection, job)
    for _ in range(20):
        assert advance(connection, run, Outcome(job, 1))
        assert sorted(run.to_do) == [0, 1, 2]
    run.to_do.clear()
    assert advance(connection, run, done(run, 0), Outcome(job, 1), done(run, 2))
    assert (run.stage, list(run.to_do)) == ("recovering", [1])
    assert lines(connection, job)[-1] == "recovering"


@pytest.mark.parametrize("tile", [PREPARE, 1, FINISH])
def test_a_step_is_tried_three_times(
    connection: Connection, job: str, tile: int, caplog: pytest.LogCaptureFixture
) -> None:
    run = start(connection, job) if tile == PREPARE else working(connection, job)
    if tile == FINISH:
        advance(connection, run, *(done(run, n) for n in range(3)))
    error = Outcome(job, tile, error=ValueError("odd: http://secret"))
    assert [advance(connection, run, error) for _ in range(3)] == [True, True, False]
    row = jobs.get(connection, job)
    assert row.state == "failed"
    hidden = "unexpected ValueError; the service's log has the details"
    assert row.problem["detail"].endswith(f"failed 3 times, last with: {hidden}")
    assert [line.partition(" of 3: ")[2] for line in lines(connection, job)[-4:-1]] == [hidden] * 3
    assert caplog.text.count("odd: http://secret") == 3
    assert mattes.get(connection, "mat").state == "failed"


def test_outage_of_the_store_is_waited_for(
    connection: Connection, job: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_run, "HOLD", 0.1)
    run = working(connection, job)
    away = Outcome(job, 1, error=StoreUnavailable("the store cannot be reached"))
    for _ in range(20):
        assert advance(connection, run, away, Outcome(job, 2))
        assert sorted(run.to_do) == [0, 1, 2]
    assert (run.held, run.without_store) == (True, True)
    assert lines(connection, job)[-2:] == ["recovering", "waiting for the store: the store cannot be reached"]
    time.sleep(0.1)
    assert (run.held, run.without_store) == (False, True)
    assert advance(connection, run, done(run, 0), under_way=1)
    assert (run.held, run.without_store) == (False, False)
    assert advance(connection, run, away)
    assert lines(connection, job).count(lines(connection, job)[-1]) == 2  # it is another outage
    assert run.held
    assert advance(connection, run, done(run, 2), under_way=1)
    assert not run.held  # a worker reaches it: nothing is waited for


def test_a_worker_that_does_not_see_the_store_neither_holds_the_job_nor_fails_it(
    connection: Connection, job: str, caplog: pytest.LogCaptureFixture
) -> None:
    run = working(connection, job)
    blind = Outcome(job, 1, error=WrongStore("the machine m does not see the store"))
    for _ in range(20):
        assert advance(connection, run, blind)
        assert (run.held, run.without_store) == (False, True)
        assert advance(connection, run, done(run, 0), under_way=1)
        assert not run.without_store
    assert lines(connection, job)[-2:] == [
        "recovering",
        "waiting for the store: the machine m does not see the store",
    ]
    assert caplog.text.count("the machine m does not see the store") == 20


def test_only_transient_errors_are_retried(connection: Connection, job: str) -> None:
    run = working(connection, job)
    assert advance(connection, run, Outcome(job, 0, error=Unavailable("its decoder has ended")))
    assert lines(connection, job)[-1] == "tile 0, attempt 1 of 3: its decoder has ended"
    assert not advance(connection, run, Outcome(job, 0, error=Corrupt("it is damaged")))
    assert jobs.get(connection, job).problem["detail"] == "it is damaged"


def test_a_tile_that_kills_workers_fails_the_job(connection: Connection, job: str) -> None:
    run = working(connection, job)
    death = Outcome(job, 1, died="tls://host:1")
    assert [advance(connection, run, death) for _ in range(LOSSES)] == [True] * (LOSSES - 1) + [False]
    assert "ENVMATTE_WORKER_MEMORY" in jobs.get(connection, job).problem["detail"]
    assert jobs.get(connection, job).failed == 1


def test_a_tile_that_exceeds_the_memory_fails_the_job(connection: Connection, job: str) -> None:
    run = working(connection, job)
    death = Outcome(job, 1, died="tls://host:1", starved=True)
    assert [advance(connection, run, death) for _ in range(3)] == [True, True, False]
    detail = jobs.get(connection, job).problem["detail"]
    assert (
        "tile 1 ran out of its worker's memory 3 times: give workers more memory (ENVMATTE_WORKER_MEMORY)"
        in detail
    )


def test_missing_tiles_are_repeated(connection: Connection, job: str) -> None:
    run = working(connection, job)
    advance(connection, run, *(done(run, n) for n in range(3)))
    assert advance(connection, run, done(run, FINISH, {"missing": [1]}))
    assert (run.stage, list(run.to_do)) == ("recovering", [1])
    assert advance(connection, run, done(run, 1))
    assert (run.stage, list(run.to_do)) == ("finishing", [FINISH])
    assert advance(connection, run, Outcome(job, FINISH, error=OSError()))  # it was not done before
    assert not advance(connection, run, done(run, FINISH, {}))
    row = jobs.get(connection, job)
    assert (row.state, row.done, row.pixels) == ("succeeded", 3, 30)


def test_store_that_loses_a_tile_each_time_fails_the_job(connection: Connection, job: str) -> None:
    run = working(connection, job)
    advance(connection, run, *(done(run, n) for n in range(3)))
    for _ in range(LOSSES - 1):
        assert advance(connection, run, done(run, FINISH, {"missing": [1]}))
        assert advance(connection, run, done(run, 1))
    assert not advance(connection, run, done(run, FINISH, {"missing": [1, 2]}))
    row = jobs.get(connection, job)
    assert row.state == "failed"
    assert row.problem["detail"].startswith("the store loses what is written to it: 2 tiles are missing")


def test_pace_is_measured_again_where_it_changes(connection: Connection, job: str) -> None:
    run = working(connection, job, tiles=9)

    def paced_from(*tiles: int, threads: int = 2) -> int | None:
        """Do tiles; returns how many were done when the pace was last measured."""
        assert advance(connection, run, *(done(run, tile) for tile in tiles), under_way=1, threads=threads)
        row = jobs.get(connection, job)
        return None if row.paced_at is None else row.paced_done

    assert [paced_from(0), paced_from(1), paced_from(2)] == [None, 2, 2]
    assert [paced_from(3, threads=3), paced_from(4, threads=3)] == [4, 4]
    for paused in (True, False):
        jobs.pause(connection, job, paused)
        run.follow(jobs.get(connection, job))
    assert [paced_from(threads=3), paced_from(5, threads=3), paced_from(6, threads=3)] == [None, 6, 6]
    advance(connection, run, done(run, 7), done(run, 8), threads=3)
    assert advance(connection, run, done(run, FINISH, {"missing": [0, 1]}), threads=3)
    assert [paced_from(threads=3), paced_from(0, threads=3)] == [None, 9]


@pytest.mark.parametrize("hours", [1, -1])
def test_pace_is_measured_again_after_the_clock_was_set(
    connection: Connection, job: str, monkeypatch: pytest.MonkeyPatch, hours: int
) -> None:
    run, now = working(connection, job, tiles=9), time.time
    advance(connection, run, done(run, 0), done(run, 1), under_way=1)
    assert jobs.get(connection, job).paced_done == 2
    monkeypatch.setattr(time, "time", lambda: now() + hours * 3600)
    advance(connection, run, done(run, 2), under_way=1)
    row = jobs.get(connection, job)
    assert (row.paced_done, row.moved_at - row.paced_at) == (3, pytest.approx(0, abs=60))


@pytest.mark.parametrize("fails", [False, True])
def test_a_cancelled_job_neither_succeeds_nor_fails(connection: Connection, job: str, fails: bool) -> None:
    run = working(connection, job)
    advance(connection, run, *(done(run, n) for n in range(3)))
    jobs.cancel(connection, job)
    end = Outcome(job, FINISH, error=Corrupt("it is damaged")) if fails else done(run, FINISH, {})
    assert not advance(connection, run, end)
    assert jobs.get(connection, job).state == "cancelled"
    assert mattes.get(connection, "mat").state == "recovering"


def test_region_comes_first(connection: Connection, job: str) -> None:
    run = start(connection, job)
    figures = {"width": 160, "height": 48, "block": 16}  # 3 rows of 10 tiles
    assert advance(connection, run, done(run, PREPARE, {"tiles": 30, "figures": figures}))
    jobs.change(connection, job, region=[40, 20, 20, 10])
    run.follow(jobs.get(connection, job))
    assert set(list(run.to_do)[:2]) == {12, 13}
    assert sorted(run.to_do) == list(range(30))
    advance(connection, run, done(run, 12), under_way=28)
    again = start(connection, job)
    assert (again.to_do[0], len(again.to_do)) == (13, 29)
    jobs.change(connection, job, region=[0, 0, 1000, 1])
    again.follow(jobs.get(connection, job))
    assert set(list(again.to_do)[:10]) == set(range(10))


def test_region_of_a_plan_that_an_earlier_version_made_is_ignored(connection: Connection, job: str) -> None:
    run = working(connection, job)
    before = list(run.to_do)
    jobs.change(connection, job, region=[0, 0, 1, 1])
    run.follow(jobs.get(connection, job))
    assert list(run.to_do) == before
